"""hololoop-trainer with a few effects in its catalogue, which saves the others' trials, also in its processes.

`python -m tests.trainer.few_effects studio ...`. A process that is spawned imports this file first, too.
"""

from __future__ import annotations

import sys

from trainer.effects import effect_catalogue

NAMES = ("phase_response", "zero_order", "illumination", "distance", "sensor_blur", "stray_light")
effect_catalogue.BUILT_IN = tuple(e for e in effect_catalogue.BUILT_IN if e.name in NAMES)

if __name__ == "__main__":
    from trainer.cli import main

    sys.exit(main())
