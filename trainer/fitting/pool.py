"""Where independent fits run: processes of this machine, this very process, or a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    InvalidStateError,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext
from typing import TYPE_CHECKING, Any, TypeVar

from threadpoolctl import threadpool_limits

from firmware_iface.errors import InputError
from runtime.program.large_blocks import give_back_blocks, keep_large_blocks
from runtime.program.threads import cores
from trainer.captures.kept_pictures import keep_pictures

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")

TASKS = "trainer.diagnosis.diagnosis"  # what workers run is imported by it
ANSWER_S = 5.0  # a Dask scheduler that has not answered by then is not there
LOST = (
    "a process that was fitting has ended, as when memory runs out: "
    "use fewer --workers or smaller captures, and try again"
)


@dataclass(frozen=True)
class Pool:
    """Where independent tasks run.

    Attributes
    ----------
    executor : concurrent.futures.Executor
    workers : int
        How many tasks run at once.
    elsewhere : bool
        In other processes.
    """

    executor: Executor
    workers: int
    elsewhere: bool = True

    def map(
        self,
        function: Callable[..., T],
        tasks: Iterable[tuple[Any, ...]],
        progress: Callable[[int], None] | None = None,
    ) -> list[T]:
        """Results of `function(*task)` in the order of the tasks.

        Parameters
        ----------
        progress : callable, optional
            Called with how many tasks are done.

        Raises
        ------
        InputError
            When a process that works on tasks is lost; whatever the function raises otherwise.
        """
        futures = [self.submit(function, task) for task in tasks]
        try:
            for done, _ in enumerate(as_completed(futures), 1):
                if progress:
                    progress(done)
            return [self.result(f) for f in futures]
        except (BrokenExecutor, CancelledError) as error:
            raise InputError(LOST) from error
        except BaseException:
            for f in futures:
                f.cancel()
            raise

    def map_here_if_one(self, function: Callable[..., T], tasks: Sequence[tuple[Any, ...]]) -> list[T]:
        """As `map`, but a single task runs in this process, which may use all cores for it."""
        return [function(*tasks[0])] if len(tasks) == 1 else self.map(function, tasks)

    def submit(self, function: Callable[..., Any], task: tuple[Any, ...]) -> Future[Any]:
        """The future of `function(*task)`, for `result`."""
        if self.elsewhere:
            give_back_blocks()  # what this process has free, tasks may need
            return self.executor.submit(_packed, pickle.dumps((function, task)))
        return self.executor.submit(function, *task)

    def result(self, future: Future[Any]) -> Any:
        """What a task returned, or raises what it raised; waits for it."""
        return pickle.loads(future.result()) if self.elsewhere else future.result()


@contextmanager
def open_pool(workers: int | None = None, cluster: str | None = None) -> Iterator[Pool]:
    """A pool of processes, or of a Dask cluster.

    Cluster workers need hololoop installed, and the capture set and effect files at the same paths.

    Parameters
    ----------
    workers : int, optional
        Processes: one a processor by default; with 1, tasks run in this process.
    cluster : str, optional
        Address of a Dask scheduler.

    Raises
    ------
    InputError
        When the cluster does not answer, has no workers, or its workers have no hololoop.
    """
    if cluster is not None:
        with _cluster(cluster) as pool:
            yield pool
        return
    count = workers or cores()
    if count < 1:
        raise InputError(f"--workers {workers}: give a number of processes from 1 on")
    if count == 1:
        yield Pool(_ThisProcess(), 1, elsewhere=False)
        return
    context = _beginning()
    executor = _Processes(count, context, _single_threaded)
    if (
        context.get_start_method() == "spawn"
    ):  # each imports by itself, while this process looks at the captures
        for _ in range(count):
            executor.submit(import_module, TASKS)
    try:
        yield Pool(executor, count)
    except BaseException:
        for process in list((executor._processes or {}).values()):
            process.terminate()
        # Waits for Python's own thread, which otherwise may close a pipe that the end of the program still writes to.
        executor.shutdown(cancel_futures=True)
        raise
    executor.shutdown()


@contextmanager
def _cluster(address: str) -> Iterator[Pool]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise InputError("--cluster needs Dask: pip install 'hololoop[cluster]'") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # the InputError below says it
    try:
        _greet(address)
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except Exception as error:  # whatever a stranger at that address may have said
        raise InputError(
            f"no Dask scheduler answers at {address!r} ({_refusal(error, address)}): start one, or leave --cluster out"
        ) from error
    try:
        _prepare(client, address)
        yield Pool(client.get_executor(pure=False), max(1, sum(client.nthreads().values())))
    except KilledWorker as error:
        raise InputError(LOST) from error
    finally:
        client.close(timeout=ANSWER_S)


def _refusal(error: BaseException, address: str) -> str:
    """Why there is no scheduler: nobody answers, or somebody else does."""
    from distributed.comm import get_address_host_port

    try:  # Dask's last attempt may have ended with its time, before it was refused
        socket.create_connection(get_address_host_port(address), 0.2 * ANSWER_S).close()
    except ConnectionRefusedError:
        return "nobody answers there: the connection was refused"
    except (OSError, ValueError):
        pass  # `error` says more
    if isinstance(error, TimeoutError) and not str(error):
        return f"nobody answers there within {ANSWER_S:g} s"
    known = str(error) if isinstance(error, OSError | ValueError) else ""
    return known or "what is there does not speak Dask"


def _greet(address: str) -> None:
    """Waits for a scheduler's first message, for which a client alone would wait without limit."""
    import asyncio

    from distributed.comm import connect

    async def greeted() -> None:
        comm = await connect(address, timeout=0.8 * ANSWER_S)  # it says why; the limit below does not
        comm.abort()

    with ThreadPoolExecutor(1) as thread:  # a notebook's own thread already runs a loop
        thread.submit(lambda: asyncio.run(asyncio.wait_for(greeted(), ANSWER_S))).result()


