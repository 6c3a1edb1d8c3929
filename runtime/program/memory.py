"""How much memory there is for further processes."""

from __future__ import annotations

from pathlib import Path


def available_bytes(system: Path = Path("/")) -> int | None:
    """Memory that processes may still take, within the limit of a container; None where Linux does not say it.

    Parameters
    ----------
    system : Path
        Root of the files in which it does.

    References
    ----------
    proc(5): MemAvailable. Linux's guide to control groups, version 2: memory.max, memory.current, memory.stat.
    """
    free = _number_after("MemAvailable:", system / "proc/meminfo")
    if free is None:
        return None
    group = system / "sys/fs/cgroup"
    most, taken = _number_after("", group / "memory.max"), _number_after("", group / "memory.current")
    if most is None or taken is None:  # no container, or one without a limit: "max"
        return 1024 * free
    kept = _number_after("inactive_file", group / "memory.stat") or 0  # of files, given back when asked for
    return min(1024 * free, max(most - taken + kept, 0))


def _number_after(name: str, file: Path) -> int | None:
    """The whole number after a name at the beginning of a line; None where there is none."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return None
    words = next((line[len(name) :].split() for line in lines if line.startswith(name)), [])
    return int(words[0]) if words and words[0].isdigit() else None
