"""Scenes with known truth, measurements on real pairs, and the peers beside geodelreg.

Run as ``python -m benchmarks``.  Nothing here is installed with the package.
"""
