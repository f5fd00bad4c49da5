"""A TIFF with another header, every other byte as it was.

::

    header.py      which entries the corrected directory has
    geotags.py     the entries that carry the geotransform, GCPs, CRS and metadata
    corrected.py   a copy: tiffwrite.py appends the directory, relayout.py where it must come first
    inplace.py     the file itself: plans the edit; undo.py makes it, and takes it back
    rewrite.py     what is no TIFF, or is to be encoded anew: through GDAL, compared afterwards
    atomic.py      whole or not at all: private.py (folder), journal.py (many), durable.py (flushed)
"""
