"""Fixtures of the command's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.helpers import Command, copy_corner, copy_samples, run_command


@pytest.fixture(scope="session")
def geodelreg() -> Command:
    """Run the command; returns the completed process."""
    return run_command


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Folder with ms.tif and pan.tif: a corner of the sample pair."""
    return copy_corner(tmp_path)


@pytest.fixture
def whole_pair(tmp_path: Path) -> Path:
    """Folder with ms.tif and pan.tif: the sample pair, whose header error is known."""
    return copy_samples(tmp_path)
