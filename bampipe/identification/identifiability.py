"""Identifiability of a model's parameters on given trials, as records and sentences."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.identifiability import (
    Weak,
    cramer_rao_bound,
    growth_without,
    information,
    residual_spectrum,
    undetermined_covariance,
    weak_directions,
)
from bampipe.estimate.least_squares import Problem, residual_and_slopes
from bampipe.estimate.square_root import FilterSettings
from bampipe.identification.sensor_noise import force_noise_mask
from bampipe.lists import join_names
from bampipe.physics import System
from bampipe.physics.structure import DeterminableNumber, structure
from bampipe.results.identify import (
    Combined,
    DeviceNumber,
    IdentifiabilityReport,
    ParameterBound,
    TrialGrowth,
    WeakDirection,
)
from bampipe.trials.motion import Motion, trial_names

_LISTED = 4
"""Largest number of trials named in a sentence."""
_NOTHING = 0.01
"""A trial adds nothing if no bound would grow by more than this fraction without it."""
_CLOSE = 0.9
"""Numbers with a higher correlation are reported to move together."""
_LITTLE = 0.5
"""The data add little if they leave more than this fraction of the prior standard deviation."""
_MOVES = 0.5
"""Smallest reported change of an estimate by an error of one per cent, per cent."""
_KNOWN = 0.1
"""Relative changes are reported only of estimates whose relative standard deviation is smaller."""
_MOST_MOVED = 5
"""Largest number of estimates named for one number."""
_SHIFT = 1e-6
"""Finite difference of a position, rad or m, for the slope of a force."""
TIMING = "input_timing"


def assess_identifiability(
    system: System, motions: Sequence[Motion], problem: Problem, p: Array, noise: FilterSettings
) -> tuple[IdentifiabilityReport, Array]:
    """Assess the uncertainty of the parameters due to sensor noise alone.

    ``p`` (n_p + 1,) are estimates, the input delay last. Returns the report, and the covariance
    (n_parameters, n_parameters) of the priors in directions without information.
    """
    known = structure(system)
    n_p = len(system.parameters)
    names = [system.parameters[i].name if i < n_p else TIMING for i in problem.free]
    joint = [
        find_information(system, motion, problem, k, p, noise, known.slopes)
        for k, motion in enumerate(motions)
    ]
    n = len(names)
    total = np.sum(joint, axis=0)
    total[:n, :n] += np.diag(problem.precision)
    own = total[:n, :n]
    covariance = cramer_rao_bound(own)
    value = p[problem.free]
    estimated = [i for i, name in enumerate(names) if name != TIMING]
    # Inertial parameters all compensate each other: `BaseEstimate` reports them.
    with_priors = set(np.flatnonzero(problem.precision))
    own_words = [i for i in estimated if i not in with_priors]
    weak = [
        w
        for w in weak_directions(own)
        if set(w.members) & set(own_words) and not set(w.members) & with_priors
    ]
    groups = [set(group.members) for group in known.together]
    separable = [i for i in own_words if not any(names[i] in group for group in groups)]
    parted = [w for w in weak if not any({names[i] for i in w.members} <= g for g in groups)]
    growth = growth_without([part[:n, :n] for part in joint])[:, estimated]
    numbers = tuple(
        _describe_number(number, total, n, n + j, names, value, estimated)
        for j, number in enumerate(known.numbers)
    )
    half = problem.upper[-1]  # of a sample: the prior of the input delay
    assumed = np.array([system.parameters[i].sd if i < n_p else half for i in problem.free])
    trials = {
        name: TrialGrowth(
            growth=min(row.max(initial=0.0), 1e9), parameter=names[estimated[int(np.argmax(row))]]
        )
        for name, row in zip(trial_names(motions), growth, strict=True)
    }
    sd = np.sqrt(np.diag(covariance))
    report = IdentifiabilityReport(
        parameters={names[i]: _describe_bound(own, covariance, i, names) for i in estimated},
        weak_directions=tuple(
            WeakDirection.of(w, members=tuple(names[i] for i in w.members)) for w in weak
        ),
        numbers=numbers,
        together=tuple(map(Combined.of, known.together)),
        trials=trials,
        sentences=(
            *(
                f"{_list(group.members)} enter the equations only as {_list(group.combinations)}:"
                " no motion separates them."
                for group in known.together
            ),
            *(_describe_weak(w, names, value, covariance) for w in parted),
            *_describe_unsaid([names[i] for i in separable], sd[separable], assumed[separable]),
            *_describe_idle(trials),
            *_describe_leaning(numbers),
        ),
    )
    return report, undetermined_covariance(own, assumed)[np.ix_(estimated, estimated)]


def find_information(
    system: System,
    motion: Motion,
    problem: Problem,
    trial: int,
    p: Array,
    noise: FilterSettings,
    further: Callable[..., Array] | None = None,
) -> Array:
    """Return the information of one trial on the estimated parameters, with sensor noise alone.

    The motion has the number ``trial`` in ``problem``, and the input delay comes last in ``p``
    (n_p + 1,). ``further`` returns slopes (T, n_q, m) of the residual by further numbers, given
    motion, internal states, inputs and parameters. Returns (n, n), or (n + m, n + m) with those
    numbers last.
    """
    own = p[:-1]
    n = len(system.coordinates)
    u = motion.with_input_timing(float(p[-1])).inputs(system.inputs)
    motion = motion.of_mechanism(system, u, own)
    z = system.memory(*motion.kinematics, u, own, motion.t)
    slope = residual_and_slopes(problem, trial, p)[1]
    if further is not None:
        slope = np.concatenate([slope, further(*motion.kinematics, z, u, own)], axis=2)
    slope *= ~problem.standstill[trial][:, :, None]
    push = system.input_map(motion.q, u, own) * noise.noise_sd[force_noise_mask(system)]
    inertia = np.diagonal(system.mass_matrix(motion.q, own), axis1=1, axis2=2).mean(axis=0)
    known = system.by_name(own)
    damping = np.array([known.get(f"viscous.{axis}", 0.0) for axis in system.coordinates])
    stiffness = _stiffness(system, motion, z, u, own)
    spectrum = residual_spectrum(
        len(motion.t),
        problem.band.rate_hz,
        inertia,
        damping,
        stiffness,
        noise.reading_sd[:n],
        np.sqrt(np.mean(np.sum(push**2, axis=2), axis=0)),
    )
    return information(slope, spectrum)


def _stiffness(system: System, motion: Motion, z: Array, u: Array, p: Array) -> Array:
    """Return the root mean square slope of the required force by the position, (n_q,)."""
    found = np.zeros(len(system.coordinates))
    here = system.required(*motion.kinematics, z, u, p)
    for i in range(len(found)):
        q = motion.q.copy()
        q[:, i] += _SHIFT
        moved = system.required(q, motion.qd, motion.qdd, z, u, p)
        found[i] = np.sqrt(np.mean((moved[:, i] - here[:, i]) ** 2)) / _SHIFT
    return found


def _describe_bound(own: Array, covariance: Array, i: int, names: Sequence[str]) -> ParameterBound:
    """Return the bound, the bound with all others known, and the most correlated parameter."""
    partner, correlation = _partner(covariance, i, names)
    return ParameterBound(
        bound_sd=_finite_sd(covariance[i, i]),
        alone_sd=float(1.0 / np.sqrt(own[i, i])) if own[i, i] > 0.0 else None,
        partner=partner,
        correlation=None if partner is None else correlation,
    )


def _finite_sd(variance: float) -> float | None:
    return float(np.sqrt(variance)) if np.isfinite(variance) else None


def _partner(covariance: Array, i: int, names: Sequence[str]) -> tuple[str | None, float]:
    """Return the other number most correlated with ``i``, and the correlation."""
    sd = np.sqrt(np.diag(covariance))
    usable = np.isfinite(sd) & (sd > 0.0)
    if not usable[i] or usable.sum() < 2:
        return None, 0.0
    correlation = np.zeros(len(sd))
    correlation[usable] = covariance[i, usable] / (sd[i] * sd[usable])
    correlation[i] = 0.0
    place = int(np.argmax(np.abs(correlation)))
    return names[place], float(correlation[place])


def _describe_number(
    number: DeterminableNumber,
    total: Array,
    n: int,
    place: int,
    names: Sequence[str],
    value: Array,
    estimated: Sequence[int],
) -> DeviceNumber:
    """Return the information on one number of the device as if it were estimated too."""
    rows = [*range(n), place]
    covariance = cramer_rao_bound(total[np.ix_(rows, rows)])
    partner, correlation = _partner(covariance, n, names)
    shift = -np.linalg.lstsq(total[:n, :n], total[:n, place], rcond=1e-12)[0]
    # A relative change of an estimate that may be zero would be large and meaningless.
    sd = np.sqrt(np.diag(cramer_rao_bound(total[:n, :n])))
    per_cent = {
        names[i]: float(shift[i] * number.value / value[i])
        for i in estimated
        if sd[i] < _KNOWN * abs(value[i])
    }
    return DeviceNumber.of(
        number,
        bound_sd=_finite_sd(covariance[n, n]),
        partner=partner,
        correlation=correlation,
        moves_percent=per_cent,
    )


def _describe_weak(weak: Weak, names: Sequence[str], value: Array, covariance: Array) -> str:
    """Report parameters that move together; for a pair, how well sum and difference are known."""
    pair = list(weak.members)
    start = f"{_list([names[i] for i in pair])} move together here"
    if (
        len(pair) != 2
        or np.any(value[pair] == 0.0)
        or not np.isfinite(covariance[pair, pair]).all()
    ):
        return (
            f"{start}: the trials keep {100.0 * weak.strength:.2g} % of the information that"
            " separates them."
        )
    relative = covariance[np.ix_(pair, pair)] / np.outer(value[pair], value[pair])
    both = [0.5 * np.sqrt(np.array([1.0, s]) @ relative @ np.array([1.0, s])) for s in (1.0, -1.0)]
    better, worse = ("sum", "difference") if both[0] < both[1] else ("difference", "sum")
    return (
        f"{start}: the {better} of their relative values is known to {100.0 * min(both):.2g} % at"
        f" best, the {worse} to {100.0 * max(both):.2g} %."
    )


def _describe_unsaid(names: Sequence[str], sd: Array, prior: Array) -> list[str]:
    return [
        f"These trials contain no information about `{name}`, which keeps its prior."
        if not np.isfinite(bound_sd)
        else f"These trials contain little information about `{name}`: ± {bound_sd:.2g} at best,"
        f" its prior is ± {assumed:.2g}."
        for name, bound_sd, assumed in zip(names, sd, prior, strict=True)
        if not bound_sd < _LITTLE * assumed
    ]


def _describe_idle(trials: Mapping[str, TrialGrowth]) -> list[str]:
    idle = [name for name, entry in trials.items() if entry.growth < _NOTHING]
    if len(trials) < 2 or not idle:
        return []
    growth = max(trials[name].growth for name in idle)
    alone = f"no bound would grow by more than {100.0 * growth:.1g} %."
    if len(idle) == 1:
        return [f"Trial {idle[0]} adds almost nothing: without it {alone}"]
    which = join_names(idle, _LISTED)
    return [f"Trials {which} add almost nothing: without any one of them {alone}"]


def _describe_leaning(numbers: Sequence[DeviceNumber]) -> list[str]:
    """Report the device's numbers on which estimates depend, and those they resemble."""
    sentences = []
    for number in numbers:
        moved = {name: size for name, size in number.moves_percent.items() if abs(size) >= _MOVES}
        if moved:
            order = sorted(moved, key=lambda name: -abs(moved[name]))
            shown = [f"`{name}` by {moved[name]:+.1f} %" for name in order[:_MOST_MOVED]]
            if len(order) > _MOST_MOVED:
                shown.append(f"{len(order) - _MOST_MOVED} more by less")
            sentences.append(f"An error of 1 % in `{number.name}` would move {join_names(shown)}.")
        if number.partner is not None and abs(number.correlation) > _CLOSE:
            sentences.append(
                f"If `{number.name}` were estimated too, it and `{number.partner}` would move"
                f" together (correlation {number.correlation:+.2f})."
            )
    return sentences


def _list(names: Sequence[str]) -> str:
    return join_names([f"`{name}`" for name in names])
