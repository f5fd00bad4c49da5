"""The family of `geodelreg.values.maps.PixelMap`: a new kind of correction is a new module here."""
