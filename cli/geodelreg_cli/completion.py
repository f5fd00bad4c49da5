"""``geodelreg completion``: what a shell needs to complete commands and options."""

from __future__ import annotations

import os
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from geodelreg.errors import shown
from geodelreg_cli.options import command, flag

SHELLS = ("bash", "zsh", "fish")
EPILOG = """\
Examples:

  For the shell in use, for good:
    geodelreg completion --install

  Only print it:
    geodelreg completion bash

--install writes a file below the home folder: for bash into bash-completion's folder, for fish into
its own, for zsh into ~/.zfunc, which has to be in fpath.
"""


@command(EPILOG, [flag("--install", help="Write it where the shell looks for it.")])
@click.argument("shell", metavar="[bash|zsh|fish]", type=click.Choice(SHELLS), required=False)
@click.pass_context
def completion(context: click.Context, shell: str | None, install: bool) -> None:
    """Print or install the completion of geodelreg for a shell, by default the one in use."""
    name = shell or Path(os.environ.get("SHELL", "")).name
    kind = get_completion_class(name)
    if name not in SHELLS or kind is None:
        raise click.UsageError(f"Say which shell: one of {', '.join(SHELLS)}.")
    script = kind(context.find_root().command, {}, "geodelreg", "_GEODELREG_COMPLETE").source()
    if not install:
        click.echo(script)
        return
    from geodelreg.geotiff.atomic import write_text_atomically

    target = _place(name)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomically(target, script, overwrite=True)
    click.echo(f"Written: {shown(str(target))}. It holds in new shells.", err=True)
    if name == "zsh":
        click.echo("In ~/.zshrc, before compinit: fpath+=(${ZDOTDIR:-~}/.zfunc)", err=True)


def _place(shell: str) -> Path:
    """Where a shell looks for completions of its user."""
    home = Path.home()

    def folder(variable: str, otherwise: Path) -> Path:
        return Path(os.environ.get(variable) or otherwise)

    if shell == "bash":
        data = folder("XDG_DATA_HOME", home / ".local" / "share")
        own = folder("BASH_COMPLETION_USER_DIR", data / "bash-completion")
        return own / "completions" / "geodelreg"
    if shell == "fish":
        config = folder("XDG_CONFIG_HOME", home / ".config")
        return config / "fish" / "completions" / "geodelreg.fish"
    return folder("ZDOTDIR", home) / ".zfunc" / "_geodelreg"
