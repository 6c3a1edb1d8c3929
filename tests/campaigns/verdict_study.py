"""How often the verdict's rule names what is not there, and how small an effect it finds, on benches of known truth.

    python -m tests.campaigns.verdict_study                      # 200 small sets: 7 to 20 minutes on one core
    python -m tests.campaigns.verdict_study --sets 35 --json

Each set is 9 to 12 captures of a bench of 96 x 80 pixels that hides nothing or one defect of the catalogue at a random
strength (`hidden_strengths`). It is diagnosed with all effects as candidates. *Named* is the first of the ranking, if
it is worth adding. *Excess* is the ideal model's on held-out captures, a share of the signal's variance. Each result is
a line of the results file as soon as it is there; a study that was stopped goes on from it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from tests.campaigns.hidden_strengths import defect_of, hidden_in
from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import read_captures
from trainer.diagnosis.diagnosis import diagnose
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.pool import Pool, open_pool
from trainer.model.model import Model

TOO_SMALL = 2e-4  # ideal excess below which an effect is too small to see
EDGES = (-math.inf, TOO_SMALL, 5e-4, 1e-3, 1e-2, math.inf)


@dataclass(frozen=True)
class Judged:
    """What a diagnosis said of one set.

    Attributes
    ----------
    seed, number : int
        Which set.
    hidden : str or None
    strength : float
        Of the hidden defect, over that of its defaults.
    captures : int
    excess : float
        The ideal model's.
    verdict : str
    named : str or None
        The best effect, if it is worth adding.
    indistinguishable_from : list of str
    seconds : float
        Processor time.
    """

    seed: int
    number: int
    hidden: str | None
    strength: float
    captures: int
    excess: float
    verdict: str
    named: str | None
    indistinguishable_from: list[str]
    seconds: float

    @property
    def found(self) -> bool:
        """Whether the hidden effect is named, or is one that the named effect cannot be told from."""
        return self.hidden is not None and self.hidden in (self.named, *self.indistinguishable_from)

    @property
    def wrong(self) -> bool:
        """Whether an effect is named and the hidden one is not."""
        return self.named is not None and not self.found


def judge(number: int, seed: int, pool: Pool) -> Judged:
    """Make one set and diagnose it."""
    began = time.process_time()
    hidden = hidden_in(number, seed)
    own = 100_000 * seed + number
    with tempfile.TemporaryDirectory(prefix="hololoop-") as name:
        folder = Path(name)
        defects = [] if hidden.kind is None else [defect_of(hidden.kind, hidden.strength, own)]
        spec = str(bench_file(folder, *defects))
        acquire_from(spec, folder / "captures", patterns=hidden.captures - 1, seed=own)
        captures = read_captures(folder / "captures")
        said = diagnose(captures, Model(captures.bench), catalogue(), pool, thorough=False)
    return Judged(
        seed,
        number,
        hidden.kind,
        hidden.strength,
        len(captures),
        said.held_out.excess,
        said.verdict,
        said.best.effect.name if said.best else None,
        list(said.best.indistinguishable_from) if said.best else [],
        time.process_time() - began,
    )


def read_results(path: Path, seed: int) -> dict[int, Judged]:
    """Results of earlier runs with this seed, by number; a last line that was cut off is removed from the file."""
    if not path.exists():
        return {}
    text = path.read_bytes()
    whole = text.rfind(b"\n") + 1
    if whole < len(text):
        os.truncate(path, whole)
    every = [Judged(**json.loads(line)) for line in text[:whole].splitlines()]
    return {one.number: one for one in every if one.seed == seed}


def half_found(judged: Sequence[Judged]) -> float | None:
    """The excess that parts found sets from missed ones with fewest errors; None where either is lacking.

    Half of the sets at that excess are found, as far as so few can say. Between two sets it is their geometric mean;
    where several places do as well, the middle one.
    """
    if len({one.found for one in judged}) < 2:
        return None
    ordered = sorted(judged, key=lambda one: one.excess)
    logs = [math.log(max(one.excess, 1e-6)) for one in ordered]
    errors = [
        sum(one.found for one in ordered[:k]) + sum(not one.found for one in ordered[k:])
        for k in range(1, len(ordered))
    ]
    best = [k for k, wrong in enumerate(errors) if wrong == min(errors)]
    k = best[len(best) // 2]
    return math.exp((logs[k] + logs[k + 1]) / 2)


def summary(judged: Sequence[Judged]) -> dict[str, Any]:
    """Counts over all sets, by excess, and by effect: the object of --json."""
    nothing = [one for one in judged if one.hidden is None]
    small = [one for one in judged if one.hidden is not None and one.excess < TOO_SMALL]
    hidden = [one for one in judged if one.hidden is not None]
    return {
        "sets": len(judged),
        "nothing_hidden": {
            "sets": len(nothing),
            "named": sum(one.named is not None for one in nothing),
            "largest_excess": max((one.excess for one in nothing), default=None),
        },
        "too_small": {"sets": len(small), "named": sum(one.named is not None for one in small)},
        "wrong": [asdict(one) for one in judged if one.wrong],
        "half_found": half_found(hidden),
        "by_excess": [
            {
                "from": low if math.isfinite(low) else None,
                "to": high if math.isfinite(high) else None,
                **counts([one for one in hidden if low <= one.excess < high]),
            }
            for low, high in pairwise(EDGES)
        ],
        "by_effect": {
            name: by_effect([one for one in hidden if one.hidden == name])
            for name in sorted({one.hidden for one in hidden if one.hidden})
        },
    }


def counts(judged: Sequence[Judged]) -> dict[str, int]:
    """How many sets, in how many the hidden effect was named, another one, or none."""
    return {
        "sets": len(judged),
        "found": sum(one.found for one in judged),
        "wrong": sum(one.wrong for one in judged),
        "none_named": sum(one.named is None for one in judged),
    }


def by_effect(judged: Sequence[Judged]) -> dict[str, Any]:
    """Counts of one effect, and about which excess it begins to be found."""
    return {
        **counts(judged),
        "largest_missed": max((one.excess for one in judged if not one.found), default=None),
        "smallest_found": min((one.excess for one in judged if one.found), default=None),
        "half_found": half_found(judged),
    }


def show(found: dict[str, Any]) -> str:
    """The summary as sentences and Markdown tables."""
    nothing, small, wrong = found["nothing_hidden"], found["too_small"], found["wrong"]
    lines = [
        f"{found['sets']} sets.",
        f"Nothing hidden: {nothing['sets']} sets, something named in {nothing['named']}; "
        f"largest excess {figure(nothing['largest_excess'])}.",
        f"Hidden, with an excess below {TOO_SMALL:g}: {small['sets']} sets, something named in {small['named']}.",
        f"A wrong effect named: {len(wrong)} of {found['sets']} sets.",
        *(
            f"- {w['hidden'] or 'nothing'} hidden, {w['named']} named, excess {figure(w['excess'])}"
            for w in wrong
        ),
        f"Excess at which half are found, all effects together: {figure(found['half_found'])}.",
        "",
        "| excess | sets | found | wrong one named | none named |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for row in found["by_excess"]:
        low, high = row["from"], row["to"]
        place = (
            f"below {high:g}"
            if low is None
            else f"{low:g} and more"
            if high is None
            else f"{low:g} to {high:g}"
        )
        lines.append(f"| {place} | {row['sets']} | {row['found']} | {row['wrong']} | {row['none_named']} |")
    lines += [
        "",
        "| hidden | sets | found | wrong | largest missed | smallest found | half found at |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, row in found["by_effect"].items():
        ends = " | ".join(figure(row[k]) for k in ("largest_missed", "smallest_found", "half_found"))
        lines.append(f"| {name} | {row['sets']} | {row['found']} | {row['wrong']} | {ends} |")
    return "\n".join(lines)


def figure(value: float | None) -> str:
    """A number of two digits, or a dash."""
    return "-" if value is None else f"{value:.2g}"


def main() -> int:
    """Measure what the results file lacks, and print the tables or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sets", type=int, default=200, help="how many sets (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="of the sets (default 0)")
    parser.add_argument(
        "--results", type=Path, default=Path("verdict_study.jsonl"), help="a line for each set"
    )
    parser.add_argument("--json", action="store_true", help="print an object in place of tables")
    args = parser.parse_args()
    torch.set_num_threads(1)
    done = read_results(args.results, args.seed)
    with open_pool(1) as pool, args.results.open("a") as file:
        for number in range(args.sets):
            if number in done:
                continue
            one = done[number] = judge(number, args.seed, pool)
            print(json.dumps(asdict(one)), file=file, flush=True)
            said = f"{one.hidden or 'nothing'} (excess {one.excess:.2g}): {one.named or 'nothing'} named"
            print(f"{number + 1}/{args.sets} {said}, {one.seconds:.1f} s", file=sys.stderr, flush=True)
    found = summary([one for number, one in sorted(done.items()) if number < args.sets])
    print(json.dumps(found) if args.json else show(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
