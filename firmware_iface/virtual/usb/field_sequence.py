"""The panel behind the board in version 2 of its protocol: fields in turn, and the light that each may have.

Faults of the link between the board and the panel strike here. Only what is proven is lit (PROTOCOL.md). What was on
the panel in each field, and the light outputs that were opened on it, are recorded for a judge.
"""

from __future__ import annotations

import zlib
from collections import deque

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.usb.field_frame import ReceivedField

LONGEST = 20000  # periods that are carried out one by one after a pause
REMEMBERED = 20000
MOST_PERIODS = 64  # that a slow panel may still show
WRONG_PATTERN, WRONG_RECORD = 1, 2


class FieldSequence:
    """The front frame, field after field.

    Parameters
    ----------
    size : int
        Bytes of a pattern.
    faults : Faults
        Asked once a field: torn_field, swapped_gate, missing_field.

    Attributes
    ----------
    front : list of ReceivedField
        The frame on display; empty before the first.
    began : int
        Period in which the front frame was shown for the first time.
    lit : bool
        Whether the board's mode allows light.
    number : int
        Of the field that is shown.
    on_panel : bytes
        Pixels that the panel shows.
    displayed, kept_dark : int
        Numbers of fields.
    reason : int
        Why a field was kept dark last; 0: none was.
    history : deque of bytes
        Pixels that the panel showed, a period each, the last one last.
    opened : deque of (int, int)
        CRC-32 of what was on the panel, and the mask of the outputs that were opened on it, for each field.
    """

    def __init__(self, size: int, faults: Faults) -> None:
        self._faults = faults
        self.front: list[ReceivedField] = []
        self.lit = False
        self.number = 0
        self.on_panel = bytes(size)
        self.displayed = self.kept_dark = self.reason = 0
        self.opened: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)
        self.history: deque[bytes] = deque(maxlen=MOST_PERIODS)
        self._passed: dict[int, tuple[bytes, int]] = {}  # as each field of the front frame was shown last
        self._slot = self.began = self._outputs = 0

    def advance(self, slot: int, pending: list[ReceivedField] | None = None, due: int = 0) -> bool:
        """Show the fields of all periods up to `slot`; whether the pending frame was swapped in."""
        swapped = False
        self._slot = max(self._slot, slot - LONGEST)
        while self._slot < slot:
            self._slot += 1
            at_start = not self.front or (self._slot - self.began) % len(self.front) == 0
            if pending is not None and not swapped and self._slot >= due and at_start:
                self.front, self.began, swapped = pending, self._slot, True
                self._passed.clear()
            if self.front:
                self._show((self._slot - self.began) % len(self.front))
        return swapped

    def shown(self) -> list[tuple[ReceivedField, bytes, int]]:
        """Each field of the front frame, with what the panel shows in it and the outputs that are opened."""
        return [(f, *self._passed.get(k, (f.pixels, f.outputs))) for k, f in enumerate(self.front)]

    @property
    def before(self) -> list[bytes]:
        """Pixels shown before the frame on display began, or began again, a period each."""
        since = (self._slot - self.began) % len(self.front) + 1 if self.front else 0
        return list(self.history)[: len(self.history) - since]

    @property
    def outputs(self) -> int:
        """Mask of the light outputs that open in some field of the front frame."""
        return self._outputs if self.lit else 0

    def proven(self, record: ReceivedField, number: int, crc: int) -> int:
        """0 where the field may be lit, else why not."""
        if record.number != number:
            return WRONG_RECORD
        return 0 if record.crc == crc else WRONG_PATTERN

    def _show(self, number: int) -> None:
        field = record = self.front[number]
        crc, taken = field.crc, field.pixels
        fault = self._faults.take("torn_field", "swapped_gate", "missing_field")
        if fault == "swapped_gate":
            record = self.front[(number + 1) % len(self.front)]
        elif fault:
            kept = len(taken) // 2 if fault == "torn_field" else len(taken)
            taken = self.on_panel[:kept] + taken[kept:]
            crc = zlib.crc32(taken)
        refused = self.proven(record, number, crc)
        outputs = record.outputs if self.lit and not refused and record.width_us else 0
        self.number, self.on_panel = number, taken
        self.history.append(taken)
        self.displayed += 1
        if refused:
            self.kept_dark, self.reason = self.kept_dark + 1, refused
        self.opened.append((crc, outputs))
        self._passed[number] = taken, 0 if refused else record.outputs
        self._outputs = 0
        for shown, _, opened in self.shown():
            self._outputs |= opened if shown.width_us else 0
