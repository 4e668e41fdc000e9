"""The noise floor: the held-out error of a model that is the whole truth.

This is the one place where a floor is found; `bampipe.results.standing` holds an error against it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.least_squares import fit
from bampipe.estimate.low_pass import Band
from bampipe.estimate.standstill import find_moving_samples
from bampipe.physics import System
from bampipe.results.standing import standing
from bampipe.trials.bias import remove_bias
from bampipe.trials.draw import ENOUGH_SAMPLES, draw_trials
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.folds import Folds
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion, trial_sizes
from bampipe.trials.replay import StandIn, keep_motion, replay_motions
from bampipe.trials.residuals import ModelOnTrial, problem_of, standstill_of
from bampipe.trials.sensors import Sensors

Array = NDArray[np.float64]

FLOOR_SEED = 0
"""First number, after the user's, of the seeds of replays of the model as it is: the same replays
serve as noise floor in every stage."""
_LIKELY = 1.5
"""Error of published parameters over that of the fit below which they may be the mechanism's: what
filtering does to its readings the fit takes on, they do not."""
_SD_OF_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
STILL_WIDTH = 1.0 / 32.0
"""Sign width, times the device's, of replays that stand still where the motion turns round. On an
axis at 1 kHz whose friction stops it, they leave 0.94 of the error where an eighth of the width
leaves 0.80 and the width itself 0.23."""
PROBE_WIDTH = 1.0 / 8.0
"""The same of the motions that tell whether standing still matters: they leave four fifths of what
the narrow ones do, in a quarter of their time."""
_PROBED, _FEWEST_PROBED = 50_000, 3
"""Samples that those have in all, of trials spread over the session, and how many trials at least:
one by itself may be fast where the others are slow."""
_CLEAR = 1.1
"""Error over floor from which on what standing still adds to a robot's matters: a joint where it
made 1.17 of it had a compliance that replays standing still have as well."""
_SHARE = 0.15
"""Of what exceeds the floor in the mean square: what explains less of it is not named."""
MOST_REPLAYS = 6
"""Replays are repeated until they hold `ENOUGH_SAMPLES`, but no oftener than this: the floor of a
session of forty thousand samples is then known to about 1 %, and longer ones need fewer."""


@dataclass(frozen=True)
class NoiseFloor:
    """Held-out error of replays.

    Attributes:
        level: median over replays, by axis, (n_q,), N.m or N. On a few short trials the fit to a
            replay may run away when one is left out; such a replay must not raise the floor.
        sd: scatter of one replay, from the median deviation.
        replays: how many.
    """

    level: Array
    sd: Array
    replays: int

    @classmethod
    def of_errors(cls, errors: Sequence[Array]) -> NoiseFloor:
        """Median and scatter of the errors (n_q,) of replays."""
        found = np.array(errors)
        level = np.median(found, axis=0)
        return cls(level, _SD_OF_DEVIATION * np.median(np.abs(found - level), axis=0), len(found))

    def raised(self, other: NoiseFloor, error: Array) -> NoiseFloor:
        """The floor of a machine that may be like either kind of replay, or in between.

        By axis as near to the error (n_q,) that it left as the two allow.
        """
        level = np.clip(error, self.level, np.maximum(self.level, other.level))
        sd = np.where(level > self.level, other.sd, self.sd)
        return NoiseFloor(np.asarray(level), sd, self.replays)

    def is_exceeded(self, error: Array) -> bool:
        """Whether the error (n_q,) of some axis is above it."""
        stands = map(standing, error.tolist(), self.level.tolist(), self.sd.tolist())
        return "above_floor" in stands


def floor_replays(motions: Sequence[Motion]) -> int:
    """How many replays of these trials give the floor."""
    total = sum(trial_sizes(motions))
    return int(np.clip(-(-ENOUGH_SAMPLES // max(total, 1)), 1, MOST_REPLAYS))


def replay_evidence(
    stand_in: StandIn,
    system: System,
    start: Array,
    sensors: Sensors,
    kinematics: Kinematics,
    band: Band,
    folds: Folds,
    seed: Sequence[int],
) -> Evidence:
    """Replay all trials by a model and fit ``system``, its like, to them, from ``start`` on."""
    replays = replay_motions(stand_in, sensors, kinematics, seed, alone=True)
    return gather_evidence(system, replays, band, start, folds)


def parameters_to_replay(
    evidence: Evidence, sensors: Sensors, kinematics: Kinematics, published: Array | None = None
) -> Array:
    """Return the parameters (n_p,) of the mechanism whose replays are fitted as the trials are.

    The fit itself where it is linear: filters hardly move it. Of a friction that falls within
    millimetres a second they make a sharper one, whose replays are rougher than the machine.

    Args:
        evidence: the model, fitted; sensors, kinematics: of the session.
        published: parameters (n_p,) without that bias, where they are known.
    """
    system, p = evidence.system, evidence.p
    # What leads a robot's replay along its path is no controller: its bias is not the machine's.
    if evidence.is_linear or system.model.device.robot is not None:
        return p
    if published is not None:
        error = gather_evidence(
            system, evidence.motions, evidence.band, published, evidence.folds, most_iterations=0
        ).rmse()
        if np.all(error < _LIKELY * evidence.rmse()):
            return published
    motions = [evidence.motions[k] for k in evidence.folds.fitted_trials]
    problem = problem_of(system, motions, evidence.band, timing=False)
    found = remove_bias(
        sensors, kinematics, system, motions, problem, fit(problem, np.append(p, 0.0))
    )
    free = problem.free
    inside = (problem.lower < found.p[free]) & (found.p[free] < problem.upper)
    return found.p[:-1] if inside.all() else p


def standing_still_matters(
    evidence: Evidence,
    still: Callable[[], System],
    sensors: Sensors,
    kinematics: Kinematics,
    floor: NoiseFloor,
) -> bool:
    """Whether replays that stand still where the motion turns round would say anything new.

    For a robot, whose fits are expensive, that is probed beforehand. Where replays keep its motion
    as measured they would not. Else its model is moved along some of the trials, creeping and
    standing still, without noise, and held against that motion as it is: on some axis the latter
    must leave clearly more, and not next to nothing beside what is above the floor.

    Args:
        evidence: the model, fitted; still: returns the same with signs of `PROBE_WIDTH`, if wanted.
        sensors, kinematics: of the session.
        floor: by replays that creep.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    system, error = evidence.system, evidence.held_out_rmse
    if system.model.device.robot is None:
        return True
    if keep_motion(evidence.fitted):
        return False
    trials = len(evidence.motions)
    step = max(1, min(round(sum(evidence.sizes) / _PROBED), trials // _FEWEST_PROBED))
    probed = list(evidence.motions[step // 2 :: step])
    stands, creeps = (
        _mean_square_of_own_motion(evidence, moved, probed, sensors, kinematics)
        for moved in (still(), system)
    )
    added, known = stands - creeps, floor.level**2
    clear, excess = (_CLEAR**2 - 1.0) * known, np.maximum(error**2 - known, 0.0)
    return bool(np.any(added > np.maximum(clear, _SHARE * excess)))


def _mean_square_of_own_motion(
    evidence: Evidence,
    moved: System,
    motions: Sequence[Motion],
    sensors: Sensors,
    kinematics: Kinematics,
) -> Array:
    """What a model leaves along a motion of itself without noise, moved as ``moved``, (n_q,)."""
    system, band, p = evidence.system, evidence.band, evidence.p
    none = np.zeros(len(system.coordinates))
    exact = replace(
        sensors, resolution=none, reading_sd=none, force_sd=np.zeros_like(sensors.force_sd)
    )
    stand_in = StandIn(moved, p, motions, sensors.rate_hz)
    seen = replay_motions(stand_in, exact, kinematics, (0,), alone=True)
    square, count = none.copy(), none.copy()
    for trial, motion in enumerate(seen):
        residual = band.thin(ModelOnTrial(system, p, seen, trial).residual)
        used = find_moving_samples(standstill_of(motion, system, sensors.rate_hz), band)
        square += np.sum(residual**2 * used, axis=0)
        count += used.sum(axis=0)
    return np.asarray(square / np.maximum(count, 1.0))


def force_noise_through_offset(evidence: Evidence, sensors: Sensors) -> Array:
    """What noise of the forces leaves of a model by moving its mechanism, mean square, (n_q,).

    Where play is crossed a little force is a long way. Zero for a model without such an offset.

    Args:
        evidence: the model, fitted; sensors: of the session.
    """
    system, p = evidence.system, evidence.p
    square, count = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    for trial in draw_trials(evidence.sizes) if system.moves_sensors else ():
        fitted, rng = evidence.fitted[trial], np.random.default_rng([FLOOR_SEED, trial])
        motion = fitted.motion
        noisy = {
            name: motion.channels[name] + sd * rng.normal(size=motion.t.size)
            for name, sd in zip(system.model.device.forces, sensors.force_sd, strict=True)
        }
        shaken = motion.with_channels(noisy).inputs(system.inputs)
        at = motion.of_mechanism(system, shaken, p).kinematics
        moved = system.residual(*at, fitted.memory, fitted.inputs, p) - fitted.residual
        used = evidence.used[trial]
        square += np.sum((evidence.band.thin(moved) * used) ** 2, axis=0)
        count += used.sum(axis=0)
    return np.asarray(square / np.maximum(count, 1.0))


def find_noise_floor(
    evidence: Evidence,
    p: Array,
    sensors: Sensors,
    kinematics: Kinematics,
    seed: int,
    count: int,
    progress: Callable[[int], None] = lambda done: None,
    replayed: System | None = None,
) -> NoiseFloor:
    """Return the held-out error that the fitted model leaves when it is the truth.

    Every trial is replayed by the model under the measured force and an arm that keeps the motion
    near the measured one; the replay goes through the same sensors, filters and fits. Of a long
    session, trials drawn from all are replayed (`draw_trials`).

    Args:
        evidence: the model, fitted; p: `parameters_to_replay`.
        sensors, kinematics: of the session.
        seed: the user's; count: of replays; progress: called with how many are done.
        replayed: another model with the same parameters, which is replayed in its place.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    chosen = _choose_trials(evidence)
    motions = [evidence.motions[number] for number in chosen]
    system = evidence.system
    stand_in = StandIn(replayed or system, p, motions, sensors.rate_hz)
    folds = evidence.folds.subset(chosen)
    errors = []
    for k in range(count):
        found = replay_evidence(
            stand_in, system, evidence.p, sensors, kinematics, evidence.band, folds,
            (seed, FLOOR_SEED, k),
        )  # fmt: skip
        errors.append(found.held_out_rmse)
        progress(k + 1)
    return NoiseFloor.of_errors(errors)


def _choose_trials(evidence: Evidence) -> list[int]:
    """Numbers of the trials that are replayed for the floor, in order.

    Where the session holds trials out, these are few, and all are needed to judge by.
    """
    everything = list(range(len(evidence.motions)))
    if not all(evidence.folds.judged):
        return everything
    chosen = draw_trials(evidence.sizes)
    folds = evidence.folds.subset(chosen)
    groups = {folds.groups[number] for number in folds.fitted_trials}
    return chosen if len(groups) > 1 else everything
