"""A choice that is acted on at once."""

from __future__ import annotations

from typing import ClassVar

import panel as pn


class PromptSelect(pn.widgets.Select):
    """A drop-down list whose choice is handled at once, not after the 50 ms in which Panel gathers changes."""

    _priority_changes: ClassVar[list[str]] = ["value"]
