"""What the command line says of itself, as a page of the site and as manual pages.

Both are made from the commands themselves, so they cannot fall behind ``--help``.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass

import click

from geodelreg.version import __version__
from geodelreg_cli.main import COMMANDS, cli


@dataclass(frozen=True)
class Manual:
    """What is known of one command.

    Attributes
    ----------
    name : str
        ``geodelreg align``.
    line : str
        What it does, in one line.
    usage : str
        What follows the name.
    text : list of str
        Paragraphs.
    options : dict
        For each heading, flags and what they mean.
    epilog : str
        Laid out already: examples, exit codes.
    """

    name: str
    line: str
    usage: str
    text: list[str]
    options: dict[str, list[tuple[str, str]]]
    epilog: str


def manuals() -> Iterator[Manual]:
    """The command, then its commands in alphabetical order."""
    context = click.Context(cli, info_name="geodelreg", help_option_names=["-h", "--help"])
    listed = [(name, line) for name, (_, line) in sorted(COMMANDS.items())]
    yield _manual(cli, context, "Align a multispectral raster to a panchromatic one.", listed)
    for name, line in listed:
        command = cli.get_command(context, name)
        assert command is not None
        yield _manual(command, click.Context(command, context, name), line)


def _manual(
    command: click.Command,
    context: click.Context,
    line: str,
    listed: list[tuple[str, str]] | None = None,
) -> Manual:
    options: dict[str, list[tuple[str, str]]] = {"Commands": listed} if listed else {}
    for param in command.get_params(context):
        record = None if isinstance(param, click.Argument) else param.get_help_record(context)
        if record is not None:
            options.setdefault(getattr(param, "section", "Options"), []).append(record)
    return Manual(
        name=context.command_path,
        line=line,
        usage=" ".join(command.collect_usage_pieces(context)),
        text=re.split(r"\n\n+", inspect.cleandoc(command.help or "")),
        options=options,
        epilog=re.sub(r"^\x08\n", "", inspect.cleandoc(command.epilog or ""), flags=re.M),
    )


def cli_page() -> str:
    """Markdown of all commands with all options."""
    parts = ["# Command line", "`geodelreg COMMAND --help` prints what stands here."]
    for manual in manuals():
        parts.append(f"## {manual.name}\n\n```text\n{manual.name} {manual.usage}\n```")
        parts += [" ".join(paragraph.split()) for paragraph in manual.text]
        for heading, rows in manual.options.items():
            lines = [f"**{heading}**", "", "| | |", "|---|---|"]
            lines += [f"| `{flags}` | {_prose(meaning)} |" for flags, meaning in rows]
            parts.append("\n".join(lines))
        if manual.epilog:
            parts.append(f"```text\n{manual.epilog}\n```")
    return "\n\n".join(parts) + "\n"


def _prose(text: str) -> str:
    """Text of one line in which nothing passes for markup."""
    return re.sub(r"([*_<>\[\]`|])", r"\\\1", " ".join(text.split()))


def man_pages() -> dict[str, str]:
    """Names of files, such as ``geodelreg-align.1``, and their troff."""
    every = [manual.name.replace(" ", "-") for manual in manuals()]
    return {
        f"{page}.1": _man_page(manual, page, [name for name in every if name != page])
        for page, manual in zip(every, manuals(), strict=True)
    }


def _man_page(manual: Manual, page: str, others: list[str]) -> str:
    lines = [
        f'.TH "{page.upper()}" "1" "" "geodelreg {__version__}"',
        ".SH NAME",
        f"{_troff(page)} \\- {_troff(manual.line)}",
        ".SH SYNOPSIS",
        f"\\fB{_troff(manual.name)}\\fR {_troff(manual.usage)}",
        ".SH DESCRIPTION",
    ]
    for paragraph in manual.text:
        lines += [".PP", _troff(" ".join(paragraph.split()))]
    for heading, rows in manual.options.items():
        lines.append(f".SH {_troff(heading.upper())}")
        for flags, meaning in rows:
            lines += [".TP", f"\\fB{_troff(flags)}\\fR", _troff(" ".join(meaning.split()))]
    if manual.epilog:
        lines += [".SH NOTES", ".nf", *map(_troff, manual.epilog.splitlines()), ".fi"]
    lines += [".SH SEE ALSO", ", ".join(f"\\fB{_troff(name)}\\fR(1)" for name in others)]
    return "\n".join(lines) + "\n"


def _troff(text: str) -> str:
    """Text with all that troff would obey escaped."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\\&" + text if text.startswith((".", "'")) else text
