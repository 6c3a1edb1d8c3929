"""Files and folders that appear whole or not at all.

What is written goes to a temporary neighbour, named `.NAME.<random>.part`, that takes the final name when
it is complete and on the disk. After an error nothing of it is left. After a crash only the neighbour is left,
and it can be deleted.
"""

from __future__ import annotations

import ctypes
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeGuard

from firmware_iface.errors import InputError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def whole_file(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open `path` for writing; it is replaced when the block ends without error.

    Parameters
    ----------
    path : path
    mode : str
        "wb", or "w" for text: UTF-8, and line ends are not changed.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    if mode not in ("wb", "w"):
        raise ValueError(f"mode is 'wb' or 'w', not {mode!r}")
    target = _resolved(path)
    if target.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file")
    temporary = _neighbour(target, "part")
    try:
        # "x" refuses a file that exists and, unlike mkstemp, respects the person's umask
        if mode == "wb":
            file: IO[Any] = open(temporary, "xb")  # noqa: SIM115 - closed below, before the rename
        else:
            file = open(temporary, "x", encoding="utf-8", newline="\n")  # noqa: SIM115
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        try:
            os.replace(temporary, target)
        except OSError as error:
            raise _cannot_write(path, error) from error
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if _is_full(error):
            raise _cannot_write(path, error) from error
        raise
    _sync(target.parent)


@contextmanager
def whole_folder(
    path: str | os.PathLike[str], *, replace: bool = False, keep: str | os.PathLike[str] | None = None
) -> Iterator[Path]:
    """Give an empty temporary folder to fill; it is renamed to `path` when the block ends without error.

    Linux exchanges two names at once. Elsewhere it takes two renames, so a reader may find no folder for an instant,
    but never a mixture.

    Parameters
    ----------
    path : path
    replace : bool
        Exchange a folder that exists and is not empty for the new one; otherwise it is refused.
    keep : path or None
        Where the folder that is replaced goes, in place of what is there; None: it is removed.

    Raises
    ------
    InputError
        For a folder that is not empty without `replace`, and where it cannot be written.
    """
    target = _resolved(path)
    _refuse_taken(path, target, replace)
    temporary = _neighbour(target, "part")
    try:
        temporary.mkdir()
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        yield temporary
        for folder, _, names in os.walk(temporary):
            for name in names:
                _sync(Path(folder, name))
            _sync(Path(folder))
        _refuse_taken(path, target, replace)
        try:
            if replace and target.exists():
                _swap(temporary, target, None if keep is None else _resolved(keep))
            else:
                os.rename(temporary, target)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise _taken(path) from error
            raise _cannot_write(path, error) from error
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if _is_full(error):
            raise _cannot_write(path, error) from error
        raise
    _sync(target.parent)


def _swap(new: Path, target: Path, keep: Path | None) -> None:
    """Put a new folder in place of an old one, which is removed or moved to `keep`."""
    if _exchange(new, target):
        old = new
    else:
        old = _neighbour(target, "old")
        os.rename(target, old)
        try:
            os.rename(new, target)
        except BaseException:
            os.rename(old, target)
            raise
    if keep is not None and not (keep.exists() and _exchange(old, keep)):
        shutil.rmtree(keep, ignore_errors=True)
        os.rename(old, keep)
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names at once; False where the system or the file system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of <linux/fs.h>
    return bool(rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0)


def _resolved(path: str | os.PathLike[str]) -> Path:
    """The path with its links followed, so that a link's target is replaced and not the link."""
    target = Path(os.path.realpath(path))
    if not target.name:
        raise InputError(f"{path} cannot be written; give the name of something in a folder")
    return target


def _refuse_taken(path: str | os.PathLike[str], target: Path, replace: bool) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(f"{path} is a file, and a folder is to be written; give another name or remove it")
    try:
        if not replace and any(target.iterdir()):
            raise _taken(path)
    except OSError as error:
        raise _cannot_write(path, error) from error


def _taken(path: str | os.PathLike[str]) -> InputError:
    return InputError(f"{path} is there already and is not empty; give another name or remove it")


def _neighbour(target: Path, suffix: str) -> Path:
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}.{suffix}")


def _cannot_write(path: str | os.PathLike[str], error: OSError) -> InputError:
    parent = Path(os.path.realpath(path)).parent
    if isinstance(error, FileNotFoundError) and not parent.exists():
        return InputError(f"{path} cannot be written: there is no folder {parent}; make it first")
    return InputError(f"{path} cannot be written: {error.strerror or error}")


def _is_full(error: BaseException) -> TypeGuard[OSError]:
    """Whether an error of writing says that there is no room, which it does without the file's name."""
    return isinstance(error, OSError) and error.errno in NO_ROOM and not error.filename


def _sync(path: Path) -> None:
    """Write it to the disk, so that it survives a power cut; file systems that cannot do so are left as they are."""
    if path.is_symlink():
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
