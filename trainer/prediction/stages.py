"""The four stages of light, as effects change them, before they become a light path.

Each stage is a small record of tensors for one colour and one plane. An effect replaces some of them
(`dataclasses.replace`) or uses the stage's own methods. Lengths are in metres here; `y` and `x` run over -1 .. 1 across
the panel or the camera's picture, rows first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

LAST = 0.2  # of the light up to which a response is known: as it goes there, it goes on


@dataclass(frozen=True)
class Drive:
    """From gray level to phase.

    Attributes
    ----------
    channel : str
    wavelength, reference_wavelength : float, m
        The channel's, and the first channel's.
    sign : int
        1, or -1 where more gray means less phase.
    y, x : Tensor [H, W]
        -1 to 1 over the panel.
    level : Tensor [levels]
        gray / levels, 0 to 1.
    response : Tensor [levels], rad
        The phase of each level.
    gain : Tensor [H, W] or None
        Factor on the phase.
    crosstalk : (Tensor, Tensor) or None
        Tap tables of rows and columns, each [sub-pixels, taps].
    offset : Tensor [H, W] or None, rad
        Phase that is added whatever the pattern shows.
    factor : Tensor [levels] or None
        Factor on the field at each level, besides its phase, real or complex.
    components : (complex Tensor [K, C], Tensor [K, C], Tensor [K]) or None
        In each of K states during an exposure, the field is that of C components: each has an amplitude, and so many
        times the phase more. Then each state's share of the exposure; their irradiances add.
    persistence : Tensor or None
        Share of the phase shown before that is still there.
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
    offset: Tensor | None = None
    factor: Tensor | None = None
    components: tuple[Tensor, Tensor, Tensor] | None = None
    persistence: Tensor | None = None

    def scaled(self, factor: Tensor) -> Drive:
        """The drive with the phase's gain multiplied by a map [H, W]."""
        return replace(self, gain=factor if self.gain is None else self.gain * factor)

    def advanced(self, phase: Tensor) -> Drive:
        """The drive with a phase [H, W], rad, added whatever the pattern shows."""
        return replace(self, offset=phase if self.offset is None else self.offset + phase)

    def modulated(self, factor: Tensor) -> Drive:
        """The drive with the light of each level multiplied by a factor [levels], real or complex."""
        return replace(self, factor=factor if self.factor is None else self.factor * factor)

    def split(self, amplitudes: Tensor, turns: Tensor, shares: Tensor) -> Drive:
        """The drive with each component of each state split into such components and states, as in `components`."""
        if self.components is None:
            return replace(self, components=(amplitudes, turns, shares))
        amplitudes_before, turns_before, shares_before = self.components
        states = len(shares_before) * len(shares)
        times = amplitudes_before[:, None, :, None] * amplitudes[None, :, None, :]
        more = turns_before[:, None, :, None] + turns[None, :, None, :]
        both = (shares_before[:, None] * shares[None, :]).reshape(states)
        return replace(self, components=(times.reshape(states, -1), more.reshape(states, -1), both))


