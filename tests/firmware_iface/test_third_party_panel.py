"""Other people's code against our model and tables, so that these are not merely our own opinion.

git clone https://github.com/csi-dcsc/Pycrafter6500
pip install ti-plm
HOLOLOOP_PYCRAFTER6500=Pycrafter6500 pytest tests/firmware_iface/test_third_party_panel.py -m slow
"""

from __future__ import annotations

import importlib
import os
import sys
from functools import partial

import numpy as np
import pytest

from firmware_iface.panel import phase_light_modulator as plm
from firmware_iface.virtual.usb import Dlpc900Model, VirtualUsb

pytestmark = pytest.mark.slow


def test_pycrafter6500_uploads_into_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unmodified; the pictures arrive bit by bit, with its exposures, and its sequence runs."""
    folder = os.environ.get("HOLOLOOP_PYCRAFTER6500")
    if not folder:
        pytest.skip("HOLOLOOP_PYCRAFTER6500 does not name a clone of Pycrafter6500")
    import usb.core

    model = Dlpc900Model()
    monkeypatch.setattr(usb.core, "find", partial(usb.core.find, backend=VirtualUsb(model)))
    monkeypatch.setattr(sys, "path", [folder, *sys.path])
    controller = importlib.import_module("pycrafter6500").dmd()
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.integers(0, 2, (27, 48)), np.ones((40, 40), int)).astype(np.uint8)
    lines = np.broadcast_to(np.arange(1080)[:, None] % 2, (1080, 1920)).astype(np.uint8)
    noise = np.zeros((1080, 1920), np.uint8)
    noise[:20, 5:1900] = rng.integers(
        0, 2, (20, 1895)
    )  # its encoder stumbles over single pixels at a row's end
    pictures = [blocks, lines, noise]
    controller.stopsequence()
    controller.changemode(3)
    controller.defsequence(pictures, [1000, 2000, 3000], [False] * 3, [0] * 3, [1] * 3, 0)
    controller.startsequence()
    assert model.mode == 3 and model.running and model.error == 0
    assert [model.entries[k].exposure_us for k in range(3)] == [1000, 2000, 3000]
    for number, picture in enumerate(pictures):
        np.testing.assert_array_equal(model.plane(number), picture)
    controller.stopsequence()
    controller.standby()
    assert not model.running and model.power == 1


@pytest.mark.parametrize(("name", "device"), [("p47", plm.P47), ("p67", plm.P67)])
def test_states_and_bits_are_those_of_tis_own_package(name: str, device: plm.Modulator) -> None:
    ti_plm = pytest.importorskip("ti_plm", reason="ti-plm is not installed (pip install ti-plm)")
    theirs = ti_plm.PLM.from_db(name)
    assert tuple(theirs.shape) == device.shape
    gray = np.random.default_rng(1).integers(0, 256, device.shape, dtype=np.uint8)
    expected = theirs.process_phase_map(gray / 256 * 2 * np.pi, replicate_bits=False)
    np.testing.assert_array_equal(plm.bit_plane(gray, device), expected)
