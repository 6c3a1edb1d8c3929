"""What every kind of hidden defect of a simulated bench has: a name and a stage of the light path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Defect:
    """Base of all defects.

    Attributes
    ----------
    kind : str
        The name in TOML.
    stage : str
        Where in the light path it acts.
    """

    kind: ClassVar[str] = ""
    stage: ClassVar[str] = ""
