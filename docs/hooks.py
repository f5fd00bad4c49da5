"""What mkdocs adds to the pages of this folder: pages of the repository's root."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages that are no files of this folder."""
    for name, source in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        content = re.sub(r"\]\(docs/", "](", text)
        files.append(File.generated(config, name, content=content))
    return files
