"""Pairs with known truth, rendered from real imagery."""
