"""Where pairs run: in threads here, on any executor of `concurrent.futures`, or on Dask.

All are one thing to the driver: text goes in, a future of text comes out.
"""

from __future__ import annotations

import logging
import os
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from typing import Any

from geodelreg.batch.supervisor import Children, run_pair
from geodelreg.errors import ClusterError, MissingExtraError

logger = logging.getLogger(__name__)

_PER_THREAD = 4
_RESUME = "Once it runs, go on with `resume=True`: what is finished is not repeated."


class Workers:
    """Any executor; whoever made it ends it, and a broken one says so with the futures.

    Attributes
    ----------
    at_once : int
        Pairs that are worth having under way.
    """

    def __init__(self, executor: Executor, at_once: int) -> None:
        self._executor, self.at_once = executor, at_once

    def submit(self, text: str) -> Future[str]:
        """Let a task run."""
        try:
            return self._executor.submit(run_pair, text)
        except RuntimeError as error:  # broken, or shut down
            raise ClusterError(f"the executor takes no more pairs ({error})", _RESUME) from error

    def check(self) -> None:
        """Raise `ClusterError` when the workers are lost for good."""

    def close(self) -> None:
        """Let go of them; what is under way is not waited for."""


class LocalWorkers(Workers):
    """Threads of this process, with a child each."""

    def __init__(self, count: int) -> None:
        super().__init__(ThreadPoolExecutor(count, thread_name_prefix="pair"), count)
        self._children = Children()

    def submit(self, text: str) -> Future[str]:
        """Let a task run."""
        return self._executor.submit(self._children.run, text)

    def close(self) -> None:
        """End the children."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._children.stop()
        self._executor.shutdown(wait=True)


class DaskWorkers(Workers):
    """A cluster of Dask, through its client; without a `count` four pairs for each thread of it."""

    def __init__(self, client: Any, count: int, owned: bool = False) -> None:
        super().__init__(client.get_executor(pure=False, retries=0), count or _PER_THREAD)
        self._client = client
        self._grows = not count
        self._owned = owned
        self._alone = False

    def submit(self, text: str) -> Future[str]:
        """Let a task run."""
        try:
            return self._executor.submit(run_pair, text)
        except Exception as error:
            raise ClusterError(f"the cluster takes no more pairs ({error})", _RESUME) from error

    def check(self) -> None:
        """See that the scheduler is there, and how many threads the cluster has now."""
        if self._client.status != "running":
            raise ClusterError(
                f"the connection to Dask's scheduler is {self._client.status}", _RESUME
            )
        try:
            threads = int(sum(self._client.nthreads().values()))
        except OSError as error:  # a timeout and Dask's CommClosedError are such, too
            raise ClusterError(
                f"the connection to Dask's scheduler is lost ({error})", _RESUME
            ) from error
        if self._grows:
            self.at_once = _PER_THREAD * max(threads, 1)
        if not (threads or self._alone):
            self._alone = True
            logger.warning("the cluster has no workers now; the pairs wait for some")

    def close(self) -> None:
        """Take back what has not begun."""
        self._executor.shutdown(wait=False)
        if self._owned:
            self._client.close()


def _cores() -> int:
    """Cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1


def workers_of(executor: Any, count: int) -> Workers:
    """Who runs the pairs.

    Parameters
    ----------
    executor : None, str, concurrent.futures.Executor or dask.distributed.Client
        None for this machine; a text is the address of Dask's scheduler.
    count : int
        Pairs at a time; 0 = what fits.

    Raises
    ------
    MissingExtraError
        An address, and Dask is not installed.
    ClusterError
        Nobody answers at the address.
    """
    if executor is None:
        return LocalWorkers(count or _cores())
    if isinstance(executor, Executor):
        known = getattr(executor, "_max_workers", None)
        usual = 2 * (known if isinstance(known, int) else os.cpu_count() or 1)
        return Workers(executor, count or usual)
    if isinstance(executor, str):
        return DaskWorkers(_connected(executor), count, owned=True)
    return DaskWorkers(executor, count)


def _connected(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            "a batch on a cluster needs Dask, which is not installed",
            "Install it: pip install dask distributed (in a clone: pip install '.[batch]').",
        ) from error
    try:
        return Client(address, timeout=30)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"no scheduler of Dask answers at {address} ({error})", "Check the address."
        ) from error


def lost(error: BaseException) -> bool:
    """Whether a future failed because its worker was lost, so that the pair may run elsewhere."""
    return type(error).__name__ in ("KilledWorker", "FutureCancelledError") or isinstance(
        error, CancelledError
    )
