"""What tests of a whole calibration share."""

from __future__ import annotations

import pytest

from runtime.calibration import free_form_fit


@pytest.fixture
def spared_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps only where they matter, by the rule for large panels: on a small one, they take most of the time.

    For tests of what is around the fit; the fit with all its maps is test_calibrate.py's.
    """
    monkeypatch.setattr(free_form_fit, "WORK", 0)
