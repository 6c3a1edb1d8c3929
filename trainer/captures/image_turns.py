"""The eight ways to turn and mirror an image, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from firmware_iface.errors import InputError

_TURNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as_stated": lambda a: a,
    "mirror_left_right": lambda a: a[:, ::-1],
    "mirror_top_bottom": lambda a: a[::-1],
    "turn_180": lambda a: a[::-1, ::-1],
    "transpose": lambda a: a.T,
    "turn_90_left": np.rot90,
    "turn_90_right": lambda a: np.rot90(a, -1),
    "transpose_other_diagonal": lambda a: a[::-1, ::-1].T,
}
TURNS = tuple(_TURNS)
TURN_WORDS = {
    "mirror_left_right": "mirror the images left-right",
    "mirror_top_bottom": "mirror the images top-bottom",
    "turn_180": "turn the images by 180 degrees",
    "transpose": "exchange the images' rows and columns",
    "turn_90_left": "turn the images by 90 degrees to the left",
    "turn_90_right": "turn the images by 90 degrees to the right",
    "transpose_other_diagonal": "exchange the images' rows and columns and turn them by 180 degrees",
}


def turned(image: np.ndarray, turn: str) -> np.ndarray:
    """The image after a named change.

    Parameters
    ----------
    image : array [h, w]
    turn : str
        One of TURNS.

    Raises
    ------
    InputError
        For an unknown name.
    """
    if turn not in _TURNS:
        raise InputError(f"{turn!r} is no way to turn an image: use one of {', '.join(TURNS)}")
    return _TURNS[turn](image)
