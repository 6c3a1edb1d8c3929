"""Independent tasks whose failures cost only themselves, also where the process that runs one is lost."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from typing import Any, TypeVar

from firmware_iface.errors import InputError
from trainer.fitting.pool import Pool, open_pool

T = TypeVar("T")

LOST = "the process that worked on it has ended, as when memory runs out: use fewer --workers, or smaller captures"
CLUSTER_LOST = (
    "the Dask cluster is gone: start it again, and then the same command, which goes on from what is finished"
)


def outcomes(
    function: Callable[..., T], tasks: Sequence[tuple[Any, ...]], workers: int, cluster: str | None
) -> Generator[tuple[int, T | Exception], None, None]:
    """(number of the task, what it returned or what it raised), as tasks end.

    A process of this machine that is lost takes others with it. Their tasks are done again, one at a time, so that a
    second loss tells which one it was. A Dask cluster gives the tasks of a lost worker to other ones by itself.

    Parameters
    ----------
    function : callable
        Called with the elements of a task.
    workers : int
        Processes of this machine; with 1, tasks run in this process.
    cluster : str or None
        Address of a Dask scheduler to use instead.

    Raises
    ------
    InputError
        When the cluster does not answer, has no workers, or is lost.
    """
    left = list(range(len(tasks)))
    suspects: list[int] = []
    while left:
        before = len(left)
        with open_pool(workers, cluster) as pool:
            at_once = len(tasks) if cluster is not None else pool.workers
            yield from _ended(pool, function, tasks, left, at_once, suspects)
        if len(left) == before:
            raise InputError(LOST)
    for k in suspects:
        lost: list[int] = []
        with open_pool(2) as pool:  # one alone would be this process
            yield from _ended(pool, function, tasks, [k], 1, lost)
        if lost:
            yield k, InputError(LOST)


def _ended(
    pool: Pool,
    function: Callable[..., T],
    tasks: Sequence[tuple[Any, ...]],
    left: list[int],
    at_once: int,
    suspects: list[int],
) -> Iterator[tuple[int, T | Exception]]:
    """Outcomes until all of `left` are done or the pool breaks; what ran at that moment goes to `suspects`."""
    running: dict[Future[Any], int] = {}
    broken = False
    while running or (left and not broken):
        while left and len(running) < at_once and not broken:
            try:
                running[pool.submit(function, tasks[left[0]])] = left[0]
                del left[0]
            except BrokenExecutor:
                broken = True
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            k = running.pop(future)
            outcome: T | Exception
            try:
                outcome = pool.result(future)
            except BrokenExecutor:
                broken = True
                suspects.append(k)
                continue
            except CancelledError:
                raise InputError(CLUSTER_LOST) from None
            except Exception as error:
                killed = type(error).__name__ == "KilledWorker"  # Dask's, which need not be installed
                outcome = InputError(LOST) if killed else error
            yield k, outcome
