"""Frames of fields for tests, the panel board that takes them, and what it lit."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_iface.panel import open_board
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.panel.panel_board_messages import Timing
from firmware_iface.virtual.usb import BoardModel, VirtualUsb

SHAPE = (3, 5)
FAST = Timing(period_us=2000, light_delay_us=500, light_width_us=1000)


def opened(model: BoardModel, fields: int = 3, timeout_s: float = 0.05) -> FieldPanel:
    panel = open_board(backend=VirtualUsb(model), timing=FAST, timeout_s=timeout_s, fields=fields)
    assert isinstance(panel, FieldPanel)
    return panel


def picture(seed: int, fields: int = 3, shape: tuple[int, int] = SHAPE) -> list[Field]:
    grays = np.random.default_rng(seed).integers(0, 256, (fields, *shape), dtype=np.uint8)
    return colours_in_turn(grays, range(fields), [1.0] * fields, FAST.period_us)


def crc(gray: NDArray[np.uint8]) -> int:
    return zlib.crc32(gray.tobytes())


def allowed(*frames: Sequence[Field]) -> set[tuple[int, int]]:
    """(pattern, light) of every field of these frames, and darkness on anything."""
    return {(crc(field.gray), field.lasers) for frame in frames for field in frame}


def lit(model: BoardModel) -> set[tuple[int, int]]:
    """(pattern, light) of every field that the panel has shown with light."""
    return {pair for pair in model.sequence.opened if pair[1]}
