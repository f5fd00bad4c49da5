"""Pages of the site that are no files of this folder: made from code, or at home in the root."""

from __future__ import annotations

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "cli")]

from docs.commands import cli_page  # noqa: E402
from docs.report_fields import report_page  # noqa: E402

AT_HOME = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add them."""
    pages = {"cli.md": cli_page(), "report.md": report_page()}
    for name, home in AT_HOME.items():
        pages[name] = (ROOT / home).read_text(encoding="utf-8").replace("](docs/", "](")
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files
