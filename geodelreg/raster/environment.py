"""GDAL's settings while a raster is open: a small block cache, errors as exceptions, no chatter."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

CACHE_BYTES = 64_000_000
"""GDAL's own default is 5 % of the RAM; 64 MB loses nothing when pieces are read block by block."""

PIECES_BYTES = 16_000_000
"""What the threads of a decimated read decode at a time; their pieces share no block."""

TILES_BYTES = 32_000_000
"""What tiles side by side share, in strips of 40 000 pixels too."""


class _CacheLimit:
    """GDAL has one cache for the process: the first user lowers its limit, the last restores it."""

    _lock = threading.Lock()

    def __init__(self) -> None:
        self._users = self._before = 0

    @contextmanager
    def at_most(self, limit: int, emptied: bool = False) -> Iterator[None]:
        """Keep the cache at a limit, or at what the user set, if less; then restore it."""
        from rasterio.env import get_gdal_config, set_gdal_config

        with self._lock:
            self._users += 1
            if self._users == 1:
                self._before = int(get_gdal_config("GDAL_CACHEMAX"))
                set_gdal_config("GDAL_CACHEMAX", min(self._before, limit))
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    if emptied:
                        set_gdal_config("GDAL_CACHEMAX", 0)
                    set_gdal_config("GDAL_CACHEMAX", self._before)


_open, _passing = _CacheLimit(), _CacheLimit()


def bounded_cache() -> AbstractContextManager[None]:
    """Keep GDAL's block cache at `CACHE_BYTES` or what the user set, if less; then restore it."""
    return _open.at_most(CACHE_BYTES)


@contextmanager
def passing_through(cache_bytes: int) -> Iterator[None]:
    """Read blocks that no one will ask for later on: they do not stay in GDAL's cache."""
    with _passing.at_most(cache_bytes, emptied=True):
        yield
    trim_heap()


def trim_heap() -> None:
    """Give freed memory back to the system: glibc keeps it, in pieces that large arrays miss."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


@contextmanager
def gdal_calls() -> Iterator[None]:
    """Wrap calls into GDAL: its messages go to the ``rasterio`` logger of this thread.

    It decodes in as many threads as the variable ``GDAL_NUM_THREADS`` says, by default on all
    cores.
    """
    import rasterio

    threads = os.environ.get("GDAL_NUM_THREADS", "ALL_CPUS")
    with rasterio.Env(GTIFF_IMPLICIT_JPEG_OVR=False, GDAL_NUM_THREADS=threads):
        yield
