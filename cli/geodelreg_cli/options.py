"""Click options made from the knobs of `geodelreg.options`, and help in sections.

A knob is documented once, in its dataclass; name, type, default and help of its flag come from
there: ``search_radius_px`` is ``--search-radius PX``.
"""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from geodelreg.errors import UsageError
from geodelreg.flags import UNITS, as_typed, flags
from geodelreg.option_checks import field_of, knob_help
from geodelreg.options import AlignOptions
from geodelreg_cli.console import configure_logging

_Options = TypeVar("_Options")

RUN = "Run"
FILE = click.Path(path_type=Path)
TYPES = {"str": click.STRING, "int": click.INT, "float": click.FLOAT, "bool": click.BOOL}
# What follows a flag that may be repeated, unless it is KEY=VALUE.
METAVARS = {"masks": "FILE[=HIDE]", "pan_masks": "FILE[=HIDE]"}


class NumberOr(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.3 on
    """A whole number, or a word that stands for a value."""

    def __init__(self, word: str, meaning: int | None) -> None:
        self.name = f"N|{word}"
        self.word = word
        self.meaning = meaning

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | None:
        """Parse what the user typed."""
        if isinstance(value, int):
            return value
        if str(value).lower() == self.word.lower():
            return self.meaning
        try:
            return int(value)
        except ValueError:
            self.fail(f"{value!r} is neither a whole number nor {self.word}.", param, ctx)


# Knobs of which a value is a word on the command line.
WORDS = {
    "band": NumberOr("auto", None),
    "pan_band": NumberOr("auto", 0),
    "threads": NumberOr("ALL_CPUS", 0),
}


GCP_FORMAT = click.Choice(
    ("qgis", "gdal", "csv", "geojson", "gpkg", "flatgeobuf", "vrt", "envi", "envi-map")
)


class SectionOption(click.Option):
    """An option that is listed under a heading of its own in the help, set by `under`."""

    section = "Options"


def option(*names: str, **kwargs: Any) -> SectionOption:
    """An option with a value."""
    return SectionOption(names, **kwargs)


def flag(*names: str, **kwargs: Any) -> SectionOption:
    """An option that is given or not."""
    return SectionOption(names, is_flag=True, **kwargs)


def under(section: str, *options: SectionOption) -> list[SectionOption]:
    """Options that the help lists under one heading."""
    for one in options:
        one.section = section
    return list(options)


class SectionCommand(click.Command):
    """A command whose help groups the options by section and keeps the layout of its epilog."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one definition list a section, in order of first appearance."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = None if isinstance(param, click.Argument) else param.get_help_record(ctx)
            if record is not None:
                sections.setdefault(getattr(param, "section", "Options"), []).append(record)
        for name, records in sections.items():
            with formatter.section(name):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog as it is."""
        if self.epilog:
            formatter.write_paragraph()
            formatter.write(inspect.cleandoc(self.epilog) + "\n")


def knob_option(options: type, knob: str) -> SectionOption:
    """Click option of one knob.

    Parameters
    ----------
    options : type
        `AlignOptions` or `WriteOptions`.
    knob : str
        Name of its field.
    """
    text = as_typed(knob_help(options, knob))
    return option(knob, *flags(knob), help=text, **_kind(field_of(options, knob)))


def _kind(field: Field[Any]) -> dict[str, Any]:
    """Type, default and metavar: the arguments of `click.Option` that depend on the knob's type."""
    assert field.default is not MISSING
    kind = str(field.type).split(" | ")[0]
    if kind == "bool":
        return {"is_flag": True, "default": field.default}
    if kind.startswith("tuple[int"):
        return {"type": click.STRING, "default": "", "metavar": "N,N,..."}
    if kind.startswith("tuple"):
        metavar = METAVARS.get(field.name, "KEY=VALUE")
        return {"multiple": True, "default": field.default, "metavar": metavar}
    if field.name in WORDS:
        word = WORDS[field.name]
        default = word.word if field.default == word.meaning else str(field.default)
        return {"type": word, "default": default, "show_default": True, "metavar": word.name}
    choices = field.metadata["choices"]
    unit = next((UNITS[u] for u in UNITS if field.name.endswith(u)), None)
    return {
        "type": click.Choice(choices) if choices else TYPES[kind],
        "default": f"{field.default:g}" if isinstance(field.default, float) else field.default,
        "show_default": True,
        "metavar": unit,
    }


def knob_options(options: type, without: Collection[str]) -> list[SectionOption]:
    """Click options of all knobs but some."""
    return [knob_option(options, one.name) for one in fields(options) if one.name not in without]


def message_options() -> list[SectionOption]:
    """Options that every command has."""
    return [
        flag("-q", "--quiet", help="Print errors only."),
        option("-v", "--verbose", count=True, help="Print the steps; -vv everything."),
        flag("--debug", help="Print a traceback with an error."),
    ]


def run_options(threads: bool = True) -> list[SectionOption]:
    """Options that every long-running command has: resources, GDAL's settings, messages."""
    config = option(
        "--config",
        nargs=2,
        multiple=True,
        metavar="KEY VALUE",
        help="Configuration option of GDAL. May be repeated.",
    )
    knobs = ["threads", "allow"] if threads else ["allow"]
    return under(
        RUN, *(knob_option(AlignOptions, name) for name in knobs), config, *message_options()
    )


def start_run(given: Mapping[str, Any]) -> None:
    """Put the values of `run_options` to work, as far as a command has them.

    Raises
    ------
    click.UsageError
        When a setting cannot be one.
    """
    configure_logging(given["verbose"], given["quiet"], given["debug"])
    # BLAS, not loaded yet: its threads spin while they wait, so that on a busy machine the fit of
    # a field took minutes; matrices of some hundred points gain nothing from them
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for key, value in given.get("config", ()):
        try:
            os.environ[key] = value  # where GDAL, not loaded yet, looks its options up
        except ValueError as error:
            raise click.UsageError(f"--config {key} {value}: {error}") from error
    _keep_to(given["allow"])


def _keep_to(allow: str) -> None:
    """Take formats that can reach further out of GDAL, which is not loaded yet."""
    from geodelreg.door.formats import skip_the_rest
    from geodelreg.door.names import ALL

    if allow != ALL:
        skip_the_rest(os.environ, allow)
        # GDAL says so of each format that this build of it does not have
        logging.getLogger("rasterio._env").addFilter(
            lambda record: "Unable to find driver" not in record.getMessage()
        )


def ms_and_pan(rasters: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Split the arguments ``MS... PAN``.

    Raises
    ------
    click.UsageError
        With fewer than two.
    """
    if len(rasters) < 2:
        raise click.UsageError("Name at least two rasters: MS, then PAN.")
    return rasters[:-1], rasters[-1]


def command(
    epilog: str, options: Iterable[SectionOption]
) -> Callable[[Callable[..., Any]], click.Command]:
    """Decorator that makes a command of a function, with options after its arguments."""

    def decorate(function: Callable[..., Any]) -> click.Command:
        made = click.command(cls=SectionCommand, epilog=epilog)(function)
        made.params.extend(options)
        return made

    return decorate


def is_default(name: str) -> bool:
    """True of an option that the user has not given."""
    source = click.get_current_context().get_parameter_source(name)
    return source in (None, ParameterSource.DEFAULT)


def build(options: type[_Options], given: Mapping[str, Any]) -> _Options:
    """Make the options object out of the values click has parsed.

    Raises
    ------
    click.UsageError
    """
    names = [f.name for f in fields(options) if f.name in given]  # type: ignore[arg-type]
    try:
        return options(**{name: given[name] for name in names})
    except UsageError as error:
        raise click.UsageError(as_typed(str(error))) from error
