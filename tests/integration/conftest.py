"""A server that counts requests, for the tests of what is opened."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integration.loopback import SERVER, Server
from tests.integration.raster_samples import make_tiff


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    served = make_tiff(tmp_path / "served.tif", "striped", shape=(400, 400))
    log = tmp_path / "requests.txt"
    with subprocess.Popen(
        [sys.executable, "-c", SERVER, str(log), str(served)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield Server(f"http://127.0.0.1:{int(process.stdout.readline())}", log)
        process.kill()
