"""Where a model comes from: what its file says of the captures that it was fitted to."""

from __future__ import annotations

from typing import Any

from runtime.program.version import installed_version
from trainer.captures.capture_set import CaptureSet


def origin(captures: CaptureSet) -> dict[str, Any]:
    """Where a model comes from, for its file."""
    return {
        "written_by": f"hololoop {installed_version()}",
        "captures": captures.folder.name,
        "captures_sha256": captures.content_hash(),
    }
