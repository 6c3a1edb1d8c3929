"""The log of faults: every fault that the service meets is counted and written here."""

from __future__ import annotations

import sys
import time

from runtime.service.metrics import Metrics

REPEAT_S = 10.0  # the same fault is not written again sooner


class FaultLog:
    """Counts faults and writes them to standard error.

    Attributes
    ----------
    count : int
        Faults of all kinds since the start.
    """

    def __init__(self, metrics: Metrics) -> None:
        self.count = 0
        self._metrics = metrics
        self._written: dict[str, tuple[str, float]] = {}  # text and time, by kind

    def note(self, kind: str, text: str, ongoing: bool = False) -> None:
        """Count a fault, and write it unless it was just written.

        Parameters
        ----------
        kind, text : str
            What failed, and a sentence.
        ongoing : bool
            The fault belongs to an outage that was counted when it began: it is written, but not counted.
        """
        if not ongoing:
            self.count += 1
            self._metrics.faults.labels(kind).inc()
        before, at = self._written.get(kind, ("", 0.0))
        now = time.monotonic()
        if text != before or now - at > REPEAT_S:
            self._written[kind] = (text, now)
            print(f"{kind}: {text}", file=sys.stderr, flush=True)
