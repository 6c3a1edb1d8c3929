"""How many captures a verdict and a parameter's error need, with `next` and with the usual set of `capture`.

    python -m tests.campaigns.captures_needed                    # twenty small simulated benches: about half an hour
    python -m tests.campaigns.captures_needed --benches 0,3 --json

Each bench hides one or two effects. Candidates are the hidden effects, those that look like them, and three others.
*Usual*: the first 4, 6, 8, 10 and 13 captures of `capture --patterns 12`. *Next*: the first 4 of these, then what
`next --bench` takes. Either way the captures are explained, and it counts how many it takes until the verdict is
settled as `next` says, with the hidden effects and no others in the model; at most 13.

For the errors, the hidden effects are fitted to all 13 usual captures, and to the first 4 with those of `next`, two
at a time: how many it takes until the errors (their geometric mean) are as small.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.further_captures import copy_captures, new_ids, take_further
from trainer.captures.open_bench import open_bench
from trainer.captures.possible_captures import possible_captures
from trainer.diagnosis.capture_choice import next_captures
from trainer.diagnosis.capture_until_settled import capture_until_settled, choose_next, near_planes
from trainer.diagnosis.diagnosis import diagnose
from trainer.diagnosis.doubts import Doubts, fit_rows
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import Catalogue, catalogue
from trainer.fitting.gauss_newton import fit
from trainer.fitting.pool import Pool, open_pool
from trainer.model.model import Model

FIRST, MOST = 4, 13
COUNTS = (4, 6, 8, 10, 13)
OTHERS = ("zero_order", "laser_drift", "crosstalk")
ALIKE = (
    {"spatial_coherence", "sensor_blur", "temporal_coherence"},
    {"distance", "wavelength", "pupil_aberration"},
    {"panel_wavefront", "pupil_aberration"},
    {"illumination", "vignetting"},
    {"phase_response", "zero_order", "amplitude_modulation"},
    {"stray_light", "sensor_response"},
)
BENCHES: tuple[tuple[str, ...], ...] = (
    ('kind = "spatial_coherence"',),
    ('kind = "sensor_blur"',),
    ('kind = "temporal_coherence"',),
    ('kind = "distance"',),
    ('kind = "zero_order"',),
    ('kind = "phase_response"',),
    ('kind = "illumination"',),
    ('kind = "pupil_aberration"',),
    ('kind = "crosstalk"',),
    ('kind = "vignetting"',),
    ('kind = "stray_light"',),
    ('kind = "panel_wavefront"',),
    ('kind = "sensor_blur"', 'kind = "zero_order"'),
    ('kind = "spatial_coherence"', 'kind = "phase_response"'),
    ('kind = "temporal_coherence"', 'kind = "zero_order"'),
    ('kind = "distance"', 'kind = "sensor_blur"'),
    ('kind = "illumination"', 'kind = "spatial_coherence"'),
    ('kind = "vignetting"', 'kind = "zero_order"'),
    ('kind = "phase_response"', 'kind = "crosstalk"'),
    ('kind = "pupil_aberration"', 'kind = "sensor_blur"'),
)


@dataclass(frozen=True)
class Needed:
    """What one bench needed; None: more than MOST captures.

    Attributes
    ----------
    hidden : list of str
    usual, chosen : int or None
        Captures until the right verdict was settled, with the usual set and with `next`.
    wrong_usual, wrong_chosen : list of str
        Effects of the last model where it is not the hidden one.
    errors_as_small : int or None
        Captures with `next` after which the errors are as small as those of all MOST usual ones.
    error_ratio : float
        Error with `next` over error with the usual set, at MOST captures.
    seconds : float
        Processor time.
    """

    hidden: list[str]
    usual: int | None
    chosen: int | None
    wrong_usual: list[str]
    wrong_chosen: list[str]
    errors_as_small: int | None
    error_ratio: float
    seconds: float


def candidates(hidden: list[str]) -> Catalogue:
    """The hidden effects, those that look like them, and others."""
    wanted = {*hidden, *OTHERS}
    wanted |= {name for group in ALIKE if group & set(hidden) for name in group}
    return {name: one for name, one in catalogue().items() if name in wanted}


def measure(number: int, folder: Path, pool: Pool) -> Needed:
    """What one bench needs."""
    began = time.process_time()
    defects = BENCHES[number]
    hidden = [d.split('"')[1] for d in defects]
    known = candidates(hidden)
    spec = str(bench_file(folder, *defects, width=96, height=64, distance_mm=8))
    acquire_from(spec, folder / "usual", patterns=MOST - 1, seed=number)
    usual = read_captures(folder / "usual")

    def explained(captures: CaptureSet) -> Model:
        return explain(captures, Model(captures.bench), known, pool).model

    def settled(captures: CaptureSet) -> tuple[bool, Model]:
        model = explained(captures)
        found = choose_next(captures, model, known, pool, 0)
        return found.settled and set(found.doubts.model.names) == set(hidden), model

    right, model = settled(usual)
    wrong_usual = [] if set(model.names) == set(hidden) else list(model.names)
    needed = MOST if right else None
    for count in reversed(COUNTS[:-1]) if right else ():
        right, _ = settled(first_of(usual, count))
        if not right:
            break
        needed = count

    with open_bench(spec, 100 + number) as opened:
        start = copy_captures(first_of(usual, FIRST), made(folder / "next"))
        model = explained(start)
        planes = near_planes(start)
        last = capture_until_settled(
            opened.headset, start, model, known, pool, MOST - FIRST, planes, seed=number
        )
        model = explained(last.captures)
        wrong = [] if set(model.names) == set(hidden) else list(model.names)
        chosen = len(last.captures) if last.settled and not wrong else None
        truth = wanted_model(usual, hidden, known, pool)
        small = error_of(usual, truth)
        grown = copy_captures(first_of(usual, FIRST), made(folder / "sharper"))
        as_small = None
        while len(grown) < MOST:
            grown = sharpened(opened.headset, grown, truth, pool, min(2, MOST - len(grown)), number)
            if as_small is None and error_of(grown, truth) <= small:
                as_small = len(grown)
    ratio = error_of(grown, truth) / small
    seconds = time.process_time() - began
    return Needed(hidden, needed, chosen, wrong_usual, wrong, as_small, ratio, seconds)


def first_of(captures: CaptureSet, count: int) -> CaptureSet:
    """The first captures of a set."""
    return replace(captures, captures=captures.captures[:count])


def made(folder: Path) -> Path:
    """A new folder."""
    folder.mkdir()
    return folder


def wanted_model(captures: CaptureSet, hidden: list[str], known: Catalogue, pool: Pool) -> Model:
    """The model with the hidden effects and no others, as `explain` finds it."""
    only = {name: known[name] for name in hidden}
    return explain(captures, Model(captures.bench), only, pool).model


def error_of(captures: CaptureSet, model: Model) -> float:
    """Geometric mean of the standard errors of a model's numbers, in units of their scales.

    Numbers that the captures do not determine, such as the extent of a halo that is not there, have none.
    """
    found = fit(model, model.names, load(captures, fit_rows(captures)))
    relative = []
    for name, parameter, index in found.keys:
        present = found.model.instance(name)
        assert present.errors is not None
        error = float(present.errors[parameter].reshape(-1)[index])
        relative.append(error / present.effect.parameter(parameter).scale)
    known = np.array([r for r in relative if r > 0])  # nan is not
    return float(np.exp(np.log(known).mean()))


def sharpened(
    headset: object, captures: CaptureSet, model: Model, pool: Pool, count: int, seed: int
) -> CaptureSet:
    """A set with further captures that sharpen a model in which nothing is in doubt."""
    rows = tuple(fit_rows(captures))
    model = fit(model, model.names, load(captures, rows)).model
    doubts = Doubts(diagnose(captures, model, {}, pool, thorough=False), model, (), rows)
    possible = possible_captures(captures, near_planes(captures), count, seed + 1000 * len(captures))
    found = next_captures(captures, doubts, possible, count, pool).chosen
    names = new_ids(captures, count)
    taken = [(one.as_json(name, ""), one.gray) for name, one in zip(names, found, strict=True)]
    return take_further(headset, captures, taken)  # type: ignore[arg-type]


def main() -> int:
    """Measure, and print a Markdown table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--benches", default=",".join(map(str, range(len(BENCHES)))), help="their numbers")
    parser.add_argument("--json", action="store_true", help="a line of JSON for each bench")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if not args.json:
        print(
            "| hidden | usual | next | errors as small | error at 13 |\n| --- | ---: | ---: | ---: | ---: |"
        )
    with open_pool(1) as pool:
        for number in map(int, args.benches.split(",")):
            with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
                found = measure(number, Path(folder), pool)
            print(json.dumps({"bench": number, **asdict(found)}) if args.json else row(found), flush=True)
    return 0


def row(found: Needed) -> str:
    """A row of the table."""
    numbers = [
        f"> {MOST}" if n is None else str(n) for n in (found.usual, found.chosen, found.errors_as_small)
    ]
    return f"| {', '.join(found.hidden)} | {' | '.join(numbers)} | {found.error_ratio:.2f} |"


if __name__ == "__main__":
    sys.exit(main())
