"""``geodelreg batch``: many pairs, from a manifest or from patterns of file names."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodelreg.errors import ManifestError, shown
from geodelreg.flags import as_typed
from geodelreg.options import AlignOptions, BatchOptions, WriteOptions
from geodelreg_cli.options import (
    FILE,
    build,
    command,
    flag,
    knob_option,
    knob_options,
    option,
    run_options,
    start_run,
    under,
)

if TYPE_CHECKING:
    from geodelreg.batch import Batch, PairResult

WHAT = ("check", "limit_px", "in_place")
MISALIGNED, REFUSED = 4, 3
RETRY = {"refused": ("refused", "cannot_tell"), "failed": ("failed",)}
SHOWN = 10

EPILOG = """\
Examples:

  The pairs of a table with the columns ms, pan, out:
    geodelreg batch pairs.csv

  Pairs by their names; MS files that differ in nothing but a wildcard are bands of one image:
    geodelreg batch --pair '{scene}_MS.tif' '{scene}_PAN.tif' -o 'out/{scene}.tif'
    geodelreg batch --pair 'LC*_{day}/B[2-4].TIF' 'LC*_{day}/B8.TIF' -o 'out/{day}'

  Look before: what would be run, and how many of them are misaligned:
    geodelreg batch pairs.csv --dry-run
    geodelreg batch pairs.csv --check --ledger check.ledger

  Go on after an interruption; run once more what had failed:
    geodelreg batch pairs.csv --resume
    geodelreg batch pairs.csv --retry failed --memory 8000

  On a cluster of Dask:
    geodelreg batch pairs.csv --dask tcp://scheduler:8786

  To look at: a table and a map in report/index.html, and a page a pair:
    geodelreg batch pairs.csv --report-dir report

