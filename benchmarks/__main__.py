"""``python -m benchmarks COMMAND``: see benchmarks/README.md."""

from __future__ import annotations

import argparse
import importlib
import sys

COMMANDS = {
    "scenes": ("benchmarks.scenes.make", "write the scenes with known truth"),
    "sweep": ("benchmarks.accuracy.sweep", "align many scenes: rotation, shift, scale, GSD ratio"),
    "real": ("benchmarks.accuracy.real_pairs", "align real pairs and measure them independently"),
    "paper": (
        "benchmarks.paper.run",
        "the paper's experiments: SIFT, its method, ours, by ablation",
    ),
    "field": ("benchmarks.accuracy.field", "pairs that bend and jump, against the known truth"),
    "bound": ("benchmarks.accuracy.bound", "errors against the Cramér–Rao bound"),
    "unshared": (
        "benchmarks.accuracy.unshared",
        "the standard error where PAN and MS see different light",
    ),
    "gate": ("benchmarks.gate.run", "false accepts and false refusals of the gate"),
    "constants": (
        "benchmarks.gate.constants",
        "the method's numbers that were chosen by hand, halved and doubled",
    ),
    "ablate": ("benchmarks.gate.ablate", "the method's rules switched off, one at a time"),
    "bent": ("benchmarks.gate.bent", "pairs bent, torn, coloured or framed: what is said of them"),
    "peers": ("benchmarks.peers.run", "geodelreg and its peers side by side"),
    "peers-real": ("benchmarks.peers.real", "the same on real pairs, measured independently"),
    "peers-local": ("benchmarks.peers.local", "the same on pairs that bend"),
    "speed": ("benchmarks.peers.speed", "wall time beside a half-size SIFT script, in turn"),
    "stages": ("benchmarks.peers.stages", "where the time of one alignment goes"),
    "compare": ("benchmarks.peers.table", "two result files of `peers` as ratios"),
    "scale": ("benchmarks.scale.run", "time and memory against the size of the rasters"),
    "wald": ("benchmarks.sharpening.wald", "what alignment is worth to pansharpening"),
    "ramps": (
        "benchmarks.sharpening.ramps",
        "sharpened ramps: every pixel in its place",
    ),
    "sharpen": ("benchmarks.sharpening.large", "a large pair: GDAL's tools beside it, dask"),
    "warp": ("benchmarks.scale.warp", "MS warped onto PAN's grid, gdalwarp beside it"),
    "batch": ("benchmarks.batch.run", "many pairs: throughput, Dask, kills, a huge manifest"),
    "browser": ("benchmarks.browser.run", "the pages of reports in headless Chromium"),
    "filters": ("benchmarks.accuracy.filters", "mismatch filters against known truth"),
    "fuzz": (
        "benchmarks.robustness.fuzz",
        "broken and hostile inputs: no crash, no hang, nothing that was not asked for",
    ),
    "kills": (
        "benchmarks.robustness.kills",
        "kill -9 at random times: old or new files, nothing between",
    ),
}


def main(argv: list[str] | None = None) -> int:
    """Dispatch to the module of a command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (_, summary) in COMMANDS.items():
        commands.add_parser(name, help=summary, add_help=False)
    known, rest = parser.parse_known_args(argv)
    module = importlib.import_module(COMMANDS[known.command][0])
    command = argparse.ArgumentParser(prog=f"python -m benchmarks {known.command}")
    module.add_arguments(command)
    return int(module.run(command.parse_args(rest)))


if __name__ == "__main__":
    sys.exit(main())
