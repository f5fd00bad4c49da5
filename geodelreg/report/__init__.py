"""A result to look at: one page for a pair, one for a batch, and figures.

`geodelreg.product.report` writes the same for machines.  What is to be shown (`frame`, `residuals`,
`places`, `words`) is apart from how: pictures of the rasters (`pictures`), lines over them
(`drawing`), pages (`page`, `index`), figures of matplotlib (`figures`).
"""