@dataclass(frozen=True)
class Panel:
    """The field at the panel: what lights it, and what leaves it unmodulated.

    Attributes
    ----------
    channel : str
    wavelength, reference_wavelength : float, m
        The channel's, and the first channel's.
    pitch : float, m
    y, x : Tensor [H, W]
        -1 to 1 over the panel.
    source : complex Tensor [H, W]
        The field that lights the panel.
    leak : complex Tensor [H, W] or None
        The field that no pattern modulates.
    aperture : Tensor [2]
        Sides of a pixel's active area, share of the pitch.
    reflected : complex Tensor [H, W] or None
        A further field that no pattern modulates, and that has none of the panel's wavefront.
    copies : tuple of (complex Tensor, Tensor, Tensor)
        Further fields beside the panel's own: amplitude against it, and displacement along rows and columns in panel
        pixels.
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
    reflected: Tensor | None = None
    copies: tuple[tuple[Tensor, Tensor, Tensor], ...] = ()

    def copied(self, amplitude: Tensor, dy: Tensor, dx: Tensor) -> Panel:
        """The panel with a copy of its field added: complex amplitude, and displacement in panel pixels."""
        return replace(self, copies=(*self.copies, (amplitude, dy, dx)))

    def multiplied(self, factor: Tensor) -> Panel:
        """The panel with the modulated and the unmodulated light multiplied by a map [H, W], real or complex."""
        leak = None if self.leak is None else self.leak * factor
        reflected = None if self.reflected is None else self.reflected * factor.abs()
        return replace(self, source=self.source * factor, leak=leak, reflected=reflected)

    def leaking(self, field: Tensor) -> Panel:
        """The panel with a field [H, W] added that the pattern does not modulate."""
        return replace(self, leak=field if self.leak is None else self.leak + field)

    def reflecting(self, field: Tensor) -> Panel:
        """The panel with a field [H, W] added that the pattern does not modulate and that no wavefront delays."""
        return replace(self, reflected=field if self.reflected is None else self.reflected + field)

    @property
    def unmodulated(self) -> Tensor | None:
        """All the light that the pattern does not modulate, [H, W]."""
        if self.leak is None or self.reflected is None:
            return self.reflected if self.leak is None else self.leak
        return self.leak + self.reflected


@dataclass(frozen=True)
class SourceExtent:
    """Directions from which the panel is lit; their irradiances add.

    Attributes
    ----------
    core, halo : callable
        The mean of exp(-j k.angle) over the directions near the axis, and over all others, times their share of the
        light: their characteristic functions, of a column and a row of k (1/rad).
    rms : (Tensor, Tensor), rad
        Angle of the directions near the axis, along rows and columns.
    """

    core: Callable[[Tensor, Tensor], Tensor]
    halo: Callable[[Tensor, Tensor], Tensor]
    rms: tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Pupil:
    """The path from the panel to the image plane, over spatial frequency.

    Attributes
    ----------
    channel : str
    wavelength, reference_wavelength : float, m
        The channel's, and the first channel's.
    pitch : float, m
        The panel's.
    fy, fx : Tensor [n, 1] and [1, m], cycles/m
    v, u : Tensor [n, 1] and [1, m]
        fy and fx in units of the panel's band 1 / (2 pitch).
    iy, ix : Tensor, cycles/m
        Frequencies of the image's irradiance, as a column and a row.
    distance : Tensor, m
        Panel to image plane.
    half_width : Tensor
        Of the iris, share of the band.
    centre : (Tensor, Tensor)
        Of the iris (v, u), share of the band.
    roundness : Tensor
        Of the iris: 0 a rectangle, 1 an ellipse, between them a rectangle with round corners.
    stretch : Tensor
        How much wider than `half_width` the iris is along u, and narrower along v, as a share.
    rotation : Tensor, rad
        Of the iris, from u to v.
    edge : Tensor
        Width over which the iris's edge goes from passing to blocking, share of the band.
    path_difference : Tensor [n, m] or None, m
        The same for every colour.
    transmission : complex Tensor [n, m] or None
    lines : (Tensor, Tensor) or None
        Offsets of the laser's lines, m, and their weights.
    nominal_offset : Tensor or None, m
        Of the wavelength that the panel's response is for, where it is not the stated one.
    irradiance_filter : Tensor or None
        Transfer function of irradiance over (iy, ix).
    extent : SourceExtent or None
        Of the source; None where it is a point.
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
    roundness: Tensor
    stretch: Tensor
    rotation: Tensor
    edge: Tensor
    path_difference: Tensor | None = None
    transmission: Tensor | None = None
    lines: tuple[Tensor, Tensor] | None = None
    nominal_offset: Tensor | None = None
    irradiance_filter: Tensor | None = None
    extent: SourceExtent | None = None

    def delayed(self, path_difference: Tensor) -> Pupil:
        """The pupil with a path difference [n, m], m, added."""
        before = self.path_difference
        return replace(self, path_difference=path_difference if before is None else before + path_difference)

    def emitting(self, offsets: Tensor, weights: Tensor) -> Pupil:
        """The pupil with each of the laser's lines split into lines at offsets [n], m, with these shares [n]."""
        if self.lines is None:
            return replace(self, lines=(offsets, weights))
        before, shares = self.lines
        lines = (before[:, None] + offsets).reshape(-1), (shares[:, None] * weights).reshape(-1)
        return replace(self, lines=lines)

    def filtered(self, transfer: Tensor) -> Pupil:
        """The pupil with irradiance filtered by a transfer function over (iy, ix)."""
        before = self.irradiance_filter
        return replace(self, irradiance_filter=transfer if before is None else before * transfer)


