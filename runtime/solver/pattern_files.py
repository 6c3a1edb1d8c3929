"""Patterns in files: 8-bit gray PNGs, and which file each picture's pattern goes to."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file

GIVEN = "hololoop-given"


@dataclass(frozen=True)
class PatternFile:
    """Where a pattern goes.

    Attributes
    ----------
    target : Path
        The picture that the pattern shows.
    channel : str
        The colour of the picture that it shows.
    frame : int
        Which of the colour's patterns, from 1 on.
    out : Path
        The file that it is written to.
    """

    target: Path
    channel: str
    frame: int
    out: Path


def pattern_files(
    targets: Sequence[Path], channels: Sequence[str], out: Path, frames: int = 1
) -> list[PatternFile]:
    """Which file each colour and frame of each picture goes to; makes the folder.

    Parameters
    ----------
    targets : sequence of Path
        The pictures.
    channels : sequence of str
        The colours of each; where there are several, their names are added to the file's name.
    out : Path
        A PNG, for one picture, or a folder.
    frames : int
        Patterns for each colour; where there are several, their numbers end the file's name.

    Raises
    ------
    InputError
        Where two patterns would go to one file, a pattern would go to its own picture's, or nothing can be written.
    """
    single = out.suffix.lower() == ".png" and not out.is_dir()
    if single and len(targets) > 1:
        raise InputError(f"--out {out} is one file and there are {len(targets)} pictures: give a folder")
    if not single and out.suffix and not out.is_dir():
        raise InputError(f"--out {out}: patterns are PNG; give a name that ends in .png, or a folder")
    files = []
    for target in targets:
        base = out if single else out / f"{target.stem}.png"
        for channel in channels:
            colour = "" if len(channels) == 1 else f"-{channel}"
            for frame in range(1, frames + 1):
                number = "" if frames == 1 else f"-{frame:0{len(str(frames))}d}"
                name = base.with_name(f"{base.stem}{colour}{number}{base.suffix}")
                files.append(PatternFile(target, channel, frame, name))
    owners: dict[Path, Path] = {}
    for file in files:
        if file.out in owners:
            raise InputError(
                f"{owners[file.out]} and {file.target} would both be written to {file.out}: rename one"
            )
        if os.path.realpath(file.out) == os.path.realpath(file.target):
            raise InputError(f"{file.target} would be overwritten by its own pattern: give another --out")
        owners[file.out] = file.target
    if not single:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out} cannot be made ({error.strerror}): give another folder") from None
    elif not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.absolute().parent}; make it first")
    return files


def write_pattern(path: Path, gray: np.ndarray, given: float | None = None) -> None:
    """Write gray levels, uint8 [H, W], as an 8-bit gray PNG that appears whole or not at all.

    `given`, the irradiance that a target of 1 should get (`Solution.given`), is kept in the PNG's text: colours that
    are shown in turn have no balance without it.
    """
    text = PngInfo()
    if given is not None:
        text.add_text(GIVEN, repr(float(given)))
    with whole_file(path) as file:
        Image.fromarray(gray).save(file, format="PNG", pnginfo=text)


def read_given(path: Path) -> float | None:
    """What a target of 1 should get from the pattern in a file; None where the file does not say so.

    Raises
    ------
    InputError
        Where it says something else than a number above 0; and as `read_pattern`.
    """
    read_pattern(path)
    with Image.open(path) as image:
        said = image.info.get(GIVEN)
    if said is None:
        return None
    try:
        given = float(said)
    except ValueError:
        given = math.nan
    if not 0 < given < math.inf:
        raise InputError(f"{path} says {GIVEN} = {said}, which is no number above 0: solve the picture again")
    return given


def read_pattern(path: Path) -> np.ndarray:
    """Gray levels, uint8 [H, W], of an 8-bit gray PNG.

    Raises
    ------
    InputError
        Where the file is missing, is no picture, or is not 8-bit gray.
    """
    try:
        with Image.open(path) as image:
            image.load()
            if image.mode != "L":
                raise InputError(
                    f"{path} is not 8-bit gray ({image.mode}): give a pattern as `solve` writes it"
                )
            return np.array(image, np.uint8)
    except FileNotFoundError:
        raise InputError(f"{path} is missing: give a pattern as `solve` writes it") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} is not a picture ({error}): give a pattern as `solve` writes it") from None
