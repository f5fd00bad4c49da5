"""The results of `peers` as a table and a plot, and two result files against each other."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from benchmarks.peers.environments import OWN
from benchmarks.report import replace_section

FAILED_PX = 1.0
CAVEATS = """How to read it:

- geodelreg was developed on these very scenes. The peers were not tuned on them, but for SIFT +
  MAGSAC, then ECC. `expert` is what somebody who knows the tool would set, on the bands weighted as
  PAN sees them; `benchmarks/README.md` says which settings, and after which source.
- PAN is a positive mix of the MS bands in A to J and aerial, which is geodelreg's own model, and
  that of every expert's setting here. In K PAN holds light that no MS band saw, L has 8 bits and
  JPEG's loss, M soft optics.
- Phase correlation and AROSICS's default estimate a shift only; most peers are made for headers
  that are a few pixels off and nearly unrotated, so C is outside what they promise.
- An affine through the points of AROSICS, KARIOS, pandora2d and Orfeo ToolBox is the adapter's.
- Time is the processor's, for other work of the machine does not change it. A tool that uses both
  cores takes half of it; wall times beside the two fastest scripts are in the next section.
- G has bright clouds that move by 6 and 9 px between the images; what is 5 to 9 px off follows
  them, or moved nothing."""
NOISE_FLOOR = {"rmse_px": 0.002, "wall_s": 0.3, "peak_mb": 20.0}
Results = list[dict[str, Any]]


def load(path: Path) -> tuple[str, Results]:
    """Machine and results of a file that `peers` wrote."""
    content = json.loads(path.read_text())
    return str(content["machine"]), list(content["results"])


def _label(result: dict[str, Any]) -> str:
    setting = "" if result["tool"] == OWN else f", {result['setting']}"
    return f"{result['tool']}{setting}"


def _cell(result: dict[str, Any] | None) -> str:
    if result is None:
        return ""
    cost = f"{result['cpu_s']:.1f} s, {result['peak_mb']:.0f} MB"
    error = result["rmse_px"]
    return f"– / {cost}" if not error <= FAILED_PX else f"{error:.4f} / {cost}"


def markdown(results: Results) -> str:
    """Scenes as columns, tools as rows: RMSE in PAN px / CPU time, peak memory."""
    scenes = list(dict.fromkeys(result["scene"] for result in results))
    tools = list(dict.fromkeys(_label(result) for result in results))
    found = {(_label(result), result["scene"]): result for result in results}
    lines = ["| tool | " + " | ".join(scenes) + " |", "|---" * (len(scenes) + 1) + "|"]
    for tool in tools:
        cells = [_cell(found.get((tool, scene))) for scene in scenes]
        lines.append(f"| {tool} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def standing(results: Results) -> str:
    """One line a scene: geodelreg against the most accurate and the fastest usable peer."""
    lines = [
        "| scene | geodelreg | most accurate peer | its error over ours | fastest under 0.3 px |"
    ]
    lines.append("|---" * 5 + "|")
    for scene in dict.fromkeys(result["scene"] for result in results):
        part = [result for result in results if result["scene"] == scene]
        own = next((result for result in part if result["tool"] == OWN), None)
        peers = [r for r in part if r["tool"] != OWN and r["rmse_px"] <= FAILED_PX]
        usable = [r for r in peers if r["rmse_px"] < 0.3]
        best = min(peers, key=lambda r: float(r["rmse_px"]), default=None)
        fastest = min(usable, key=lambda r: float(r["cpu_s"]), default=None)
        cells = [
            "–" if r is None else f"{_label(r)}: {r['rmse_px']:.4f} px, {r['cpu_s']:.1f} s"
            for r in (own, best, fastest)
        ]
        known = own is not None and best is not None and own["rmse_px"] > 0
        times = f"{best['rmse_px'] / own['rmse_px']:.1f} ×" if known and own and best else "–"
        cells.insert(2, times)
        lines.append(f"| {scene} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(results: Results, path: Path) -> None:
    """Accuracy against time, one marker a run; failures lie on the line at the top."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(9.5, 5.5))
    tools = list(dict.fromkeys(result["tool"] for result in results))
    for index, tool in enumerate(tools):
        part = [result for result in results if result["tool"] == tool]
        error = [r["rmse_px"] if r["rmse_px"] <= FAILED_PX else 3.0 for r in part]
        axes.scatter(
            [r["cpu_s"] for r in part], error, label=tool, s=60 if tool == OWN else 26,
            marker="*" if tool == OWN else "os^vDP<>X"[index % 9],
        )  # fmt: skip
    axes.axhline(3.0, color="0.6", linewidth=0.8, linestyle=":")
    axes.text(axes.get_xlim()[0], 3.2, " failed, or more than 1 px off", fontsize=8, color="0.4")
    axes.set(xscale="log", yscale="log", xlabel="CPU time, s", ylabel="RMSE, PAN px")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5))
    axes.grid(alpha=0.3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def failures(results: Results) -> str:
    """Why tools gave nothing, and how far off they were where they claimed success."""
    lines = []
    for result in results:
        if result["rmse_px"] <= FAILED_PX:
            continue
        wrong = not math.isnan(result["rmse_px"])
        reason = f"{result['rmse_px']:.1f} px off, no error raised" if wrong else ""
        lines.append(f"- {result['scene']}, {_label(result)}: {reason or result['failure']}")
    return "\n".join(lines)


def write_page(source: Path, page: Path, timeout_s: float) -> None:
    """Replace the section ``peers`` of a page, and its plot beside it."""
    name, results = load(source)
    image = page.parent / "images" / "accuracy_versus_time.png"
    plot(results, image)
    text = (
        "## Side by side with other tools\n\n"
        "`python -m benchmarks peers --scenes DIR --out FILE --docs docs/benchmarks.md` "
        f"({name}; {timeout_s:g} s for each run).\n\n"
        "Each cell: RMSE in PAN px / CPU time of the whole process, largest resident set; "
        "– = failed, or more than 1 px off.\n\n"
        f"{CAVEATS}\n\n{markdown(results)}\n\n{standing(results)}\n\n"
        f"![Accuracy against time](images/{image.name})\n\n"
        f"### Failures\n\n{failures(results)}"
    )
    replace_section(page, "peers", text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``python -m benchmarks compare``."""
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--tolerance", type=float, default=1.25, help="largest ratio accepted")


def run(args: argparse.Namespace) -> int:
    """Ratios after / before of geodelreg's figures; 1 when one is above the tolerance.

    Below a floor (0.002 px, 0.3 s, 20 MB of difference) a ratio is not held against a result.
    """
    before = {(r["scene"], r["setting"]): r for r in load(args.before)[1] if r["tool"] == OWN}
    after = {(r["scene"], r["setting"]): r for r in load(args.after)[1] if r["tool"] == OWN}
    worse = 0
    print("| scene | RMSE | wall | peak memory |\n|---|---|---|---|")
    for key in before.keys() & after.keys():
        cells = []
        for figure, floor in NOISE_FLOOR.items():
            old, new = float(before[key][figure]), float(after[key][figure])
            bad = not (new <= args.tolerance * old or new - old <= floor)
            worse += bad
            cells.append(f"{new / old:.2f}{' WORSE' if bad else ''}")
        print(f"| {key[0]} | " + " | ".join(cells) + " |")
    return 1 if worse else 0
