"""Adapters of the tools that geodelreg is compared with; each runs in an environment of its own."""