@dataclass(frozen=True)
class Sensor:
    """From irradiance in the image plane to camera counts.

    Attributes
    ----------
    channel : str
    full_scale : float, counts
    y, x : Tensor [h, w]
        -1 to 1 over the picture.
    iy, ix : Tensor [n, 1] and [1, m], cycles/panel pixel
        Image frequencies.
    irradiance_filter : Tensor or None
        Transfer function of irradiance that applies to the eye too (ghost).
    blur : Tensor or None
        Transfer function of the camera alone.
    displacement : (Tensor, Tensor) or None, camera pixels
        dy and dx, each [h, w].
    gain : Tensor [h, w] or None
    offset : Tensor [h, w] or None, counts
    laser_share : Tensor or None
        Of `offset`: what follows each capture's own gain, as light of the laser does.
    constant : Tensor or None, counts
        Of `offset`: what does not grow with the exposure; None where nothing does.
    exposure : Tensor [B, 1, 1] or None
        Each capture's exposure over the usual one; None where all have that.
    response : callable or None
        A function of the signal as a share of full scale.
    response_known_to : float or None
        The share of full scale up to which `response` is known; None: everywhere.
    free_capture_gain : bool
        Each capture has its own gain.
    free_capture_shift : bool
        Each capture has its own displacement.
    capture_blur : callable or None
        Each capture has its own amount of a blur: a function of its variance over the usual one's that gives the blur's
        transfer function over (iy, ix).
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
    laser_share: Tensor | None = None
    constant: Tensor | None = None
    exposure: Tensor | None = None
    response: Callable[[Tensor], Tensor] | None = None
    response_known_to: float | None = None
    free_capture_gain: bool = False
    free_capture_shift: bool = False
    capture_blur: Callable[[Tensor], Tensor] | None = None

    @property
    def added(self) -> Tensor | None:
        """`offset` at each capture's exposure, counts [h, w] or [B, h, w]."""
        if self.offset is None or self.constant is None or self.exposure is None:
            return self.offset
        return (1 - self.exposure) * self.constant + self.exposure * self.offset

    @property
    def added_by_laser(self) -> Tensor | None:
        """The part of `added` that follows each capture's own gain, counts."""
        if self.laser_share is None or self.offset is None:
            return None
        usual = self.offset * self.laser_share
        return usual if self.exposure is None else usual * self.exposure

    @property
    def added_always(self) -> Tensor | None:
        """The part of `added` that does not follow the captures' own gains, counts."""
        laser, added = self.added_by_laser, self.added
        return added if laser is None or added is None else added - laser

    def as_bright(self, own: Tensor) -> Sensor:
        """The sensor of captures whose own gain is known: the light that it adds to them."""
        laser, always = self.added_by_laser, self.added_always
        if laser is None or always is None:
            return self
        return replace(self, offset=own * laser + always, laser_share=None, constant=None)

    @property
    def moves(self) -> bool:
        """Whether each capture has a motion of its own."""
        return self.free_capture_shift or self.capture_blur is not None

    @property
    def usual_blur(self) -> Tensor | None:
        """Transfer function over (iy, ix) of the usual capture's blur; None where captures have none of their own."""
        blur = self.capture_blur
        return None if blur is None else blur(torch.ones((), dtype=self.iy.dtype))

    def blurred(self, transfer: Tensor) -> Sensor:
        """The sensor with the camera's picture filtered by a transfer function over (iy, ix)."""
        return replace(self, blur=transfer if self.blur is None else self.blur * transfer)

    def filtered(self, transfer: Tensor) -> Sensor:
        """The sensor with irradiance itself filtered, for the camera and the eye."""
        before = self.irradiance_filter
        return replace(self, irradiance_filter=transfer if before is None else before * transfer)

    def displaced(self, dy: Tensor, dx: Tensor) -> Sensor:
        """The sensor with each pixel receiving the light of a place (dy, dx) camera pixels farther on."""
        if self.displacement is not None:
            dy, dx = dy + self.displacement[0], dx + self.displacement[1]
        return replace(self, displacement=torch.broadcast_tensors(dy, dx))

    def multiplied(self, factor: Tensor) -> Sensor:
        """The sensor with the sensitivity multiplied by a map [h, w]."""
        return replace(self, gain=factor if self.gain is None else self.gain * factor)

    def brightened(self, counts: Tensor) -> Sensor:
        """The sensor with counts [h, w] added."""
        return replace(self, offset=counts if self.offset is None else self.offset + counts)

    def responding(self, curve: Callable[[Tensor], Tensor]) -> Sensor:
        """The sensor with a further response curve, of the signal as a share of full scale."""
        before = self.response
        return replace(self, response=curve if before is None else lambda share: curve(before(share)))

    def responded(self, signal: Tensor) -> Tensor:
        """Counts where a straight response would give `signal`, counts; beyond what is known, straight on.

        A polynomial or a spline that is fitted to the pictures says nothing of brighter light: full pixels stay full.
        """
        if self.response is None:
            return signal
        share, known = signal / self.full_scale, self.response_known_to
        if known is None:
            return self.response(share) * self.full_scale
        ends = self.response(share.new_tensor([1 - LAST, 1.0]) * known)
        slope = (ends[1] - ends[0]).clamp(min=0) / (LAST * known)
        inside = share.clamp(max=known)
        return (self.response(inside) + slope * (share - inside)) * self.full_scale
