"""The unscented filter on raw samples: a search on the first trial, then a pass over all trials."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.estimate.differentiation import spline_curvature
from bampipe.estimate.filter_uncertainty import at_block_ends
from bampipe.estimate.innovations import average_stretches
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import (
    FilterFailure,
    FilterModel,
    FilterOutcome,
    Stored,
    Trial,
    filter_trials,
)
from bampipe.identification.sensor_noise import FilterChoice
from bampipe.physics import System
from bampipe.progress import Progress
from bampipe.trials.motion import Motion, trial_sizes
from bampipe.trials.reading import input_columns, read_samples

_STORED, _STORED_IN_ALL = 20_000, 100_000
"""Largest number of distributions stored of one trial, and of all: memory must not grow with the
log."""
_COARSE = 300.0
"""Factor on the process noise in the search."""
_LARGEST_NIS = 10.0
"""The filter has lost the motion if its mean normalised innovation squared exceeds this."""

STRETCH_S = 0.05
"""Averaging time of innovations: encoder counts are not noise from sample to sample, and missing
effects act at the pace of a hand."""
_SHIFT_KNOWN = 0.1
"""Relative uncertainty of the initial displacement between encoder and mechanism."""
_REVERSAL_WIDTHS = 5.0
"""An axis counts as reversing within this many widths of the smoothed sign of the velocity."""
_REVERSAL_MARGIN_S = 0.02
"""Time before and after a reversal that is left out as well, s."""


class MotionLost(InputError):
    """The filter does not follow the measured motion from any start."""


Attempt = tuple[Array, Array, float]
"""Parameters to start from (nt,), their sd (nt,), both physical, and a factor on process noise."""


@dataclass(frozen=True)
class Pass:
    """Summary of a filtered trial, without its samples, so that memory does not grow with the log.

    Attributes:
        t: (R,) times, s: every ``stride``-th sample.
        mean: (R, n) state and parameters on the scale of estimation; variance: (R, n).
        ends: distributions at the ends of blocks of time.
        nis: mean normalised innovation squared; counted: number of samples averaged.
        log_likelihood: of all readings, each given those before.
        ratio: (ny,) root mean square of each innovation in its standard deviation.
        stretches: (K, ny) means over ``STRETCH_S`` of innovations in their standard deviations,
            NaN if one is missing; inputs: (K, nu) means of the inputs; stretch_samples: number of
            samples in each.
    """

    t: Array
    mean: Array
    variance: Array
    ends: Stored
    nis: float
    counted: int
    log_likelihood: float
    ratio: Array
    stretches: Array
    inputs: Array
    stretch_samples: int


@dataclass(frozen=True)
class FilterRun:
    """A filter that followed all trials.

    Attributes:
        search: the search, a first pass over the first trial.
        search_theta: (nt,) parameters after the search, on the scale of estimation;
            search_covariance: (nt, nt).
        trials: the main passes over all trials, in ``order``.
        theta: (nt,) parameters after them; covariance: (nt, nt).
        settings: noise levels of the main passes.
        order: indices of ``trials`` in the session.
        restarts: number of attempts that failed before.
        repeats: number of restarts around the filter's own answer.
        first: passes of the run before such a restart; empty if there was none.
    """

    search: Pass
    search_theta: Array
    search_covariance: Array
    trials: tuple[Pass, ...]
    theta: Array
    covariance: Array
    settings: FilterSettings
    order: tuple[int, ...]
    restarts: int
    repeats: int = 0
    first: tuple[Pass, ...] = ()

    @property
    def ends(self) -> list[Stored]:
        """The main passes at the ends of blocks of time."""
        return [one.ends for one in self.trials]

    @property
    def passes(self) -> tuple[Pass, ...]:
        """All passes of the first run and of the last, each with its search first."""
        return (*self.first, self.search, *self.trials)

    @property
    def steps(self) -> tuple[int, ...]:
        """Index in the session of the trial of each of `passes`."""
        return (0, *self.order) * (2 if self.first else 1)

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of all readings in the main passes."""
        return sum(each.log_likelihood for each in self.trials)


