"""What went wrong, counted and written: one place for every fault that the service meets."""

from __future__ import annotations

import sys
import time

from runtime.service.metrics import Metrics

REPEAT_S = 10.0  # the same fault is written again no sooner


class Faults:
    """Attributes: count (of all kinds, since the start)."""

    def __init__(self, metrics: Metrics) -> None:
        self.count = 0
        self._metrics = metrics
        self._said: dict[str, tuple[str, float]] = {}

    def note(self, kind: str, text: str) -> None:
        """Count a fault, and write it to standard error unless it was just written."""
        self.count += 1
        self._metrics.faults.labels(kind).inc()
        before, at = self._said.get(kind, ("", 0.0))
        now = time.monotonic()
        if text != before or now - at > REPEAT_S:
            self._said[kind] = (text, now)
            print(f"{kind}: {text}", file=sys.stderr, flush=True)
