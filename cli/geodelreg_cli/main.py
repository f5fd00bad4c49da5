"""The ``geodelreg`` command: finds the subcommand, and turns every ending into an exit code.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 alignment refused, 4 misaligned (check), 130 Ctrl-C,
143 SIGTERM.
``--help`` and ``--version`` load click and nothing else that is heavy: each subcommand is
imported when it is called.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from io import StringIO

import click

from geodelreg.errors import AlignmentRefusedError, GeodelregError, shown
from geodelreg.version import __version__
from geodelreg_cli.interrupts import Terminated, termination_as_exception

_OBJECTS_TO_COLLECT = 50_000
"""Imports make hundreds of thousands that stay: looking through them each 700 takes a tenth."""

# name: (module that holds the click command of that name, line in the list of commands)
COMMANDS = {
    "align": ("geodelreg_cli.align", "Correct the georeferencing of MS so that it fits PAN."),
    "apply": ("geodelreg_cli.apply", "Apply a correction to other files of the scene."),
    "batch": ("geodelreg_cli.batch", "Align or check many pairs, with a ledger; also on Dask."),
    "check": ("geodelreg_cli.check", "Tell whether MS lies where PAN says; write nothing."),
    "completion": ("geodelreg_cli.completion", "Make the shell complete commands and options."),
    "figure": ("geodelreg_cli.figure", "Draw what a JSON report tells: before and after, arrows."),
    "gcps": ("geodelreg_cli.gcps", "Convert ground control points between formats."),
    "info": ("geodelreg_cli.info", "Tell grid, CRS, footprint, bands and provenance of rasters."),
    "pansharpen": ("geodelreg_cli.pansharpen", "Align MS, then sharpen it with PAN."),
    "refit": ("geodelreg_cli.refit", "Correct MS by control points that you have edited."),
    "report": ("geodelreg_cli.report", "Make a page to look at out of a JSON report."),
    "revert": ("geodelreg_cli.revert", "Undo align --in-place."),
}

EPILOG = """\
\b
Examples:
  geodelreg align ms.tif pan.tif -o aligned.tif
  geodelreg align ms.tif pan.tif --in-place
  geodelreg align B2.tif B3.tif B4.tif B8.tif -o aligned/
  geodelreg check ms.tif pan.tif
  geodelreg batch pairs.csv
  geodelreg align --help

\b
Exit codes:
  0  done; also when MS already fits and its header is left as it is
  1  failed: an input cannot be read or an output cannot be written
  2  wrong usage
  3  refused: the evidence supports no alignment, nothing was written; check: cannot tell
  4  check: misaligned
batch: that of its worst pair, failures first
"""


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called, not when they are listed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in COMMANDS:
            return None
        command = getattr(import_module(COMMANDS[cmd_name][0]), cmd_name)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in self.list_commands(ctx)])


@click.group(
    cls=LazyGroup,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, message="%(prog)s %(version)s")
def cli() -> None:
    """Align a multispectral raster (MS) to a panchromatic one (PAN).

    The pixels of MS stay as they are, bit by bit; its georeferencing is corrected.
    """


def run(args: Sequence[str]) -> int:
    """Run the command line and return its exit code; no exception but SystemExit leaves it.

    Parameters
    ----------
    args : sequence of str
        Without the program's name.
    """
    try:
        with termination_as_exception():
            code = cli.main(list(args), prog_name="geodelreg", standalone_mode=False)
            return code if isinstance(code, int) else 0
    except click.ClickException as error:
        text = StringIO()
        error.show(text)
        _echo_lines(text.getvalue())
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted")
        return 130
    except Terminated as termination:
        _say("terminated")
        return 128 + termination.signal_number
    except Exception as error:
        if "--debug" in args:
            import traceback

            _echo_lines(traceback.format_exc())
        return _explain(error)


def _explain(error: Exception) -> int:
    """Say on stderr what went wrong and what helps, and return the exit code."""
    if isinstance(error, GeodelregError):
        from geodelreg.flags import as_typed

        kind = "refused" if isinstance(error, AlignmentRefusedError) else "error"
        _say(f"{kind}: {as_typed(error.cause)}")
        if error.remedy:
            click.echo(f"  {as_typed(error.remedy)}", err=True)
        return error.exit_code
    if isinstance(error, MemoryError):
        _say("error: out of memory")
    elif isinstance(error, OSError):
        _say(f"error: {error}")
    else:
        _say(f"internal error: {type(error).__name__}: {error}")
        click.echo("  Run again with --debug and report what it prints.", err=True)
    return 1


def _echo_lines(text: str) -> None:
    for line in text.rstrip("\n").split("\n"):
        click.echo(shown(line), err=True)


def _say(text: str) -> None:
    click.echo(f"geodelreg: {shown(text)}", err=True)


def main() -> None:
    """Entry point of the installed script."""
    gc.set_threshold(_OBJECTS_TO_COLLECT)
    code = run(sys.argv[1:])
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of --json has gone: not worth a word
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback out of the interpreter's exit
    sys.exit(code)
