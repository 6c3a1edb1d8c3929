"""When nothing named fits."""

from __future__ import annotations

from typing import Any

import panel as pn


def outside_view(project: Any, visit: Any) -> Any:
    """Nothing yet."""
    return pn.pane.HTML("<p>later</p>")
