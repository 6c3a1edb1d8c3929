"""The socket at which programs connect."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.service.systemd import passed_socket


def listening_socket(path: Path, backlog: int) -> socket.socket:
    """The socket that systemd passed, or else a new one at `path`.

    Parameters
    ----------
    path : Path
        Path of the Unix socket.
    backlog : int
        Programs that may wait to be accepted.

    Raises
    ------
    InputError
        Where another service listens at `path`, or the socket cannot be made there.
    """
    return passed_socket() or _bound_socket(str(path), backlog)


def _bound_socket(path: str, backlog: int) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            try:
                probe.connect(path)
                raise InputError(f"another service listens at {path}: stop it, or give another socket")
            except ConnectionRefusedError:  # a service that was killed left it
                os.unlink(path)
            except FileNotFoundError:
                pass
        listener.bind(path)
        os.chmod(path, 0o660)
        listener.listen(backlog)
    except OSError as error:
        listener.close()
        raise InputError(
            f"{path} cannot be listened at ({error.strerror or error}): check its folder"
        ) from None
    except InputError:
        listener.close()
        raise
    return listener
