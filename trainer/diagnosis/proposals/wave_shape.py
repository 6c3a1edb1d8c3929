"""Periodic shapes in a probe's map: fringes with a period, a direction, a chirp along them and a bend across them."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import least_squares

from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.reading import Array, Number, Reading, Values, share_explained, with_unit
from trainer.formatting import number

SAMPLED = 6000  # nodes that the search looks at
BENDS = np.linspace(-0.6, 0.6, 13)  # chirps and bends that the search begins with
SHOWN = 0.3  # rad: a change of phase at the corner that is small but visible
SLOWEST = 1.5  # cycles over the map


def waves_in(one: ProbeMap) -> list[Reading]:
    """The strongest fringes of a map, if there are any."""
    y, x = one.grid
    values = one.values - one.values.mean()
    draw = np.random.default_rng(0).permutation(values.size)[:SAMPLED]
    few = (y.reshape(-1)[draw], x.reshape(-1)[draw], values.reshape(-1)[draw])
    best: tuple[float, Array] | None = None
    for width in (0.35, 3.0):  # the middle alone, where a chirp is small, and the whole map
        start = _peak(one, values, width)
        if start is not None:
            found = _refined(start, few, one.radius)
            if best is None or found[0] < best[0]:
                best = found
    if best is None:
        return []
    fy, fx, chirp, bend = best[1]
    cosine, sine, shape = _wave((fy, fx, chirp, bend), y, x, values, one.radius)
    period, angle = 1 / math.hypot(fy, fx), math.degrees(math.atan2(fy, fx))
    return [_reading(one, (cosine, sine, period, angle, chirp, bend), shape)]


def _reading(one: ProbeMap, seen: tuple[float, ...], shape: Array) -> Reading:
    cosine, sine, period, angle, chirp, bend = seen
    unit, spread, radius = one.place.unit, one.place.spread, one.radius
    size = math.hypot(cosine, sine)
    turn = 2 * math.pi * radius / period
    amplitude_scale = _rounded(0.05 if unit == "1" else max(0.2 * size, 1e-3))
    most = 1e4 if unit == "counts" else 3.0

    def described(values: Values) -> str:
        amplitude = math.hypot(values["cosine"], values["sine"])
        return (
            f"fringes of amplitude {with_unit(amplitude, unit)}, period {number(values['period'])} {spread} across "
            f"{number(values['angle'])} deg, chirp {number(values['chirp'])}, bend {number(values['bend'])}"
        )

    return Reading(
        name="fringes",
        about="Fringes, as interference in a plate makes them.",
        describe=described,
        formula=r"v = a\cos\varphi + b\sin\varphi,\quad "
        r"\varphi = \frac{2\pi}{p}\left(t + \frac{c\,t^2 + d\,s^2}{2R}\right)",
        numbers=(
            Number("cosine", unit, amplitude_scale, cosine, 0.0, -most, most, "even about the centre", True),
            Number("sine", unit, amplitude_scale, sine, 0.0, -most, most, "odd about the centre", True),
            Number(
                "period",
                spread,
                _rounded(SHOWN * period / turn),
                period,
                _rounded(period),
                period / 3,
                period * 3,
                "from fringe to fringe at the centre",
            ),
            Number(
                "angle",
                "deg",
                _rounded(math.degrees(SHOWN / turn)),
                angle,
                round(angle, 2),
                -200.0,
                200.0,
                "direction across the fringes; 0: along a row",
            ),
            Number(
                "chirp",
                "1",
                _rounded(2 * SHOWN / turn),
                chirp,
                0.0,
                -2.0,
                2.0,
                "change of the frequency from the centre to the corner",
            ),
            Number(
                "bend", "1", _rounded(2 * SHOWN / turn), bend, 0.0, -2.0, 2.0, "curvature along the fringes"
            ),
        ),
        code=(
            "    turn = angle * (math.pi / 180)",
            "    t = x * torch.cos(turn) + y * torch.sin(turn)  # across the fringes",
            "    s = y * torch.cos(turn) - x * torch.sin(turn)  # along them",
            f"    bent = t + (chirp * t**2 + bend * s**2) / (2 * {radius:.6g})",
            "    phase = (2 * math.pi / period) * bent",
            "    value = cosine * torch.cos(phase) + sine * torch.sin(phase)",
        ),
        found=shape,
        explained=share_explained(one.values, shape),
    )


def waves_in_gray(one: ProbeMap) -> list[Reading]:
    """A ripple over the gray levels."""
    level = np.linspace(0, 1, one.values.size)
    smooth = np.stack([level**k for k in range(3)], axis=1)  # what phase_response describes
    tried = []
    for cycles in np.arange(SLOWEST, one.values.size / 3, 0.05):
        angle = 2 * math.pi * cycles * (level - 0.5)
        basis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        whole = np.concatenate([basis, smooth], axis=1)
        terms = np.linalg.lstsq(whole, one.values, rcond=None)[0]
        left = float(((one.values - whole @ terms) ** 2).sum())
        tried.append((left, cycles, terms[:2], basis @ terms[:2]))
    if not tried:
        return []
    _, cycles, terms, shape = min(tried, key=lambda t: t[0])

    def described(values: Values) -> str:
        amplitude = math.hypot(values["cosine"], values["sine"])
        return f"a ripple of amplitude {number(amplitude)} rad, {number(values['cycles'])} cycles over the gray levels"

    return [
        Reading(
            name="ripple",
            about="A ripple over the gray levels, as a look-up table's steps make it.",
            describe=described,
            formula=r"v = a\cos 2\pi n (g - \tfrac12) + b\sin 2\pi n (g - \tfrac12)",
            numbers=(
                Number(
                    "cosine",
                    "rad",
                    0.02,
                    float(terms[0]),
                    0.0,
                    -3.0,
                    3.0,
                    "part that is even about mid-gray",
                    True,
                ),
                Number(
                    "sine",
                    "rad",
                    0.02,
                    float(terms[1]),
                    0.0,
                    -3.0,
                    3.0,
                    "part that is odd about mid-gray",
                    True,
                ),
                Number(
                    "cycles",
                    "1",
                    0.05,
                    float(cycles),
                    _rounded(float(cycles)),
                    0.5,
                    128.0,
                    "ripples over the gray levels",
                ),
            ),
            code=(
                "    phase = 2 * math.pi * cycles * (level - 0.5)",
                "    value = cosine * torch.cos(phase) + sine * torch.sin(phase)",
            ),
            found=shape,
            explained=share_explained(one.values, shape),
        )
    ]


def _peak(one: ProbeMap, values: Array, width: float) -> tuple[float, float] | None:
    """Frequency (fy, fx), cycles a unit of the coordinates, of the strongest wave under a window of this width."""
    windows = [np.exp(-0.5 * (np.linspace(-1, 1, n) / width) ** 2) for n in values.shape]
    window = windows[0][:, None] * windows[1][None, :]
    mean = float((values * window).sum() / window.sum())
    sizes = [2 * n for n in values.shape]
    spectrum = np.abs(np.fft.rfft2((values - mean) * window, sizes))
    fy, fx = np.meshgrid(np.fft.fftfreq(sizes[0]), np.fft.rfftfreq(sizes[1]), indexing="ij")
    cycles = np.hypot(fy * values.shape[0], fx * values.shape[1])
    spectrum = spectrum * (cycles >= max(SLOWEST, 1 / width))
    k, m = np.unravel_index(int(spectrum.argmax()), spectrum.shape)
    if spectrum[k, m] <= 0:
        return None
    steps = [2 * r / (n - 1) for r, n in zip(one.reach, values.shape, strict=True)]
    return float(fy[k, m] / steps[0]), float(fx[k, m] / steps[1])


def _refined(
    start: tuple[float, float], few: tuple[Array, Array, Array], radius: float
) -> tuple[float, Array]:
    """Squared error, and (fy, fx, chirp, bend), of the fringes near a frequency that fit the nodes best."""
    y, x, values = few

    def left(p: Array) -> Array:
        rest = values - _wave(tuple(p), y, x, values, radius)[2]
        return rest - rest.mean()

    tried = [
        (float((left(np.array([*start, chirp, bend])) ** 2).sum()), chirp, bend)
        for chirp in BENDS
        for bend in BENDS
    ]
    results = []
    size = math.hypot(*start)
    for _, chirp, bend in sorted(tried)[:3]:
        begin = np.array([*start, chirp, bend])
        units = np.array([0.1 / radius, 0.1 / radius, 0.1 / (size * radius), 0.1 / (size * radius)])
        fit = least_squares(left, begin, x_scale=units, max_nfev=60)
        results.append((2 * float(fit.cost), fit.x))
    return min(results, key=lambda r: r[0])


def _wave(
    p: tuple[float, ...], y: Array, x: Array, values: Array, radius: float
) -> tuple[float, float, Array]:
    """Cosine, sine, and the wave that with a constant explains most of some values."""
    fy, fx, chirp, bend = p
    size = math.hypot(fy, fx) or 1e-12
    t, s = (x * fx + y * fy) / size, (y * fx - x * fy) / size
    phase = 2 * math.pi * size * (t + (chirp * t**2 + bend * s**2) / (2 * radius))
    c, d = np.cos(phase), np.sin(phase)
    a, b = c - c.mean(), d - d.mean()
    cc, dd, cd = float((a * a).sum()), float((b * b).sum()), float((a * b).sum())
    right = float((a * values).sum()), float((b * values).sum())
    both = cc * dd - cd**2 or 1e-30
    cosine, sine = (right[0] * dd - right[1] * cd) / both, (right[1] * cc - right[0] * cd) / both
    return cosine, sine, cosine * c + sine * d


def _rounded(value: float) -> float:
    """A number with two significant digits, for a file that people read."""
    return float(f"{value:.2g}")
