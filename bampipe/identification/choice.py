"""The rule by which ``--method auto`` publishes an estimate.

Least squares under the likelihood are always computed. They are consistent whatever the model
lacks, because the missing force stays in the residual. The unscented filter is more precise if the
model is right and the measured forces drive the machine. It is published if all of these hold:

1. neither a test bench nor a robot controller prescribes the motion, and the model is linear in its
parameters;
2. following it takes at most `MOST_EVALUATIONS` evaluations of the model;
3. it follows the motion, and its innovations have their expected size;
4. no parameter differs from that of least squares by more than chance (Hausman 1978,
   Econometrica 46, 1251: least squares are consistent either way, the filter is efficient);
5. the geometric mean of its standard deviations is smaller;
6. on no axis is its held-out error more than `_MOST_WORSE` times that of least squares.

Otherwise least squares are published. `benchmarks/recovery.py` holds both against the truth.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from bampipe.arrays import Array
from bampipe.identification.estimates import Estimate
from bampipe.identification.least_squares_estimate import SquaresFit
from bampipe.lists import join_names
from bampipe.phrases.results import METHODS
from bampipe.physics import System
from bampipe.results.identify import Method, MethodTried, MethodValue
from bampipe.results.rounding import round_with_sd, significant
from bampipe.trials.motion import Motion, trial_sizes
from bampipe.trials.replicates import steps_to_follow

MOST_EVALUATIONS = 2e7
"""Most evaluations of the model by all sigma points on all trials: about five seconds per pass."""
_CHANCE = 0.01
"""Two estimates disagree if chance explains their largest difference with a lower probability."""
_MOST_WORSE = 1.2
"""Largest ratio of held-out errors at which an estimate may still be published."""
_SHOWN = 4


def why_not_filtered(system: System, squares: SquaresFit, longest_step_s: float) -> str | None:
    """Return why the filter is not run: "" if that needs no note, None if it is run."""
    device = system.model.device
    if device.prescribed or device.robot is not None or not squares.problem.linear:
        return ""
    motions: Sequence[Motion] = squares.trials.motions
    each = steps_to_follow(system, squares.p[:-1], motions[0], longest_step_s)
    steps = each * sum(trial_sizes(motions))
    points = 2 * (len(system.states) + squares.free.size + len(system.noise)) + 1
    if steps * points <= MOST_EVALUATIONS:
        return None
    return f"following the motion would take {steps:.1g} steps of {points} points each"


def find_objections(system: System, by_filter: Estimate, by_squares: Estimate) -> tuple[str, ...]:
    """Return the objections to publishing the filter's estimate, a clause each."""
    apart = np.abs(by_filter.value - by_squares.value)
    chance = stats.norm.isf(0.5 * _CHANCE / max(len(apart), 1))
    far = apart > chance * np.hypot(by_filter.sd, by_squares.sd)
    found = [*by_filter.doubts]
    if far.any():
        triples = zip(by_filter.free[far], by_filter.value[far], by_filter.sd[far], strict=True)
        shown = [
            f"`{system.parameters[place].name}` at {round_with_sd(value, sd)}"
            for place, value, sd in triples
        ]
        found.append(f"it estimates {join_names(shown, _SHOWN)}, which differs by more than chance")
    if worse := describe_worse(system, by_filter.held_out_rmse, by_squares.held_out_rmse):
        found.append(f"its parameters {worse}")
    least = np.finfo(float).tiny
    ratio = np.maximum(by_filter.sd, least) / np.maximum(by_squares.sd, least)
    if (looser := float(np.exp(np.mean(np.log(ratio))))) > 1.0:
        found.append(f"its standard deviations are {significant(looser)} times as large")
    return tuple(found)


def describe_worse(
    system: System, error: Array, other: Array, name: str = METHODS["least-squares"]
) -> str:
    """State that parameters have a far larger held-out error than those by ``name``; else "".

    ``error`` and ``other`` are their errors by axis, (n_q,).
    """
    ratio = error / np.maximum(other, 1e-300)
    axis = int(np.argmax(ratio))
    if ratio[axis] <= _MOST_WORSE:
        return ""
    return (
        f"have a held-out error of {significant(error[axis])} {system.torque_units[axis]} on"
        f" {system.coordinates[axis]}, those of {name} {significant(other[axis])}"
    )


def tabulate_methods(
    system: System, published: Estimate, others: Sequence[Estimate], lost: str
) -> dict[Method, MethodTried]:
    """Return the entries of identify.json on each method, the published one first.

    ``lost`` says why the filter gave no estimate; "" if it gave one or was not run.
    """
    found = dict[Method, MethodTried]()
    for each in (published, *others):
        names = [system.parameters[place].name for place in each.free]
        found[each.method] = MethodTried(
            held_out_rmse=dict(zip(system.coordinates, each.held_out_rmse, strict=True)),
            parameters={
                name: MethodValue(estimate=value, sd=sd)
                for name, value, sd in zip(names, each.value, each.sd, strict=True)
            },
            doubts=each.doubts,
        )
    if lost:
        found["ukf"] = MethodTried(doubts=(lost,))
    return found


def describe_methods(methods: Mapping[Method, MethodTried]) -> list[str]:
    """State the objections to each method, the published one included."""
    published, *others = methods
    words = METHODS[published]
    return [f"Published by {words}, although {doubt}." for doubt in methods[published].doubts] + [
        f"Published by {words}, not by {METHODS[other]}: {'; '.join(doubts)}."
        for other in others
        if (doubts := methods[other].doubts)
    ]