Exit codes: 1 some failed; else 4 some are misaligned (--check); else 3 some were refused or cannot
be told; else 0. 2 wrong usage, or a manifest with a mistake: nothing was started.
"""


OPTIONS = [
    *under(
        "Which pairs",
        option(
            "--pair",
            nargs=2,
            metavar="MS PAN",
            help="Patterns of the names of MS and PAN in place of a manifest. {field} stands for "
            "the same text in all patterns; *, ?, [...] and **/ for any.",
        ),
        option(
            "-o",
            "--output",
            metavar="OUT",
            help="Pattern of the outputs of --pair; a folder where there are several MS files.",
        ),
        option(
            "--out-root",
            type=FILE,
            metavar="FOLDER",
            help="Outputs stay below this folder, and relative ones begin there; by default the "
            "manifest's, with --pair the current one.",
        ),
        *(knob_option(BatchOptions, name) for name in WHAT),
        knob_option(WriteOptions, "overwrite"),
        flag(
            "--dry-run",
            help="Check all pairs and print them, one line of JSON each; start nothing.",
        ),
    ),
    *under(
        "What is kept",
        option(
            "--ledger",
            type=FILE,
            metavar="FILE",
            help="SQLite file with what became of each pair; by default pairs.ledger beside "
            "pairs.csv, with --pair batch.ledger in --out-root.",
        ),
        flag("--resume", help="Go on with an existing ledger: what is finished is not repeated."),
        option(
            "--retry",
            type=click.Choice(tuple(RETRY)),
            multiple=True,
            help="Go on, and run the pairs once more that were refused (with --check: cannot be "
            "told), or failed. May be repeated.",
        ),
        option(
            "--table",
            type=FILE,
            multiple=True,
            metavar="FILE",
            help="All results at the end: .csv, .parquet (needs the parquet extra), or .html to "
            "look at (needs the report extra). May be repeated. Without it a CSV beside the "
            "ledger, pairs.results.csv for pairs.ledger.",
        ),
        option(
            "--footprints",
            type=FILE,
            multiple=True,
            metavar="FILE",
            help="Where each MS lies, with its outcome: .geojson, or .gpkg (needs the vector "
            "extra). May be repeated.",
        ),
        option(
            "--report-dir",
            type=FILE,
            metavar="FOLDER",
            help="Pages to look at: index.html with a table and a map of all pairs, and one page a "
            "pair, also of refused ones (needs the report extra).",
        ),
    ),
    *under(
        "How they run",
        *knob_options(BatchOptions, without=WHAT),
        option(
            "--dask",
            metavar="ADDRESS",
            help="Scheduler of a cluster of Dask, whose workers see the same files (needs the "
            "batch extra).",
        ),
    ),
    *under("How to align", *knob_options(AlignOptions, without=["threads", "allow"])),
    *under("How OUT is written", *knob_options(WriteOptions, without=["overwrite"])),
    *run_options(threads=False),
]


@command(EPILOG, OPTIONS)
@click.argument("manifest", metavar="[MANIFEST]", required=False, type=FILE)
def batch(manifest: Path | None, **given: Any) -> int:
    """Align, or check, many pairs, and keep a ledger of what became of each.

    MANIFEST is CSV with a header line, or JSON lines, with the columns ms, pan and out; further
    columns are options of that pair, called as in Python (search_radius_px). Relative names begin
    in the manifest's folder. In CSV several MS files are parted by semicolons.
    """
    start_run(given)
    ready = _batch(manifest, given)
    try:
        if given["dry_run"]:
            for pair in ready.planned():
                click.echo(pair.to_json())
            return 0
        ready.prepare()
    except ManifestError as error:
        for problem in error.problems:
            click.echo(shown(as_typed(problem)), err=True)
        raise
    if given["dask"] and not (given["verbose"] or given["debug"]):
        _silence_dask()
    with _shown(ready, given) as show:
        for result in ready:
            show(result)
    if not given["quiet"]:
        _summarise(ready)
    return _exit_code(ready.counts)


def _batch(manifest: Path | None, given: dict[str, Any]) -> Batch:
    if (manifest is None) == (given["pair"] is None):
        raise click.UsageError("Name a manifest, or give patterns with --pair.")
    if given["output"] is not None and given["pair"] is None:
        raise click.UsageError("-o goes with --pair; a manifest has the column out.")
    from geodelreg.batch import Batch, ledger_path
    from geodelreg.batch.pairing import rows_from_patterns

    options, align = build(BatchOptions, given), build(AlignOptions, given | {"threads": 0})
    write = build(WriteOptions, given)
    if options.in_place and write not in (WriteOptions(), WriteOptions(overwrite=True)):
        raise click.UsageError("--in-place corrects headers and nothing else: drop --of, --co, ...")
    pairs: Any = manifest
    if given["pair"] is not None:
        ms, pan = given["pair"]
        pairs = list(rows_from_patterns(ms, pan, given["output"]))
    ledger = ledger_path(pairs, given["ledger"], given["out_root"])
    return Batch(
        pairs,
        given["dask"],
        options=options,
        align=align,
        write=write,
        ledger=ledger,
        out_root=given["out_root"],
        resume=given["resume"],
        retry=[outcome for name in given["retry"] for outcome in RETRY[name]],
        tables=(*(given["table"] or [ledger.with_suffix(".results.csv")]), *given["footprints"]),
        report_dir=given["report_dir"],
        config=dict(given["config"]),
    )


def _exit_code(counts: Counter[str]) -> int:
    if counts["failed"]:
        return 1
    if counts["misaligned"]:
        return MISALIGNED
    return REFUSED if counts["refused"] or counts["cannot_tell"] else 0


@contextmanager
def _shown(ready: Batch, given: dict[str, Any]) -> Iterator[Any]:
    """What is done with each result: a live table on a terminal, a line each with ``-v``."""
    import sys

    if given["quiet"] or not sys.stderr.isatty():
        yield (lambda result: click.echo(_line(result), err=True)) if given["verbose"] else _silent
        return
    from geodelreg_cli.batch_table import live_table

    with live_table(ready) as show:
        yield show


def _silence_dask() -> None:
    """Dask logs tracebacks of what the command says in a sentence."""
    with suppress(ImportError):
        import distributed  # noqa: F401 - it sets its levels when it is loaded
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _silent(result: PairResult) -> None:
    """The ledger has it."""


def _line(result: PairResult) -> str:
    """One result in one line."""
    parts = [f"{result.number} {Path(result.sources[0]).name}: {result.outcome}"]
    parts += [result.error] if result.error else []
    parts += [result.reason] if result.reason else []
    return shown(as_typed(", ".join(parts)))


def _summarise(ready: Batch) -> None:
    """How many ended as what, and where the rest is to be read."""
    counts = ready.counts
    listed = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)
    click.echo(f"{sum(counts.values())} pairs: {listed}", err=True)
    for result in ready.worst(SHOWN):
        click.echo(f"  {_line(result)}", err=True)
    click.echo(f"Ledger: {ready.path}", err=True)
