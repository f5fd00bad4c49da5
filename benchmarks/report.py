"""Sections of ``docs/benchmarks.md``, each replaced by the command that measures it."""

from __future__ import annotations

import os
import platform
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
PAGE_HEAD = """# Benchmarks

Tables are written by the commands they name, what they say and where the time goes by hand;
`benchmarks/README.md` says how to run them. Errors, but for real pairs, are in PAN pixels over
21 × 21 check points of the MS raster, against the known truth.
"""


def replace_section(page: Path, name: str, text: str) -> None:
    """Put `text` between the markers of a section, adding the section where there is none.

    Parameters
    ----------
    page : Path
        Markdown file, made when missing.
    name : str
    text : str
        Markdown, its heading included.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    old = page.read_text(encoding="utf-8") if page.exists() else PAGE_HEAD
    block = f"{begin}\n{text.strip()}\n{end}"
    if begin in old and end in old:
        head, rest = old.split(begin, 1)
        new = head + block + rest.split(end, 1)[1]
    else:
        new = f"{old.rstrip()}\n\n{block}\n"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(new, encoding="utf-8")


def machine() -> str:
    """Processor, interpreter, and how busy others keep it, for the caption of a table."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    load = f"load {os.getloadavg()[0]:.1f}"
    return f"{os.cpu_count()} cores, {model}, Python {platform.python_version()}, {load}"
