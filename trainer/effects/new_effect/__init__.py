"""Writes a file with a working effect to edit, and its test, for each of the four stages.

The template files next to this one are what is written, with the new name in place of `my_effect`.
"""

from __future__ import annotations

import importlib.util
import keyword
import re
import sys
from collections.abc import Iterable
from pathlib import Path

from firmware_iface.errors import InputError, nearest
from runtime.bundle.whole_files import whole_file

STAGES = ("drive", "panel", "pupil", "sensor")

EXAMPLES: dict[str, dict[str, float]] = {
    "drive": {"cosine": 0.25, "sine": -0.2, "cycles": 6.3},
    "panel": {"cosine": 0.12, "sine": -0.16, "period": 7.3},
    "pupil": {"depth": 0.8, "position": 0.31, "angle": 84.0, "width": 0.07},
    "sensor": {"cosine": 0.12, "sine": -0.1, "period": 13.7, "angle": 33.0},
}

_USED = (  # names that the files use themselves
    "annotations",
    "effect",
    "math",
    "np",
    "pull",
    "replace",
    "torch",
    "waves",
)


def write_new_effect(name: str, stage: str, folder: Path, taken: Iterable[str] = ()) -> list[Path]:
    """Write NAME.py and test_NAME.py into a folder.

    Parameters
    ----------
    name : str
        Of the effect and its function.
    stage : str
        One of STAGES.
    folder : Path
    taken : iterable of str
        Names of effects that exist already.

    Returns
    -------
    list of Path
        The two files.

    Raises
    ------
    InputError
        For a name that cannot be a function's or is taken, an unknown stage, or a file that exists already.
    """
    _check_name(name, list(taken))
    if stage not in STAGES:
        raise InputError(f"--stage {stage}: {nearest(stage, STAGES)}")
    paths = [folder / f"{name}.py", folder / f"test_{name}.py"]
    for path in paths:
        if path.exists() or path.is_symlink():
            raise InputError(f"{path} is there already: choose another name, or move it away")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): choose another --out") from None
    values = ", ".join(f'"{n}": {v!r}' for n, v in EXAMPLES[stage].items())
    for path, source in zip(paths, (f"{stage}_template.py", "effect_test_template.py"), strict=True):
        text = Path(__file__).with_name(source).read_text(encoding="utf-8")
        text = text.replace('"my_values": 0.0', values).replace("my_effect", name)
        with whole_file(path, "w") as stream:
            stream.write(text)
    return paths


def _check_name(name: str, taken: list[str]) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name) or keyword.iskeyword(name):
        raise InputError(
            f"'{name[:60]}' cannot be an effect's name: use up to 40 lower-case letters, digits and "
            "underscores, a letter first, such as drive_ripple"
        )
    if name in taken:
        raise InputError(f"there is an effect '{name}' already: choose another name")
    if name in _USED or name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        raise InputError(f"'{name}' is the name of a Python module: choose another, such as {name}_error")
