"""The four stages that light meets, as the effects see them, before they are baked into a light path.

Each stage is a small record of tensors for one colour and one plane. An effect replaces some of them
(`dataclasses.replace`) or uses the stage's own short verbs. Lengths are metres inside; `y` and `x` run over
-1 .. 1 across the panel or the camera's picture, rows first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Drive:
    """What the panel makes of a gray level.

    level [levels]: gray / levels, 0 .. 1. response [levels]: phase, rad. gain [H, W]: factor on the phase.
    crosstalk: None, or (rows, columns) tap tables [sub-pixels, taps]. sign: +1, or -1 where more gray is less phase.
    """

    channel: str
    wavelength: float
    reference_wavelength: float
    sign: int
    y: Tensor
    x: Tensor
    level: Tensor
    response: Tensor
    gain: Tensor | None = None
    crosstalk: tuple[Tensor, Tensor] | None = None

    def scaled(self, factor: Tensor) -> Drive:
        """With the phase's gain multiplied by a map [H, W]."""
        return replace(self, gain=factor if self.gain is None else self.gain * factor)


@dataclass(frozen=True)
class Panel:
    """The field at the panel: what lights it, and what leaves it unmodulated.

    source [H, W] complex. leak [H, W] complex or None. aperture: side of the active area, share of the pitch.
    pitch: m.
    """

    channel: str
    wavelength: float
    reference_wavelength: float
    pitch: float
    y: Tensor
    x: Tensor
    source: Tensor
    leak: Tensor | None
    aperture: Tensor

    def multiplied(self, factor: Tensor) -> Panel:
        """With the modulated and the unmodulated light multiplied by a map [H, W], real or complex."""
        leak = None if self.leak is None else self.leak * factor
        return replace(self, source=self.source * factor, leak=leak)

    def leaking(self, field: Tensor) -> Panel:
        """With a field [H, W] added that the pattern does not modulate."""
        return replace(self, leak=field if self.leak is None else self.leak + field)


@dataclass(frozen=True)
class Pupil:
    """The path from the panel to the image plane, over spatial frequency.

    fy [n, 1], fx [1, m]: cycles/m. v, u: the same in units of the panel's band 1 / (2 pitch).
    distance: m. half_width, centre (v, u): the iris, share of the band. path_difference [n, m]: m, the same for
    every colour. transmission [n, m] complex. lines: offsets of the laser's lines (m) and their weights.
    irradiance_filter: None, or a transfer function of irradiance over image frequencies (iy, ix), cycles/m.
    """

    channel: str
    wavelength: float
    reference_wavelength: float
    pitch: float
    fy: Tensor
    fx: Tensor
    v: Tensor
    u: Tensor
    iy: Tensor
    ix: Tensor
    distance: Tensor
    half_width: Tensor
    centre: tuple[Tensor, Tensor]
    shape: str
    path_difference: Tensor | None = None
    transmission: Tensor | None = None
    lines: tuple[Tensor, Tensor] | None = None
    irradiance_filter: Tensor | None = None

    def delayed(self, path_difference: Tensor) -> Pupil:
        """With a path difference [n, m] (m) added over the pupil."""
        before = self.path_difference
        return replace(self, path_difference=path_difference if before is None else before + path_difference)

    def filtered(self, transfer: Tensor) -> Pupil:
        """With irradiance filtered by a transfer function over (iy, ix)."""
        before = self.irradiance_filter
        return replace(self, irradiance_filter=transfer if before is None else before * transfer)


@dataclass(frozen=True)
class Sensor:
    """From irradiance in the image plane to camera counts.

    y, x [h, w]: -1 .. 1 over the picture. iy [n, 1], ix [1, m]: image frequencies, cycles/pixel of the panel.
    irradiance_filter: transfer function of irradiance that the eye sees too (ghost). blur: the camera's own.
    displacement: None, or (dy, dx) [h, w], camera pixels. gain, offset [h, w]: offset in counts.
    response: None, or a function of the signal as a share of full scale. full_scale: counts.
    free_capture_gain: each capture has its own gain.
    """

    channel: str
    full_scale: float
    y: Tensor
    x: Tensor
    iy: Tensor
    ix: Tensor
    irradiance_filter: Tensor | None = None
    blur: Tensor | None = None
    displacement: tuple[Tensor, Tensor] | None = None
    gain: Tensor | None = None
    offset: Tensor | None = None
    response: Callable[[Tensor], Tensor] | None = None
    free_capture_gain: bool = False

    def blurred(self, transfer: Tensor) -> Sensor:
        """With the camera's picture filtered by a transfer function over (iy, ix)."""
        return replace(self, blur=transfer if self.blur is None else self.blur * transfer)

    def filtered(self, transfer: Tensor) -> Sensor:
        """With irradiance itself filtered, for the camera and the eye."""
        before = self.irradiance_filter
        return replace(self, irradiance_filter=transfer if before is None else before * transfer)

    def displaced(self, dy: Tensor, dx: Tensor) -> Sensor:
        """With each camera pixel seeing what one (dy, dx) camera pixels further on should see."""
        if self.displacement is not None:
            dy, dx = dy + self.displacement[0], dx + self.displacement[1]
        return replace(self, displacement=torch.broadcast_tensors(dy, dx))

    def multiplied(self, factor: Tensor) -> Sensor:
        """With the sensitivity multiplied by a map [h, w]."""
        return replace(self, gain=factor if self.gain is None else self.gain * factor)

    def brightened(self, counts: Tensor) -> Sensor:
        """With counts [h, w] added."""
        return replace(self, offset=counts if self.offset is None else self.offset + counts)

    def responding(self, curve: Callable[[Tensor], Tensor]) -> Sensor:
        """With a further response curve, of the signal as a share of full scale."""
        before = self.response
        return replace(self, response=curve if before is None else lambda share: curve(before(share)))
