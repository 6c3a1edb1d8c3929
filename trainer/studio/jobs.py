"""Work outside the page's process: a process that is ready, does one task at a time, and can be ended at once.

A task is a function of a module, called as `task(say, *arguments)` in the process. `say("progress", (share, what))`
says how far it is; any other `say(name, value)` is news for whoever asked for the task.
"""

from __future__ import annotations

import errno
import logging
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

from firmware_iface.errors import DeviceError, InputError

Say = Callable[[str, Any], None]
ENDED = (
    "The process that did this work has ended, as when memory runs out or somebody ends it. The model is as it was: "
    "try again, with smaller captures if it happens again."
)
CANCELLED = "Cancelled; the model is as it was."
SHUTDOWN_S = 2.0
_LOG = logging.getLogger(__name__)


class WorkerProcess:
    """A process that `start` makes ready ahead of its first task, and that is started again after it was ended.

    Parameters
    ----------
    name : str
        For the list of processes.
    prepared : str, optional
        A module that the process imports before its first task comes.
    threads : int
        That torch may use.
    """

    def __init__(self, name: str, prepared: str = "", threads: int = 1) -> None:
        self._name, self._prepared, self._threads = name, prepared, threads
        self._lock = threading.RLock()
        self._process: Any = None
        self._connection: Connection | None = None
        self._heard: Say | None = None
        self._closed = False

    def start(self) -> None:
        """Start the process, where it does not run yet."""
        with self._lock:
            if self._process is None:
                self._start()

    @property
    def busy(self) -> bool:
        """Whether a task is in the process."""
        return self._heard is not None

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return None if self._process is None else self._process.pid

    def submit(self, task: Callable[..., Any], arguments: tuple[Any, ...], heard: Say) -> None:
        """Begin a task.

        Parameters
        ----------
        task : callable
            A function of a module.
        arguments : tuple
            After `say`; they are pickled.
        heard : callable
            Called in another thread with what the task says, and at last with ("done", result), ("failed", sentence)
            or ("cancelled", sentence).
        """
        with self._lock:
            if self.busy:
                raise InputError("other work is under way: wait for it, or cancel it")
            if self._process is None or not self._process.is_alive():
                self._start()
            assert self._connection is not None
            self._heard = heard
            connection = self._connection
            try:
                connection.send_bytes(pickle.dumps((task, arguments)))
            except OSError:
                self._heard = None
                heard("failed", ENDED)
                self._start()
                return
        threading.Thread(target=self._listen, args=(connection, heard), daemon=True).start()

    def cancel(self) -> bool:
        """End the task with its whole process group; False where there is none."""
        with self._lock:
            heard, self._heard = self._heard, None
            if heard is None:
                return False
            self._end()
            self._start()
        heard("cancelled", CANCELLED)
        return True

    def close(self) -> None:
        """End the process for good."""
        with self._lock:
            self._closed, self._heard = True, None
            self._end()

    def _start(self) -> None:
        if self._closed:
            return
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_work, args=(theirs, self._prepared, self._threads), name=self._name, daemon=False
        )
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is the server's
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None or process.pid is None:
            return
        for end in (signal.SIGTERM, signal.SIGKILL):
            with suppress(OSError):
                if os.getpgid(process.pid) == process.pid:
                    os.killpg(process.pid, end)
                else:  # it has not made its own group yet
                    os.kill(process.pid, end)
            process.join(SHUTDOWN_S)
            if not process.is_alive():
                break
        if self._connection is not None:
            self._connection.close()

    def _listen(self, connection: Connection, heard: Say) -> None:
        while True:
            try:
                kind, value = pickle.loads(connection.recv_bytes())
            except Exception as error:  # the process has ended, or sent what this one cannot read
                with self._lock:
                    if self._heard is not heard:  # cancelled or closed
                        return
                    self._heard = None
                    if not isinstance(error, EOFError | OSError):
                        _LOG.error("a result cannot be read", exc_info=error)
                    self._end()
                    self._start()
                heard("failed", ENDED)
                return
            with self._lock:
                if self._heard is not heard:
                    return
                if kind in ("done", "failed"):
                    self._heard = None
            heard(kind, value)
            if kind in ("done", "failed"):
                return


def picture_worker() -> WorkerProcess:
    """The process that predicts pictures, started: it takes seconds to import what it needs."""
    worker = WorkerProcess("hololoop studio: pictures", "trainer.studio.job_tasks")
    worker.start()
    return worker


def sentence_of(error: BaseException) -> str:
    """What went wrong, for a person, in one sentence."""
    if isinstance(error, InputError | DeviceError):
        return str(error)
    if isinstance(error, MemoryError):
        return "There is not enough memory for this: close other programs, or take smaller captures."
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "The disk is full: make room, and try again. The model is as it was."
    if isinstance(error, OSError):
        return f"{error.filename or 'A file'} cannot be used: {error.strerror or error}."
    text = (str(error).splitlines() or [""])[0]
    return f"This did not work ({type(error).__name__}: {text[:200]}). The terminal of the studio has the details."


def _work(connection: Connection, prepared: str, threads: int) -> None:
    """The process: tasks one after the other, until the server ends."""
    with suppress(OSError):
        os.setsid()  # a group of its own, which `cancel` ends with all that a task has started
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import torch

    if prepared:
        import_module(prepared)
    torch.set_num_threads(threads)
    sending = threading.Lock()

    def say(kind: str, value: Any) -> None:
        data = pickle.dumps((kind, value))
        with sending, suppress(OSError):  # the server has ended, and so does this process
            connection.send_bytes(data)

    while True:
        try:
            packed = connection.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            task, arguments = pickle.loads(packed)
            result = task(say, *arguments)
        except BaseException as error:
            if not isinstance(error, InputError | DeviceError):
                _LOG.error("a task failed", exc_info=error)
            say("failed", sentence_of(error))
        else:
            say("done", result)


def _end_with_parent() -> None:
    """Ends the process and all that it started when the server was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        with suppress(OSError):
            if os.getpgid(0) == os.getpid():
                os.killpg(0, signal.SIGKILL)
        os._exit(1)
