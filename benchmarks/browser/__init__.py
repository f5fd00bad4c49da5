"""The pages of `geodelreg.report` in a real browser."""
