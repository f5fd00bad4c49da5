"""Time and memory against the size of the rasters, with GDAL's reading as the floor."""
