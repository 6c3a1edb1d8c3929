"""A small simulated bench for tests of its physics: patterns, spots of light, and measures of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_iface.virtual import BenchDescription, VirtualHeadset, load_bench, make_defect
from firmware_iface.virtual.bench_description import CameraDescription
from tests.firmware_iface.padded_light import samples

H, W, Z = 48, 64, 12.0
FAR = 30.0  # where orders of a grating of 4 columns lie 61 pixels apart
ORDER_PX = FAR / np.sqrt((32e-3 / 520e-6) ** 2 - 1) / 8e-3
NARROW = make_defect(
    "illumination", waist_x_share=0.3, waist_y_share=0.3, centre_x_share=0, centre_y_share=0, ring=0
)
SPOT = replace(NARROW, waist_x_share=0.2, waist_y_share=0.2)
LINEAR = {"s_curvature": 0.0, "lopsidedness": 0.0}


def small(*defects, **changes) -> BenchDescription:
    bench = load_bench("virtual:ideal").resized(H, W, Z)
    return replace(bench, defects=tuple(defects), **changes)


def quiet(*defects) -> VirtualHeadset:
    """A headset whose camera has hardly any noise, with the laser on."""
    camera = CameraDescription(W, H, bit_depth=16, full_well_e=1e9, read_noise_e=0.0)
    headset = VirtualHeadset(small(*defects, camera=camera))
    headset.lasers.set_power("green", 1.0)
    return headset


def spot(*defects) -> VirtualHeadset:
    """The same, with a spot of light that does not saturate."""
    headset = quiet(SPOT, *defects)
    headset.camera.exposure_ms = 0.5
    return headset


def uniform(level=0):
    return np.full((H, W), level, np.uint8)


def random_gray(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (H, W), dtype=np.uint8)


def grating(period):
    return (256 * np.arange(W) / period % 256).astype(np.uint8)[None, :].repeat(H, 0)


def order_power(bench, gray, order):
    """Light in an order of a grating of 4 columns, over the light on the panel; order may be a fraction."""
    light, y, x, per_pixel = samples(bench, gray, FAR)
    near = (np.abs(x - order * ORDER_PX) < 16) & (np.abs(y) < 20)
    return float((light * near).sum() / per_pixel / (H * W))


def moments(picture):
    """Centroid (y, x) and second moments (yy, xx, xy) about it, pixels."""
    light = picture / picture.sum()
    y, x = np.mgrid[0:H, 0:W]
    cy, cx = (light * y).sum(), (light * x).sum()
    v, u = y - cy, x - cx
    return (cy, cx), ((light * v * v).sum(), (light * u * u).sum(), (light * v * u).sum())
