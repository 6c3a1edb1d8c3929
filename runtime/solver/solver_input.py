"""What a solver accepts: light paths, targets, regions and iteration counts, each checked before it is used."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath
from runtime.solver.array_backend import Array, Backend

BRIGHTEST = (1e-20, 1e20)  # of a target's brightest pixel: single precision also holds its square
MOST_FRAMES = 32  # patterns for each colour of a picture; each takes as much memory as a colour


def stacked(paths: Any) -> list[list[LightPath]]:
    """Light paths as colours of planes.

    Parameters
    ----------
    paths : LightPath, or list of them (colours), or list of lists of them (planes of each colour)

    Returns
    -------
    list of list of LightPath

    Raises
    ------
    InputError
        Where their panels differ, or colours have different numbers of planes.
    """
    listed = [paths] if isinstance(paths, LightPath) else list(paths)
    stacks = [[one] if isinstance(one, LightPath) else list(one) for one in listed]
    if not stacks or not all(stacks):
        raise InputError("there is no light path to solve for: give one, or a list of them")
    first = stacks[0][0].grid.shape
    if any(len(stack) != len(stacks[0]) for stack in stacks):
        raise InputError("the colours have different numbers of planes: give each the same")
    for path in (p for stack in stacks for p in stack):
        if path.grid.shape != first:
            raise InputError(
                f"the light paths have panels of {path.grid.shape} and {first}: give one panel's"
            )
    return stacks


def checked_target(target: Array, colours: int, planes: int, shape: tuple[int, int], on: Backend) -> Array:
    """A target for each colour and plane, without copying what already has that shape.

    Parameters
    ----------
    target : array [H, W], [C, H, W], [C, K, H, W], or [K, H, W] for one colour
        Irradiance of any scale.
    colours, planes : int
        C and K.
    shape : (int, int), pixels
        Of the panel.
    on : Backend
        Where the target is.

    Returns
    -------
    array [C, K, H, W]

    Raises
    ------
    InputError
        For another size, for negative or non-finite values, and where a target is all dark, or too bright or too dark
        for single precision.
    """
    if target.shape[-2:] != shape or target.ndim < 2:
        raise InputError(
            f"the target is {' x '.join(map(str, target.shape))} (height x width) and the panel "
            f"{shape[0]} x {shape[1]}: resize or fit the picture"
        )
    leading = target.shape[:-2]
    if leading == (colours,) and colours > 1:
        target = target[:, None]
    elif leading not in ((), (planes,) if colours == 1 else (), (colours, planes)):
        raise InputError(
            f"the target is {' x '.join(map(str, target.shape))}; for {colours} colours and {planes} planes "
            f"give {colours} x {planes} x {shape[0]} x {shape[1]}, or one picture for all"
        )
    low, *brightest = on.floats(target.min(), *(one.max() for one in target.reshape(-1, *shape)))
    high, darkest = max(brightest), min(brightest)
    if not (math.isfinite(low) and math.isfinite(high)) or low < 0:
        raise InputError("the target has negative or non-finite values: irradiance is never below zero")
    if darkest == 0:
        raise InputError("the target is all dark: any pattern shows some light, so give it a bright pixel")
    if darkest < BRIGHTEST[0] or high > BRIGHTEST[1]:
        raise InputError(
            f"the target's brightest pixel is {high:g} ({darkest:g} in its darkest colour or plane): "
            f"scale it to between {BRIGHTEST[0]:g} and {BRIGHTEST[1]:g}, such as to 1"
        )
    return array_namespace(target).broadcast_to(target, (colours, planes, *shape))


def checked_region(region: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray | None:
    """Weights of pixels as floats [H, W].

    Raises
    ------
    InputError
        For another shape, for weights below zero and where all are zero.
    """
    if region is None:
        return None
    region = np.asarray(region, float)
    if region.shape != shape or not np.isfinite(region).all() or region.min() < 0 or not region.max() > 0:
        raise InputError(
            f"the region must be {shape[0]} x {shape[1]} weights, none below zero and not all zero"
        )
    return region


def check_iterations(iterations: int | None) -> None:
    """Raise InputError for a number of iterations below zero."""
    if iterations is not None and iterations < 0:
        raise InputError(f"{iterations} iterations: give 0 (the start alone) or more")


def check_frames(frames: int, method: str) -> int:
    """The number of patterns a picture; InputError where it is out of range or the method has one only."""
    if not 1 <= frames <= MOST_FRAMES:
        raise InputError(f"{frames} frames a picture: give from 1 to {MOST_FRAMES}")
    if frames > 1 and method in ("gerchberg_saxton", "double_phase"):
        raise InputError(f"{method} makes one pattern a picture: use bfgs or adam for {frames} frames")
    return frames


def check_approximator(shape: tuple[int, int, int], stacks: list[list[LightPath]]) -> None:
    """Raise InputError for an approximator of a shape (C, H, W) that is not that of colours of one plane."""
    height, width = stacks[0][0].grid.shape
    if len(stacks[0]) > 1 or shape != (len(stacks), height, width):
        raise InputError(
            f"the approximator takes {' x '.join(map(str, shape))} (colours, height, width) in one plane, and there "
            f"are {len(stacks)} colours of {height} x {width} in {len(stacks[0])} planes: export it for these"
        )
