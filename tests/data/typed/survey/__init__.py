"""A package that uses geodelreg as people do; type checkers read it, and a test runs it."""

from survey.places import Found, place, place_array, sharpen

__all__ = ["Found", "place", "place_array", "sharpen"]
