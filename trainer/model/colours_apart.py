"""Effects whose values the colours of a bench have in common, or each for itself.

Lasers of three colours come through three lenses: their beams, their spectra and where they focus differ. One value for
all says more with fewer numbers, so an effect comes apart only where the captures say that it pays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trainer.captures.bench_file import Bench
from trainer.effects.definition import Parameter, apart
from trainer.model.model import EffectInstance


def may_come_apart(present: EffectInstance, bench: Bench) -> bool:
    """Whether an effect has values in common that colours may have for themselves."""
    return len(bench.channels) > 1 and present.effect.colours == "either" and present.effect.in_common is None


def come_apart(present: EffectInstance, bench: Bench) -> EffectInstance:
    """The same effect with values for each colour, all as they are now."""
    values = {
        p.name: np.stack([present.values[p.name]] * len(bench.channels))
        if in_common(p)
        else present.values[p.name]
        for p in present.effect.parameters
    }
    return replace(present, effect=apart(present.effect), values=values, errors=None)


def put_together(present: EffectInstance) -> EffectInstance:
    """The same effect with one value for all colours, the mean of theirs."""
    common = present.effect.in_common
    assert common is not None
    values = {
        p.name: present.values[p.name].mean(0) if in_common(p) else present.values[p.name]
        for p in common.parameters
    }
    nodes = present.nodes
    if nodes is not None and nodes.ndim == 3:
        nodes = nodes.mean(0)
    return replace(present, effect=common, values=values, errors=None, nodes=nodes)


def in_common(parameter: Parameter) -> bool:
    """Whether colours have a parameter in common, as the effect is before it comes apart."""
    return not (parameter.per_channel or parameter.per_pixel)
