"""The verdict of a calibration in plain words, for the command and its report."""

from __future__ import annotations

from typing import Any


def sentence_of(found: dict[str, Any], replaced: bool) -> str:
    """The verdict of a calibration in plain words.

    Parameters
    ----------
    found : dict
        The calibration's numbers, as `runtime.calibration.summary.numbers` gives them.
    replaced : bool
        Whether the bundle's light path was replaced.
    """
    before, after = found["heldout"]["before"]["excess"], found["heldout"]["after"]["excess"]
    if found["verdict"] == "unchanged" and found["camera_scale"] is not None:
        return (
            f"Nothing has drifted for certain (excess {before:.2g} on held-out patterns): the camera's scale is off by "
            f"{found['camera_scale']:+.5f}, or defocus and distance have drifted as below, which at one plane looks "
            "the same; nothing was replaced. To know, register the camera again."
        )
    if found["verdict"] == "unchanged":
        return (
            f"Nothing has drifted that the camera can see: the excess on held-out patterns is {before:.2g}."
        )
    if found["verdict"] == "not_explained":
        return (
            f"The light path does not fit (excess {before:.2g} on held-out patterns) and refitting what drifts does "
            f"not correct it ({after:.2g}): take captures and run hololoop-trainer diagnose; nothing was replaced."
        )
    done = "it was replaced" if replaced else "nothing was replaced, as asked"
    more = (
        ""
        if found["complete"]
        else ("; more is wrong than drifts here: take captures and run hololoop-trainer diagnose")
    )
    return f"The light path has drifted: the refit takes the excess from {before:.2g} to {after:.2g}; {done}{more}."
