"""A worker keeps what it has read, up to a number of bytes, and sees when a file has changed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trainer.captures import kept_pictures, png_reader
from trainer.captures.kept_pictures import keep_pictures, kept_bytes
from trainer.captures.png_reader import PictureError, read_picture
from trainer.fitting.pool import open_pool

SHAPE = (20, 30)


@pytest.fixture(autouse=True)
def _kept_by_none() -> Iterator[None]:
    yield
    keep_pictures(0)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are really read."""
    names: list[str] = []
    real = png_reader._read

    def read(path: Path, *given: object) -> np.ndarray:
        names.append(path.name)
        return real(path, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(png_reader, "_read", read)
    return names


def picture(path: Path, value: int) -> Path:
    Image.fromarray(np.full(SHAPE, value, np.uint8)).save(path)
    return path


def level(path: Path) -> int:
    return int(read_picture(path, SHAPE, 8, "it").max())


def test_only_who_asks_keeps_pictures(tmp_path: Path, reads: list[str]) -> None:
    path = picture(tmp_path / "a.png", 3)
    assert [level(path), level(path)] == [3, 3]
    assert (len(reads), kept_bytes()) == (2, 0)
    keep_pictures()
    assert [level(path) for _ in range(4)] == [3] * 4
    assert (len(reads), kept_bytes()) == (3, 600)
    with pytest.raises(ValueError, match="read-only"):
        read_picture(path, SHAPE, 8, "it")[0, 0] = 1
    keep_pictures(0)
    assert kept_bytes() == 0


def test_a_changed_file_is_read_again_and_a_wrong_size_is_still_refused(tmp_path: Path) -> None:
    keep_pictures()
    path = picture(tmp_path / "a.png", 3)
    assert level(path) == 3
    picture(path, 4)
    os.utime(path, ns=(1, 1))
    assert level(path) == 4
    with pytest.raises(PictureError, match="wrong_size|20 x 30"):
        read_picture(path, (10, 10), 8, "it")
    path.unlink()
    with pytest.raises(PictureError, match="put the file back"):
        level(path)


def test_those_that_were_not_used_for_longest_go_first(tmp_path: Path, reads: list[str]) -> None:
    keep_pictures(2 * 600)
    a, b, c = (picture(tmp_path / f"{name}.png", 1) for name in "abc")
    for path in (a, b, a, c, a, b):
        level(path)
    assert reads == ["a.png", "b.png", "c.png", "b.png"]
    assert kept_bytes() == 1200


def test_workers_of_a_pool_keep_pictures() -> None:
    assert kept_pictures._limit == 0
    with open_pool(2) as pool:
        kept = pool.map(
            eval, [("__import__('trainer.captures.kept_pictures').captures.kept_pictures._limit",)]
        )
    assert kept == [kept_pictures.KEPT_BYTES]
    assert kept_pictures._limit == 0
