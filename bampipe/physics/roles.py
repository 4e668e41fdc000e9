"""Roles of parts of a model: compensation of gravity, and delays of a force."""

from typing import Any

import sympy as sp

from bampipe.physics.device import derivative
from bampipe.physics.signals import ActingInputs
from bampipe.physics.vocabulary import Vocabulary


def find_compensation(d: Vocabulary, potential: Any, inputs: ActingInputs) -> list[Any]:
    """Return the generalised force of a gravity compensator, one expression per coordinate.

    That is a torque of the device's own table, on a coordinate that the potential energy depends
    on, that itself depends on the pose; with the effects on it (a compensator that lags or is
    mistuned).

    ``potential`` is the energy of the model, whose terms have been collected.
    """
    torque = d.table(d.model.device.torque, "torque")
    balanced = [
        t.free_symbols & set(d.q) and potential.has(q) for t, q in zip(torque, d.q, strict=True)
    ]
    results = [s if kept else sp.S.Zero for s, kept in zip(d.support, balanced, strict=True)]
    for item in (e for e in d.model.effects if e.effect.uses_support and not e.effect.has_play):
        for key, tree in item.effect.expressions.items():
            place = d.axes.index(item.target_of(key))
            if balanced[place]:
                symbols = d.effect_symbols(item, inputs.logged, inputs.side)
                results[place] += d.build(tree, symbols, key, item)
    return results


def find_delays(d: Vocabulary, applied: list[Any]) -> list[str]:
    """Return parameters that shift a measured force in time, adding its rate times a small shift.

    To first order a shift by p seconds adds +-p times the rate of each force that it shifts,
    mapped to the joints as the force itself is.
    """
    own = [p for item in d.model.effects for p in item.parameters]
    absent = {d.p[p.name]: 0 for p in own if not p.fixed}
    rates = {d.channel[derivative(force, 1)] for force in d.model.device.forces}
    results = []
    for p in own:
        # Sympy is slow to find a slope zero.
        if not any(d.p[p.name] in e.free_symbols and rates & e.free_symbols for e in applied):
            continue
        slope = [sp.diff(e, d.p[p.name]).subs(absent) for e in applied]
        for force in d.model.device.forces:
            rate = d.channel[derivative(force, 1)]
            mapped = [sp.diff(e, d.channel[force]).subs(absent) for e in applied]
            pairs = ((a, b) for a, b in zip(slope, mapped, strict=True) if b != 0)
            ratio = {sp.simplify(sp.diff(a, rate) / b) for a, b in pairs}
            if len(ratio) == 1 and next(iter(ratio)).is_number and next(iter(ratio)) != 0:
                results.append(p.name)
                break
    return results
