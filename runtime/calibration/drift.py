"""What of a light path drifts on a headset, as low-order corrections to the baked arrays of a bundle.

The panel's wavefront and the beam multiply the source field and the leak, distance multiplies the transfer
functions, and the response replaces the table. A tilt of the wavefront is left out: at one plane it is the
same as a camera that has moved sideways, and no eye notices it. One laser's tilt against another's is noticed: its
picture stands beside theirs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from runtime.lightpath.grid import band_frequencies
from runtime.lightpath.legendre import edge_to_edge, legendre_surface
from runtime.lightpath.light_path import LightPath
from runtime.lightpath.spline_maps import spline_surface

LOWEST_WAVEFRONT, LOWEST_AMPLITUDE = 2, 1  # Legendre orders: without piston and tilt; without power
LASER_ORDERS = 2, 1  # highest and lowest of a laser's own wavefront: its tilt and focus


@dataclass(frozen=True)
class Drift:
    """How a headset's light differs from what its bundle says.

    Attributes
    ----------
    wavefront_nm : float array [terms], nm
        Legendre terms of a path difference over the panel, from order 2 on, one for all colours.
    log_amplitude : mapping of str to float array [terms]
        Of each colour, Legendre terms of the logarithm of the beam's amplitude, from order 1 on.
    distance_mm : float, mm
        How much farther the image plane is.
    response : mapping of str to float array [levels], rad
        Phase of each gray level, of each colour that has a new response.
    wavefront_nodes_nm : float array [rows, columns], nm
        Nodes of a cubic B-spline over the panel that is added to the path difference; empty: none.
    amplitude_nodes : mapping of str to float array [rows, columns]
        Of each colour, the same for the logarithm of the beam's amplitude.
    laser_nm : mapping of str to float array [5], nm
        Of each of several colours, the Legendre terms (LASER_ORDERS) of its wavefront against the first one's.
    """

    wavefront_nm: np.ndarray = field(default_factory=lambda: np.zeros(0))
    log_amplitude: Mapping[str, np.ndarray] = field(default_factory=dict)
    distance_mm: float = 0.0
    response: Mapping[str, np.ndarray] = field(default_factory=dict)
    wavefront_nodes_nm: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    amplitude_nodes: Mapping[str, np.ndarray] = field(default_factory=dict)
    laser_nm: Mapping[str, np.ndarray] = field(default_factory=dict)

    def wavefront(self, shape: tuple[int, int]) -> np.ndarray:
        """The path difference over the panel, nm, float64 [H, W]."""
        fine = spline_surface(self.wavefront_nodes_nm, shape)
        return _legendre_surface(self.wavefront_nm, shape, LOWEST_WAVEFRONT) + fine

    def laser(self, channel: str, shape: tuple[int, int]) -> np.ndarray:
        """What a colour's own wavefront adds to it, nm, float64 [H, W]."""
        return _legendre_surface(self.laser_nm.get(channel, np.zeros(0)), shape, LASER_ORDERS[1])

    def amplitude(self, channel: str, shape: tuple[int, int]) -> np.ndarray:
        """The factor on a colour's amplitude over the panel, float64 [H, W]."""
        fine = spline_surface(self.amplitude_nodes.get(channel, np.zeros((0, 0))), shape)
        return np.exp(
            _legendre_surface(self.log_amplitude.get(channel, np.zeros(0)), shape, LOWEST_AMPLITUDE) + fine
        )


def drifted(path: LightPath, channel: str, wavelength_nm: float, drift: Drift) -> LightPath:
    """A colour's light path with a drift applied, in the path's own precision."""
    shape, real = path.grid.shape, path.response.dtype
    turn = 2 * math.pi / wavelength_nm * (drift.wavefront(shape) + drift.laser(channel, shape))
    factor = drift.amplitude(channel, shape).astype(real) * _turned(turn.astype(real))
    step = _turned((drift.distance_mm * axial_phase(path, wavelength_nm)).astype(real))
    response = drift.response.get(channel, path.response)
    return replace(
        path,
        source=path.source * factor,
        leak=None if path.leak is None else path.leak * factor,
        transfers=path.transfers * step,
        response=np.asarray(response, path.response.dtype),
    )


def _turned(phase: np.ndarray) -> np.ndarray:
    """exp(j phase), in the phase's precision: cosine and sine apart cost a fraction of a complex exponential."""
    return np.asarray(np.cos(phase) + 1j * np.sin(phase))


def axial_phase(path: LightPath, wavelength_nm: float) -> np.ndarray:
    """Phase (rad) that each frequency of the band gains a millimetre, against the axis: float64 [n, m]."""
    wavelength = wavelength_nm * 1e-9
    fy, fx = band_frequencies(path.grid, np.zeros((), np.float64))
    sine2 = np.minimum((wavelength * fy[:, None]) ** 2 + (wavelength * fx[None, :]) ** 2, 1)
    return -2e-3 * math.pi / wavelength * sine2 / (1 + np.sqrt(1 - sine2))


def _legendre_surface(terms: np.ndarray, shape: tuple[int, int], lowest: int) -> np.ndarray:
    """The surface [H, W] of Legendre terms from an order on; 0 without terms."""
    if not len(terms):
        return np.zeros(shape)
    return legendre_surface(np.asarray(terms, np.float64), *edge_to_edge(shape), lowest)
