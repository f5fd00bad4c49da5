"""Completion, installed by one command and asked by a real shell."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PLACES = {
    "bash": ".local/share/bash-completion/completions/geodelreg",
    "fish": ".config/fish/completions/geodelreg.fish",
    "zsh": ".zfunc/_geodelreg",
}


def run(*args: str, home: Path, shell: str = "") -> subprocess.CompletedProcess[str]:
    """``python -m geodelreg completion`` of a user with a home and a shell of their own."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "BASH_", "ZDOT"))}
    command = [sys.executable, "-m", "geodelreg", "completion", *args]
    return subprocess.run(
        command, capture_output=True, text=True, env=env | {"HOME": str(home), "SHELL": shell}
    )


@pytest.mark.parametrize("shell", PLACES)
def test_it_is_installed_for_the_shell_in_use(shell: str, tmp_path: Path) -> None:
    done = run("--install", home=tmp_path, shell=f"/usr/bin/{shell}")
    assert done.returncode == 0, done.stderr
    (written,) = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written == tmp_path / PLACES[shell]
    assert str(written) in done.stderr
    assert written.read_text().strip() == run(shell, home=tmp_path).stdout.strip()
    assert run("--install", home=tmp_path, shell=shell).returncode == 0  # once more


def test_an_unknown_shell_is_asked_for(tmp_path: Path) -> None:
    done = run("--install", home=tmp_path, shell="/bin/tcsh")
    assert done.returncode == 2
    assert "bash, zsh, fish" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_bash_completes_commands_options_and_values(tmp_path: Path) -> None:
    assert run("--install", home=tmp_path, shell="bash").returncode == 0
    program = tmp_path / "geodelreg"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m geodelreg "$@"\n')
    program.chmod(0o755)

    def complete(*words: str) -> list[str]:
        script = f"""source {PLACES["bash"]}
        COMP_WORDS=({" ".join(words)}) COMP_CWORD={len(words) - 1}
        _geodelreg_completion ./geodelreg
        printf '%s\\n' "${{COMPREPLY[@]}}" """
        done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True)
        return done.stdout.split()

    assert complete("geodelreg", "al") == ["align"]
    assert complete("geodelreg", "align", "--search-r") == ["--search-radius"]
    assert complete("geodelreg", "align", "--grid", "p") == ["pan"]
