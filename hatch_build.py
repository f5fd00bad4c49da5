"""Adds the manual pages, which are made from the commands, to the wheel."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ManualPages(BuildHookInterface[Any]):
    """Puts a page a command where ``man`` looks below an installation's prefix."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Make the pages before the wheel is packed."""
        sys.path[:0] = [self.root, str(Path(self.root, "cli"))]
        from docs.commands import man_pages

        self.folder = tempfile.TemporaryDirectory()
        for name, text in man_pages().items():
            path = Path(self.folder.name, name)
            path.write_text(text, encoding="utf-8")
            build_data["shared_data"][str(path)] = f"share/man/man1/{name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Take away what was packed."""
        self.folder.cleanup()
