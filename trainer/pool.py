"""Where independent fits run: processes of this machine, this very process, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from firmware_iface.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Pool:
    """A `concurrent.futures` executor and how many tasks it runs at once."""

    executor: Executor
    workers: int

    def map(
        self,
        function: Callable[..., T],
        tasks: Iterable[tuple[Any, ...]],
        progress: Callable[[int], None] | None = None,
    ) -> list[T]:
        """Results of `function(*task)` in the order of the tasks; `progress` is told how many are done."""
        futures = [self.executor.submit(function, *task) for task in tasks]
        try:
            for done, _ in enumerate(as_completed(futures), 1):
                if progress:
                    progress(done)
            return [f.result() for f in futures]
        except BaseException:
            for f in futures:
                f.cancel()
            raise


def cores() -> int:
    """Processors this process may use; OMP_NUM_THREADS lowers it, as everywhere."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    told = os.environ.get("OMP_NUM_THREADS", "")
    return min(here, int(told)) if told.isdigit() and int(told) > 0 else here


@contextmanager
def open_pool(workers: int | None = None, cluster: str | None = None) -> Iterator[Pool]:
    """A pool of `workers` processes (default: one a processor; 1: this process), or of a Dask cluster's workers.

    Cluster workers need hololoop installed, and the capture set and effect files at the same paths. Raises
    InputError when the cluster does not answer.
    """
    if cluster is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise InputError("--cluster needs Dask: pip install 'hololoop[cluster]'") from error
        try:
            client = Client(cluster, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"no Dask scheduler answers at {cluster} ({error}): start one, or leave --cluster out"
            ) from error
        try:
            threads = sum(client.nthreads().values())
            yield Pool(client.get_executor(pure=False), max(1, threads))
        finally:
            client.close()
        return
    count = workers or cores()
    if count < 1:
        raise InputError(f"--workers {workers}: give a number of processes from 1 on")
    if count == 1:
        executor: Executor = _Here()
    else:
        executor = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _single_threaded)
    try:
        yield Pool(executor, count)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        _stop(executor)
        raise
    executor.shutdown()


class _Here(Executor):
    """Runs each task at once in this process, so that Ctrl-C stops it there and then."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """The finished future of a call."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _stop(executor: Executor) -> None:
    """End worker processes that are still busy: their results are no longer wanted."""
    for process in list((getattr(executor, "_processes", None) or {}).values()):
        process.terminate()


def _single_threaded() -> None:
    import signal

    import torch

    threading.Thread(target=_end_with_parent, daemon=True).start()

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


def _end_with_parent() -> None:
    """A worker whose parent was killed has nobody to work for, and would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
