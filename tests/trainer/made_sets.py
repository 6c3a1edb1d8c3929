"""Small capture sets for tests, made by an independent light path that shares no code with the product's.

Every panel and camera pixel is 4 x 4 samples; the field is propagated by the angular spectrum, with an iris
that passes the central order, and the camera adds light over its pixel, then shot, read and rounding noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_writer import CaptureWriter

FINE = 4


def bench_tables(
    shape: tuple[int, int] = (64, 80), channels: tuple[str, ...] = ("green",), **camera: Any
) -> dict[str, Any]:
    """The tables of a bench.toml with a panel and camera of that shape, 5 mm apart; camera: its keys."""
    waves = {"red": 638, "green": 520, "blue": 450}
    return {
        "schema": 1,
        "name": "made",
        "panel": {"width": shape[1], "height": shape[0], "pitch_um": 8.0, "levels": 256, "fill_factor": 1.0},
        "channel": [{"name": name, "wavelength_nm": waves[name]} for name in channels],
        "propagation": {"distance_mm": 5.0},
        "iris": {"shape": "square", "half_width": 1.0},
        "camera": {
            "width": shape[1],
            "height": shape[0],
            "pixel_um": 8.0,
            "registered": True,
            "bit_depth": 12,
            "black_level": 64,
            "full_well_e": 10500,
            "read_noise_e": 5,
        }
        | camera,
    }


def irradiance(
    gray: np.ndarray, sign: int = 1, wavelength: float = 520e-9, distance: float = 5e-3, pitch: float = 8e-6
) -> np.ndarray:
    """Irradiance in the camera's pixels, mean about 1, for gray levels [H, W]; lengths in metres."""
    field = np.exp(sign * 2j * np.pi * gray / 256)
    rows, columns = gray.shape
    fine = np.kron(np.pad(field, ((rows // 2,) * 2, (columns // 2,) * 2)), np.ones((FINE, FINE)))
    fy, fx = (np.fft.fftfreq(n, pitch / FINE) for n in fine.shape)
    fy = fy[:, None]
    passed = (np.abs(fx) <= 0.5 / pitch) & (np.abs(fy) <= 0.5 / pitch)
    phase = 2 * np.pi * distance * np.sqrt(wavelength**-2 - fx**2 - fy**2)
    light = np.abs(np.fft.ifft2(np.fft.fft2(fine) * passed * np.exp(1j * phase))) ** 2
    light = light.reshape(2 * rows, FINE, 2 * columns, FINE).mean((1, 3))
    return light[rows // 2 : rows // 2 + rows, columns // 2 : columns // 2 + columns]


def counted(
    light: np.ndarray, tables: dict[str, Any], rng: np.random.Generator, brightness: float = 0.08
) -> np.ndarray:
    """Camera counts, uint16, for irradiance of mean 1 that fills that share of the full well."""
    camera = tables["camera"]
    top = 2 ** camera["bit_depth"] - 1
    electrons = rng.poisson(np.maximum(light, 0) * brightness * camera["full_well_e"])
    electrons = electrons + rng.normal(0, camera["read_noise_e"], light.shape)
    counts = camera["black_level"] + (top - camera["black_level"]) * electrons / camera["full_well_e"]
    return np.clip(np.round(counts), 0, top).astype(np.uint16)


def make_set(
    folder: Path,
    tables: dict[str, Any] | None = None,
    patterns: int = 5,
    brightness: float = 0.08,
    repeat: bool = True,
    stray: float = 0.0,
) -> CaptureSet:
    """A sound set: that many random patterns a channel, the first of them taken twice when repeat is true."""
    tables = tables or bench_tables()
    rng = np.random.default_rng(7)
    shape = (tables["panel"]["height"], tables["panel"]["width"])
    with CaptureWriter(folder, tables) as writer:
        for channel in tables["channel"]:
            for number in range(patterns):
                gray = rng.integers(0, 256, shape, dtype=np.uint8)
                light = irradiance(gray, wavelength=channel["wavelength_nm"] * 1e-9) + stray
                for _ in range(2 if repeat and number == 0 else 1):
                    writer.add(
                        gray,
                        counted(light, tables, rng, brightness),
                        channel["name"],
                        pattern=f"{channel['name']}-{number}",
                        exposure_ms=10.0,
                    )
    return read_captures(folder)


def write_captures(folder: Path, bench: Bench | Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> Path:
    """Write a capture set from rows, each with the arguments of `CaptureWriter.add`; returns its folder."""
    with CaptureWriter(folder, bench) as writer:
        for row in rows:
            writer.add(**row)
    return writer.folder