def _prepare(client: Client, address: str) -> None:
    """Checks that there are workers and that they have hololoop, and makes them read effect files again."""
    if not client.nthreads():
        raise InputError(
            f"the Dask scheduler at {address} has no workers: start one with: dask worker {address}"
        )
    try:
        client.run(import_module, __name__)
        client.run(_forget)
    except ImportError as error:
        raise InputError(
            f"a Dask worker of {address} cannot use hololoop ({error}): "
            "install it there, with the extra 'trainer'"
        ) from error


def _forget() -> None:
    """Imports what a worker needs, so that a missing package shows early; drops effect files of earlier runs."""
    for name in (TASKS, "trainer.effects.effect_catalogue"):
        import_module(name)
    import_module("trainer.effects.effect_catalogue").forget_effect_files()


class _ThisProcess(Executor):
    """Runs each task at once in this process, so that Ctrl-C stops it immediately."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """The finished future of a call."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Processes(ProcessPoolExecutor):
    """Processes that Ctrl-C does not reach, from their start: their parent handles it."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """The future of a call; starts a process where one is missing."""
        with _without_ctrl_c():
            future = super().submit(fn, *args, **kwargs)
        fail = future.set_exception

        def failed(error: BaseException | None) -> None:
            # Where processes are lost, Python's own thread tells all tasks, and ends in a traceback at a cancelled one.
            with suppress(InvalidStateError):
                fail(error)

        future.set_exception = failed  # type: ignore[method-assign, assignment]
        return future


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes that are started here do not hear Ctrl-C."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _packed(task: bytes) -> bytes:
    """Runs a task; a worker that cannot read it returns the error, where Dask itself would never answer.

    Results are bytes because torch otherwise passes tensors through sockets and shared memory.
    """
    # Dask starts its workers so that they give back every temporary; also those that join later are told here.
    keep_large_blocks()
    keep_pictures()  # tasks carry paths, and the next one is often of the same captures
    function, arguments = pickle.loads(task)
    threadpool_limits(1, user_api="blas")  # what the task needs is loaded now
    result = pickle.dumps(function(*arguments))
    give_back_blocks()
    return result


def _beginning() -> BaseContext:
    """How processes begin: as copies of one that imports what tasks need, while this one looks at the captures."""
    if sys.platform != "linux":  # elsewhere a copy of a process that holds numerical libraries may fail
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([TASKS])
    try:
        resource_tracker.ensure_running()  # first, because its start lets Ctrl-C through again
        with _without_ctrl_c():
            forkserver.ensure_running()
    except OSError:  # the path of the temporary folder is too long for a socket
        return multiprocessing.get_context("spawn")
    return context


def _single_threaded() -> None:
    import torch

    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where there are no masks


def _end_with_parent() -> None:
    """Ends a worker whose parent was killed, which would otherwise wait for tasks without limit."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
