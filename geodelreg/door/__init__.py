"""The one door to GDAL: what a name or a file may make it open is looked at before it does."""
