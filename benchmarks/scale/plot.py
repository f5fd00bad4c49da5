"""The plot of `scale`: time and memory against pixels, with the floor and the limits."""

from __future__ import annotations

from pathlib import Path

from benchmarks.scale.row import IN_PLACE, OVERVIEWS, PEAK_LIMIT_MB, PLAIN, STRIPED, Row

MARKERS = {OVERVIEWS: "s", STRIPED: "D"}


def draw(rows: list[Row], path: Path) -> None:
    """Write the plot as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    plain = [row for row in rows if row.variant == PLAIN and not row.failure]
    pixels = [row.size**2 / 1e6 for row in plain]
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    time, memory = figure.subplots(1, 2)
    time.loglog(pixels, [row.wall_s for row in plain], "o-", label="geodelreg align", color="C0")
    time.loglog(pixels, [row.match_s for row in plain], "o:", label="of it matching", color="C0")
    floors = [row.read_floor_s + row.copy_floor_s for row in plain]
    time.loglog(pixels, floors, "o-", color="0.5", label="GDAL reads, MS is copied")
    limits = [row.limit_s for row in plain]
    time.loglog(pixels, limits, "--", color="C3", label="allowed: 1.5 times that + 3 s")
    memory.semilogx(pixels, [row.peak_mb for row in plain], "o-", color="C0", label="tiled PAN")
    memory.axhline(PEAK_LIMIT_MB, ls="--", color="C3", label=f"limit, {PEAK_LIMIT_MB} MB")
    for row in rows:
        if row.variant in MARKERS and not row.failure:
            style = {"marker": MARKERS[row.variant], "ls": "", "color": "C2", "mfc": "none"}
            x = row.size**2 / 1e6
            time.loglog([x], [row.wall_s], label=f"PAN {row.variant}", **style)
            memory.semilogx([x], [row.peak_mb], label=f"PAN {row.variant}", **style)
        if row.variant == IN_PLACE and not row.failure:
            name = f"--in-place, MS of {row.ms_mb / 1e3:.0f} GB"
            time.loglog([row.size**2 / 1e6], [row.wall_s], "*", color="C1", label=name)
    memory.set_ylim(0, max(PEAK_LIMIT_MB * 1.2, 1.1 * max(row.peak_mb for row in rows)))
    for axes, label in ((time, "s"), (memory, "peak resident set, MB")):
        axes.set_xlabel("PAN, megapixels")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
