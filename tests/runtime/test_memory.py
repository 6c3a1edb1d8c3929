"""How much memory there is for further processes, as Linux says it."""

from __future__ import annotations

from pathlib import Path

from runtime.program.memory import available_bytes

GIB = 2**30


def linux(folder: Path, **groups: str) -> Path:
    """A system's files: 8 GiB are available; what a container's files say."""
    (folder / "proc").mkdir()
    (folder / "proc/meminfo").write_text(
        "MemTotal: 16777216 kB\nMemFree: 1024 kB\nMemAvailable:    8388608 kB\n"
    )
    (folder / "sys/fs/cgroup").mkdir(parents=True)
    for name, text in groups.items():
        (folder / "sys/fs/cgroup" / f"memory.{name}").write_text(text)
    return folder


def test_what_linux_calls_available_is(tmp_path: Path) -> None:
    assert available_bytes(linux(tmp_path)) == 8 * GIB


def test_a_container_has_what_its_limit_leaves(tmp_path: Path) -> None:
    stat = f"anon {2 * GIB}\ninactive_file {GIB}\n"
    system = linux(tmp_path, max=f"{5 * GIB}\n", current=f"{3 * GIB}\n", stat=stat)
    assert available_bytes(system) == 3 * GIB  # a GiB of files is given back when asked for


def test_a_container_without_a_limit_has_all(tmp_path: Path) -> None:
    assert available_bytes(linux(tmp_path, max="max\n", current=f"{3 * GIB}\n")) == 8 * GIB


def test_another_system_does_not_say(tmp_path: Path) -> None:
    assert available_bytes(tmp_path) is None
