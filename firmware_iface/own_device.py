"""A device of the lab's own in a configuration: kind = "MODULE:FUNCTION", whose result is the panel or camera.

# my_lab.py
from slmsuite.hardware.slms.meadowlark import Meadowlark
from firmware_iface.slmsuite import SlmsuitePanel

def panel():
    return SlmsuitePanel(Meadowlark(wav_um=0.52))

# headset.toml
[panel]
kind = "my_lab:panel"
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from firmware_iface.errors import DeviceError, InputError, nearest

NEEDED = {
    "panel": ("shape", "show", "status", "close"),
    "camera": ("shape", "bit_depth", "exposure_ms", "capture", "close"),
}


def check_kind(kind: str, part: str, known: Collection[str]) -> None:
    """Check the kind of a [panel] or [camera].

    Raises
    ------
    InputError
        Where it is neither known nor MODULE:FUNCTION.
    """
    if kind in known:
        return
    module, _, function = kind.partition(":")
    if not (function.isidentifier() and all(name.isidentifier() for name in module.split("."))):
        raise InputError(
            f"'kind' in [{part}] is {kind!r}: {nearest(kind, known)}; a device of your own is written "
            '"MODULE:FUNCTION".'
        )


def open_own(kind: str, part: str, **settings: Any) -> Any:
    """Open a device by calling the lab's function.

    Parameters
    ----------
    kind : str
        "MODULE:FUNCTION"; modules of the current folder are found, too.
    part : str
        "panel" or "camera": which attributes the device needs (see NEEDED).
    **settings
        Attributes of the device that are set after opening.

    Returns
    -------
    object
        What the function returned.

    Raises
    ------
    InputError
        Where it cannot be called or returns something else.
    DeviceError
        Where it fails.
    """
    function = _imported(kind, part)
    try:
        device = function()
        if missing := [name for name in NEEDED[part] if not hasattr(device, name)]:
            raise InputError(
                f"{kind} returned {type(device).__name__}, which has no '{missing[0]}': a {part} needs "
                f"{', '.join(NEEDED[part])}."
            )
        for name, value in settings.items():
            setattr(device, name, value)
    except (InputError, DeviceError):
        raise
    except Exception as error:  # vendors' libraries raise any exception
        raise DeviceError(
            f"the {part} of {kind} cannot be opened: {str(error) or type(error).__name__}."
        ) from error
    return device


def _imported(kind: str, part: str) -> Callable[[], Any]:
    module, _, name = kind.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        function = getattr(importlib.import_module(module), name)
    except Exception as error:  # the lab's module may raise any exception when it is imported
        raise InputError(
            f"'kind' in [{part}] is {kind!r}, which cannot be imported ({error}): install the module, or start "
            "where its file is."
        ) from error
    finally:
        sys.path.remove(here)
    if not callable(function):
        raise InputError(
            f"'kind' in [{part}] is {kind!r}, which is no function: name one that opens the {part}."
        )
    return function