def choose_stride(motions: Sequence[Motion]) -> int:
    """Return the number of samples between stored distributions."""
    sizes = trial_sizes(motions)
    return max(-(-max(sizes) // _STORED), -(-sum(sizes) // _STORED_IN_ALL))


def load_filter_trial(
    run: RunFolder, motion: Motion, system: System, p: Array, settings: FilterSettings
) -> Trial:
    """Read the raw samples of a trial, or of a part of it, for the filter.

    The state is that of the mechanism, which elements between it and the encoders may displace.

    ``p`` (n_p,) are parameters near the answer, for the state at the first sample.
    """
    columns = read_samples(run, motion.trial_id, system)
    t = columns["t"] - columns["t"][0]
    brakes = system.model.device.brakes
    for place, name in enumerate(system.inputs):
        if name not in columns and name != "t" and name not in brakes.values():
            columns[name] = np.interp(t, motion.t, motion.inputs(system.inputs)[:, place])
    u = input_columns(columns, system.inputs, brakes)
    y = np.column_stack([columns[f"q_{axis}"] for axis in system.coordinates])
    n = len(system.coordinates)
    if settings.observed.size > n:
        velocity = [np.interp(t, motion.t, column) for column in motion.qd.T]
        y = np.hstack([y, np.stack(velocity, axis=1)])
    # The grid of the motion ends up to a sample before the time stamps.
    step = float(motion.t[-1] - motion.t[0]) / (len(motion.t) - 1)
    own = (t > motion.t[0] - 0.5 * step) & (t < motion.t[-1] + step)
    t, u, y = t[own], u[own], y[own]
    first = int(np.flatnonzero(np.isfinite(y).all(axis=1))[0])
    speed = np.maximum(motion.qd_sd[0], np.sqrt(np.mean(motion.qd**2, axis=0)) * 0.1)
    true = motion.of_mechanism(system, motion.inputs(system.inputs), p)
    x, x_sd = infer_initial_state(
        system, p, y[first, :n], true.qd[0], u[first], settings.reading_sd[:n], speed
    )
    # The last stored distribution must be that of the last sample.
    last = first + (t.size - 1 - first) // settings.stride * settings.stride + 1
    t, u, y = t[first:last], u[first:last], y[first:last]
    curvature = np.zeros(u.shape)
    forced = list(system.forced)
    curvature[:, forced] = spline_curvature(t, u[:, forced])
    return Trial(t, u, y, x, x_sd, curvature)


def infer_initial_state(
    system: System, p: Array, q: Array, qd: Array, u: Array, reading_sd: Array, speed_sd: Array
) -> tuple[Array, Array]:
    """Return the state (nx,) of the mechanism for given readings, and its sd (nx,).

    Args:
        p: (n_p,) parameters; u: (n_u,) inputs; reading_sd: (n_q,) of a position.
        q: positions read by the encoders, (n_q,); qd, speed_sd: rates of the mechanism, (n_q,).
    """
    offset = system.offset(q[None], u[None], p)[0]
    memory = system.initial_memory(q + offset, qd, u, p)
    place = np.hypot(2.0 * reading_sd, _SHIFT_KNOWN * offset)
    spread = np.concatenate([place, speed_sd, np.zeros(len(memory))])
    return np.concatenate([q + offset, qd, memory]), spread


def clear_of_reversal_mask(motion: Motion, system: System, t: Array) -> Flags:
    """Find the samples, at times ``t`` (T,), s, at which each axis moves well clear of reversal.

    Within a few widths of the smoothed sign, friction changes over less than the spread of the
    state, and the readings of an axis at rest are not Gaussian, so that innovations cannot be
    tested there. Returns (T, n_q).
    """
    slow = np.abs(motion.qd) < _REVERSAL_WIDTHS * system.sign_widths
    rate = (len(motion.t) - 1) / float(motion.t[-1] - motion.t[0])
    reach = int(np.ceil(_REVERSAL_MARGIN_S * rate))
    window = np.ones(2 * reach + 1)
    near = np.stack([np.convolve(column, window, "same") for column in slow.T], axis=1)
    place = np.clip(np.searchsorted(motion.t, t), 0, len(motion.t) - 1)
    return np.asarray(near[place] < 0.5)


def build_filter_model(
    system: System, trials: Sequence[Trial], start: Array, timing: bool, late_s: float = 0.0
) -> FilterModel:
    """Return the filter's model.

    Args:
        trials: their sampling interval bounds the input delay.
        start: (n_p,) values of all parameters, including those that are not estimated.
        timing: whether the input delay is estimated, as the last parameter; a model with a delay of
            its own cannot separate the two. late_s: the input delay otherwise.
    """
    places = [i for i, item in enumerate(system.parameters) if not item.fixed]
    lower = [system.parameters[i].lower for i in places]
    upper = [system.parameters[i].upper for i in places]
    if timing:
        half = 0.5 * float(np.median(np.diff(trials[0].t)))
        places, lower, upper = [*places, len(system.parameters)], [*lower, -half], [*upper, half]
    return FilterModel(
        functions=system,
        n_states=len(system.states),
        parameters=np.append(start, late_s),
        free=np.array(places, dtype=np.int64),
        lower=np.array(lower),
        upper=np.array(upper),
        reads_parameters=system.moves_sensors,
    )


def follow_trials(
    model: FilterModel,
    trials: Sequence[Trial],
    choice: FilterChoice,
    names: Sequence[str],
    attempts: Sequence[Attempt],
    settings: FilterSettings,
    *,
    where: str,
    remedy: str,
    report_progress: Progress,
) -> FilterRun:
    """Search on the first trial, then filter all, from the first attempt that succeeds.

    A filter that starts far from the truth but trusts its model does not recover. The first
    trial is therefore filtered with high process noise, which adds almost no information, and
    filtered again at the end.

    Args:
        names: of the trials; where, remedy: of the error if the motion is lost.
        report_progress: called with the fraction of the trials done and the name of the next one.

    Raises:
        MotionLost: no attempt followed the motion.
    """
    engine = filter_trials
    if choice.engine == "filterpy":
        from bampipe.estimate.filterpy_engine import filter_trials_by_filterpy as engine
    order = (*range(1, len(trials)), 0)
    why, found = "", None
    for restarts, (value, sd, factor) in enumerate(attempts):
        mean, spread = model.to_estimated(value, sd)
        level = settings._replace(noise_sd=factor * settings.noise_sd)
        coarse = level._replace(noise_sd=_COARSE * level.noise_sd)
        place = 0
        try:
            report_progress(0.0, names[place])
            search = engine(model, trials[:1], mean, np.diag(spread**2), coarse)
            theta, covariance, passes = search.theta, search.covariance, []
            for done, place in enumerate(order, start=1):
                one = engine(model, [trials[place]], theta, covariance, level)
                theta, covariance = one.theta, one.covariance
                passes.append(_summarise(one, trials[place], choice.block_s))
                report_progress(done / (len(names) + 1), names[place])
                if _is_lost(passes[-1]):
                    break  # other trials cannot rescue it
        except FilterFailure as lost:
            t = trials[place].t[min(lost.sample, trials[place].t.size - 1)]
            why = f"the filter lost the motion of trial {names[place]} at {t:.2f} s: {lost.reason}"
            continue
        found = FilterRun(
            _summarise(search, trials[0], choice.block_s), search.theta, search.covariance,
            tuple(passes), theta, covariance, level, order, restarts,
        )  # fmt: skip
        if not _is_lost(passes[-1]):
            return found
    if found is not None:
        worst = int(np.argmax([trial.nis for trial in found.trials]))
        ratio, axes = found.trials[worst].ratio, model.functions.coordinates
        axis = (*axes, *axes)[int(np.argmax(ratio))]
        why = (
            f"the filter does not follow trial {names[found.order[worst]]}: the error of its"
            f" one-step prediction of {axis} is {ratio.max():.0f} times that of noise"
        )
    raise MotionLost(why, where=where, remedy=remedy)


def _summarise(filtered: FilterOutcome, trial: Trial, block_s: float) -> Pass:
    """Summarise a filtered trial for later steps."""
    one = filtered.trials[0]
    size = np.asarray(one.innovation / one.innovation_sd)
    present = ~np.isnan(one.nis)
    samples = max(1, round(STRETCH_S / float(np.median(np.diff(trial.t)))))
    return Pass(
        t=one.t,
        mean=one.mean,
        variance=np.diagonal(one.covariance, axis1=1, axis2=2).copy(),
        ends=at_block_ends(one, block_s),
        nis=float(one.nis[present].mean()) if present.any() else np.inf,
        counted=int(present.sum()),
        log_likelihood=float(np.nansum(one.log_likelihood)),
        ratio=np.sqrt(np.nanmean(size**2, axis=0)),
        stretches=average_stretches(size, samples),
        inputs=average_stretches(trial.u, samples),
        stretch_samples=samples,
    )


def _is_lost(one: Pass) -> bool:
    return not one.nis / len(one.ratio) < _LARGEST_NIS
