"""The version, for the package itself, its reports and its outputs."""

__version__ = "0.1.0"
