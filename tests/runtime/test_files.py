from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from runtime.bundle import whole_files as files
from runtime.bundle.whole_files import whole_file, whole_folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with whole_file(path) as file:
        file.write(b"half")
        file.flush()
        assert not path.exists()
        file.write(b" and half")
    assert path.read_bytes() == b"half and half"
    assert names(tmp_path) == ["a.bin"]


def test_text_is_utf8_with_the_lines_as_written(tmp_path: Path) -> None:
    with whole_file(tmp_path / "a.txt", "w") as file:
        file.write("λ\n")
    assert (tmp_path / "a.txt").read_bytes() == "λ\n".encode()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_after_an_error_the_old_file_stands_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), whole_file(path) as file:
        file.write(b"new")
        raise error
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_names_the_file_or_the_folder(tmp_path: Path, number: int) -> None:
    with (
        pytest.raises(InputError, match=r"model.toml cannot be written: "),
        whole_file(tmp_path / "model.toml"),
    ):
        raise OSError(number, os.strerror(number))
    with pytest.raises(InputError, match=r"bundle cannot be written: "), whole_folder(tmp_path / "bundle"):
        raise OSError(number, os.strerror(number))
    with pytest.raises(OSError, match="elsewhere"), whole_file(tmp_path / "model.toml"):
        raise OSError(number, os.strerror(number), "elsewhere")
    assert not names(tmp_path)


def test_a_file_that_is_too_large_for_the_disk_is_one_line(tmp_path: Path) -> None:
    """With the limit that a process has for its files, which is met as a full disk is."""
    script = (
        "import resource, sys; from runtime.bundle.whole_files import whole_file\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        f"with whole_file({str(tmp_path / 'a.bin')!r}) as file: file.write(bytes(100000))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1].startswith(
        f"firmware_iface.errors.InputError: {tmp_path / 'a.bin'} cannot be written: "
    )
    assert not names(tmp_path)


def test_a_file_has_the_permissions_that_open_would_give(tmp_path: Path) -> None:
    with whole_file(tmp_path / "a"):
        pass
    (tmp_path / "b").touch()
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in "ab"}
    assert len(modes) == 1


def test_a_link_stays_and_its_target_is_written(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("real")
    with whole_file(tmp_path / "link") as file:
        file.write(b"x")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"x"


def test_what_cannot_be_written_is_said_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"), whole_file(tmp_path / "none" / "a"):
        pytest.fail("the block ran")
    with pytest.raises(InputError, match="is a folder"), whole_file(tmp_path):
        pytest.fail("the block ran")
    with pytest.raises(InputError, match="no folder"), whole_folder(tmp_path / "none" / "a"):
        pytest.fail("the block ran")
    with pytest.raises(ValueError, match="mode"), whole_file(tmp_path / "a", "ab"):
        pytest.fail("the block ran")


def test_a_folder_appears_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "set"
    with whole_folder(path) as folder:
        assert folder.parent == tmp_path
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("1")
        assert not path.exists()
    assert (path / "sub" / "a").read_text() == "1"
    assert names(tmp_path) == ["set"]


def test_a_full_folder_is_refused_and_an_empty_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "set"
    path.mkdir()
    with whole_folder(path) as folder:
        (folder / "a").write_text("1")
    with pytest.raises(InputError, match="not empty"), whole_folder(path):
        pytest.fail("the block ran")
    assert (path / "a").read_text() == "1"
    with pytest.raises(InputError, match="is a file"), whole_folder(path / "a", replace=True):
        pytest.fail("the block ran")


def test_a_folder_that_fills_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "set"
    with pytest.raises(InputError, match="not empty"), whole_folder(path):
        path.mkdir()
        (path / "theirs").touch()
    assert names(tmp_path) == ["set"]
    assert names(path) == ["theirs"]


def test_replacing_leaves_nothing_of_the_old(tmp_path: Path) -> None:
    path = tmp_path / "set"
    for name in ("old", "new"):
        with whole_folder(path, replace=True) as folder:
            (folder / name).touch()
    assert names(path) == ["new"]
    assert names(tmp_path) == ["set"]


def test_after_an_error_the_old_folder_stands_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "set"
    with whole_folder(path) as folder:
        (folder / "old").touch()
    with pytest.raises(RuntimeError), whole_folder(path, replace=True) as folder:
        (folder / "new").touch()
        raise RuntimeError
    assert names(path) == ["old"]
    assert names(tmp_path) == ["set"]


def test_a_swap_that_fails_half_way_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "set"
    with whole_folder(path) as folder:
        (folder / "old").touch()
    rename = os.rename

    def fails_for_the_new(source: Path, target: Path) -> None:
        if Path(source).suffix == ".part":
            raise OSError(errno.EIO, "the disk is gone")
        rename(source, target)

    monkeypatch.setattr(files, "_exchange", lambda one, other: False)  # as on a system that cannot
    monkeypatch.setattr(os, "rename", fails_for_the_new)
    with pytest.raises(InputError, match="the disk is gone"), whole_folder(path, replace=True) as folder:
        (folder / "new").touch()
    assert names(path) == ["old"]
    assert names(tmp_path) == ["set"]


@pytest.mark.parametrize("at_once", [True, False])
def test_what_is_replaced_can_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: bool) -> None:
    """The last one only, whether the system exchanges names at once or not."""
    if not at_once:
        monkeypatch.setattr(files, "_exchange", lambda one, other: False)
    path, kept = tmp_path / "set", tmp_path / "set.previous"
    for name in ("first", "second", "third"):
        with whole_folder(path, replace=True, keep=kept) as folder:
            (folder / name).touch()
    assert names(path) == ["third"] and names(kept) == ["second"]
    assert names(tmp_path) == ["set", "set.previous"]


def test_a_killed_replacement_leaves_a_whole_folder(tmp_path: Path) -> None:
    """kill -9 at any moment: both files are of one generation, and the folder is never missing."""
    script = (
        "import sys\n"
        "from runtime.bundle.whole_files import whole_folder\n"
        "for n in range(100000):\n"
        "    with whole_folder(sys.argv[1], replace=True, keep=sys.argv[1] + '.previous') as folder:\n"
        "        for name in 'ab':\n"
        "            (folder / name).write_text(str(n))\n"
        "    print(n, flush=True)\n"
    )
    path = tmp_path / "set"
    for wait in (0.0, 0.003, 0.011, 0.023):
        with subprocess.Popen(
            [sys.executable, "-c", script, str(path)],
            stdout=subprocess.PIPE,
            cwd=Path(files.__file__).parents[1],
        ) as writer:
            assert writer.stdout is not None
            for _ in range(3):
                writer.stdout.readline()
            time.sleep(wait)
            writer.kill()
        assert (path / "a").read_text() == (path / "b").read_text()
        assert names(tmp_path / "set.previous") == ["a", "b"]
