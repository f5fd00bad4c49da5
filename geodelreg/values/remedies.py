"""What can be done about a refusal, by the reasons that refused."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

ROTATES = (
    "the correction rotates the raster: its geotransform is no longer north-up, which GDAL's "
    "pansharpening and gdalbuildvrt refuse"
)
"""A warning for whom a corrected header is written."""
_REMEDIES = (
    (
        {"local"},
        (
            "`warp=True` writes a field that follows the bend, `georef='gcps'` its control points, "
            "and a sharpened GeoTIFF (pansharpen) follows it; "
            "`on_local='warn'` writes the best affine all the same, `max_residual_px` allows more; "
            "a raster that is bent less in parts can be cut (gdal_translate -srcwin) and aligned "
            "part by part."
        ),
    ),
    (
        {"two_motions", "local"},
        (
            "Mask the part that moves (`mask`), or cut the raster there (gdal_translate -srcwin) "
            "and align each part."
        ),
    ),
    (
        {"field_clouds"},
        "Mask the clouds (`mask`), or ask for one affine (`model='affine'`).",
    ),
    (
        {"rival_motion"},
        (
            "Much of the ground moves otherwise. Mask clouds (`mask`); cut a raster of which a "
            "part is displaced there (gdal_translate -srcwin), and align each part; where the "
            "ground bends, as over relief or under a moving sensor, `warp=True` follows it, if "
            "enough of it can be matched; of a repeated pattern, `band` may name a band that shows "
            "more."
        ),
    ),
    (
        {"keypoints_apart", "rival_motion", "support"},
        (
            "Much of the ground lies elsewhere than the part that was followed, which may be "
            "clouds: mask them (`mask`). A raster of which a part is displaced can be cut there "
            "(gdal_translate -srcwin) and aligned part by part. Where there are neither, look "
            "whether both rasters show the same ground, and whether `band` names a band that looks "
            "more like PAN."
        ),
    ),
    (
        {"bands", "bands_apart"},
        (
            "The bands of MS do not agree, or show clouds: correct each by itself "
            "(`per_band=True`), or match on one of them (`band=N`); the correction is then right "
            "for the bands that lie with it."
        ),
    ),
    (
        {"max_shift", "max_rotation", "max_scale"},
        (
            "A correction was found that is larger than you allowed (`max_shift_px`, "
            "`max_rotation_deg`, `max_scale`): allow more if the header may be so far off."
        ),
    ),
    (
        {"rival", "shading"},
        (
            "The images fit elsewhere nearly as well: clouds that outweigh the ground (mask them, "
            "`mask`), repeated texture, or one of them is shaded like relief. Try `band` with the "
            "band that looks most like PAN, or a larger part of the scene."
        ),
    ),
    (
        {"max_uncertainty"},
        (
            "The correction is less well known than you allowed (`max_uncertainty_px`): a simpler "
            "`model`, more of the scene, or bands that look more like PAN make it surer."
        ),
    ),
    (
        {"disagreement_px"},
        (
            "Not all tie points tell the same correction: a simpler `model` is told more surely, "
            "and `method='delaunay'` finds more of them; where the ground bends, `warp=True` "
            "follows it."
        ),
    ),
    (
        {"sigma_px", "coverage", "disagreement_px"},
        (
            "Too little of the overlap shows common ground to know its corners: a simpler `model` "
            "needs less of it, and masks may hide too much."
        ),
    ),
)
"""What can be done when no other reasons than these refuse; the first that holds them counts."""

_OTHERWISE = (
    "Check that both show the same ground; try `band` with the band that looks most like PAN, a "
    "larger `search_radius_px`, or a simpler `model`; mask clouds (`mask`)."
)


_DRAWN = (
    "Labels, a collar or the like are drawn on both images, and too little of the ground beside "
    "them agrees: show more of the scene, or mask what is drawn with other values than those named "
    "(`ms_nodata`, `pan_nodata`, `mask`)."
)
"""Comes before all others: what is drawn disturbs everything else that is measured."""


def remedy_for(failed: AbstractSet[str]) -> str:
    """What helps when these reasons refused, in a sentence or two."""
    if "repeated" in failed:
        return _DRAWN
    for names, text in _REMEDIES:
        if failed and failed <= names:
            return text
    return _OTHERWISE
