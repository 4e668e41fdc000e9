"""The unscented filter's estimate: noise levels, pass over all trials, sign width, intervals."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.data.run_folder import RunFolder
from bampipe.estimate.filter_uncertainty import choose_block, sandwich_covariance
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import FilterFailure, Trial, constrain, filter_trials
from bampipe.identification.estimates import Estimate, input_timing
from bampipe.identification.filter_run import (
    Attempt,
    FilterRun,
    MotionLost,
    build_filter_model,
    choose_stride,
    clear_of_reversal_mask,
    follow_trials,
    load_filter_trial,
)
from bampipe.identification.filter_tables import (
    check_innovations,
    convergence,
    state_3sigma,
    tabulate_nis,
    tabulate_states,
    tabulate_trace,
)
from bampipe.identification.least_squares_estimate import SquaresFit
from bampipe.identification.sensor_noise import (
    FilterChoice,
    choose_tuning_trials,
    force_noise_mask,
    noise_levels,
    tune_noise,
)
from bampipe.lists import join_names
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.progress import Progress
from bampipe.results.rounding import significant
from bampipe.trials.disturbances import part_trials
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion, trial_names, trial_sizes

_RESTARTS = 3
"""Number of starts from least squares, each with four times the process noise of the one before."""
_LEAST_REGION = 1e-3
"""Smallest initial deviation from least squares, for a nonlinear model, in prior deviations."""
_AROUND = 10.0
"""Widening of the standard deviations around an answer: such a start adds 1 % of information."""
_PARTS, _LIKELIER = (1, 2, 4), 30.0
"""Divisions of the Runge-Kutta step, and the smallest gain of log likelihood that counts: three
times the gain by a division if friction is smooth on the scale of a step."""
_NARROWER = (0.5, 0.25, 0.0625)
"""Widths of the smoothed sign that are tried, relative to the device's."""
_MOVED_TRIALS, _MOVED_SAMPLES = 5, 10_000
"""Largest number of trials, and of samples in all, on which widths and steps are compared."""
_MOST, _SHOWN = 0.5, 6
"""Fraction of a parameter's variance from which smoothing is reported; most parameters named."""
_SOUND_NIS = (0.5, 2.0)
"""Range of the mean normalised innovation squared with proper noise levels: 0.9 to 1.3 in sound
sessions, 0.06 to 0.2 and 2.8 to 3.7 in those whose motion the filter lost."""


class Filtering:
    """The trials, the model and the noise levels of the filter.

    Attributes:
        motions: parts of trials between disturbances; trials: their raw samples.
        model, settings, choice: of the filter.
        late_sd: (1,) standard deviation of the input delay; (0,) if it is not estimated.
    """

    def __init__(
        self,
        run: RunFolder,
        system: System,
        spec: ModelSpec,
        name: str,
        start: Array,
        squares: SquaresFit,
        sd: Array,
        untuned: FilterSettings,
        choice: FilterChoice,
        report_progress: Progress,
    ) -> None:
        """Read the trials and tune the noise levels.

        Args:
            spec: the model's specification; name: its name in messages.
            start: (n_p,) initial values.
            squares: the least-squares fit, which gives the region of the answer.
            sd: (n,) its standard deviations, those of the prior for undetermined parameters.
            untuned: settings with the noise of the sensors.
        """
        self.system, self.spec, self.name, self.start = system, spec, name, start
        self.squares, self.sd, self.report_progress = squares, sd, report_progress
        motions: Sequence[Motion] = squares.trials.motions
        interval = float(np.median(np.diff(motions[0].t)))
        self.motions = part_trials(motions, 1.0 / interval)
        sizes = trial_sizes(self.motions)
        self.untuned = untuned._replace(stride=choose_stride(self.motions))
        near, self.count = squares.p[:-1], sd.size
        self.trials: Sequence[Trial] = KeptItems(
            load_filter_trial(run, motion, system, near, self.untuned) for motion in self.motions
        )
        timing = squares.free.size > self.count
        self.model = build_filter_model(system, self.trials, start, timing, squares.p[-1])
        self.late_sd = self.model.upper[self.count :] / np.sqrt(3.0)
        seconds = [size * interval for size in sizes]
        block_s = choose_block(seconds, self.model.free.size, choice.block_s)
        self.choice = replace(choice, block_s=block_s)
        report_progress(0.15, "noise levels")
        walk = np.append(untuned.walk_sd, np.zeros(self.late_sd.size))
        places, samples = choose_tuning_trials(sizes)
        self.settings = tune_noise(
            self.untuned._replace(walk_sd=walk),
            self.model,
            [self.trials[place].first(samples) for place in places],
            [np.asarray(self.clear(place)[:samples].all(axis=1)) for place in places],
            (self.answer, self.known),
            force_noise_mask(system),
            choice,
        )

    def narrowed(self, factor: float) -> System:
        """The model with the widths of its smoothed signs multiplied by a factor."""
        return compile_model(self.spec.with_sign_widths(factor).model())

    @property
    def answer(self) -> Array:
        """(nt,) the least-squares parameters, with no change of the input delay."""
        late = np.zeros(self.late_sd.size)
        return np.append(self.squares.p[self.squares.free[: self.count]], late)

    @property
    def known(self) -> Array:
        """(nt,) standard deviations of `answer`."""
        return np.append(self.sd, self.late_sd)

    def clear(self, place: int) -> Flags:
        """Find the samples of a trial that are clear of reversals, (T, n_q)."""
        return clear_of_reversal_mask(self.motions[place], self.system, self.trials[place].t)

    @property
    def attempts(self) -> list[Attempt]:
        """The starts: the prior, then least squares with increasing process noise.

        A model that is nonlinear in its parameters only starts around least squares: a prior as
        wide as its range would make it diverge.
        """
        places, late = self.squares.free[: self.count], np.zeros(self.late_sd.size)
        free = [self.system.parameters[k] for k in places]
        prior_sd = np.append([item.sd for item in free], self.late_sd)
        first = np.append(self.start[places], late)
        spread = np.hypot(prior_sd, first - np.append(self.system.prior[places], late))
        if self.squares.problem.linear:
            around, attempts = prior_sd, [(first, spread, 1.0)]
        else:
            least = np.hypot(self.known, _LEAST_REGION * prior_sd)
            around, attempts = np.minimum(_AROUND * least, spread), []
        return attempts + [(self.answer, around, 4.0**k) for k in range(_RESTARTS)]

    def run(self, attempts: Sequence[Attempt], settings: FilterSettings) -> FilterRun:
        """Filter all trials, from the first of some starts that follows the motion."""
        return follow_trials(
            self.model,
            self.trials,
            self.choice,
            trial_names(self.motions),
            attempts,
            settings,
            where=f"model {self.name}",
            remedy="try --method least-squares, or set the trial aside if its sensors jumped there",
            report_progress=lambda done, name: self.report_progress(0.35 + 0.6 * done, name),
        )

    def find(self) -> "tuple[FilterRun, _Width | None, _Widths]":
        """Return the run to publish, the narrower sign width if chosen, and the widths compared."""
        found = self.run(self.attempts, self.settings)
        widths = _Widths(self, found)
        width = None if self.system.model.device.prescribed else widths.choose()
        if width is None:
            return found, None, widths
        functions, declared = self.narrowed(width.factor), self.model
        self.model = replace(self.model, functions=functions)
        value, slope = self.model.to_physical(found.theta)
        around = _AROUND * slope * np.sqrt(np.diag(found.covariance))
        with suppress(MotionLost):  # a narrow sign may make it diverge at a single reversal
            settings = found.settings._replace(longest_step=widths.step / width.parts)
            again = self.run([(value, around, 1.0)], settings)
            if again.log_likelihood > found.log_likelihood + _LIKELIER:
                first = found.first or found.passes
                again = replace(again, restarts=found.restarts, repeats=1, first=first)
                return again, width, _Widths(self, again, width.factor)
        self.model = declared
        return found, None, widths


def estimate_by_filter(filtering: Filtering) -> Estimate:
    """Search on the first trial, then filter all trials.

    Raises:
        MotionLost: the filter does not follow the motion.
    """
    found, width, widths = filtering.find()
    model, count, system = filtering.model, filtering.count, filtering.system
    squares = filtering.squares
    problem, motions = squares.problem, filtering.motions
    sandwich, blocks = sandwich_covariance(
        found.ends, model.n_states, found.search_theta, found.search_covariance
    )
    value, slope = model.to_physical(constrain(model, found.theta, sandwich))
    scaled = sandwich * np.outer(slope, slope)
    off, spread = _find_smoothing(width, widths)
    p = np.append(filtering.start, squares.p[-1])
    p[problem.free] = value
    tight = slope * np.sqrt(np.diag(found.covariance))
    at_bound = (value - model.lower < tight) | (model.upper - value < tight)
    names = [system.parameters[k].name for k in problem.free[:count]]
    nis = tabulate_nis(found, motions)
    report = {
        "nis": nis,
        "innovations": check_innovations(system, found, filtering.clear),
        "noise": noise_levels(system, found.settings, filtering.untuned),
        "input_timing": input_timing(p, problem, scaled),
        "blocks": blocks,
        "restarts": found.restarts,
        "repeats": found.repeats,
        "state_3sigma": state_3sigma(system, found.trials),
        "convergence": convergence(names, model, found, sandwich),
    }
    covariance = (scaled + np.outer(off, off) + np.diag(spread**2))[:count, :count]
    smoothing = np.hypot(off, spread)[:count]
    rows = filtering.choice.trace_rows
    doubt = (
        f"its mean normalised innovation squared is {nis.mean:.2g}; it is 1 if the noise levels"
        " are right"
    )
    return Estimate(
        method="ukf",
        p=p,
        problem=problem,
        covariance=covariance,
        at_bound=at_bound[:count],
        held_out_rmse=squares.held_out_rmse(p),
        details=[{"filter_sd": tight[k], "smoothing_sd": smoothing[k]} for k in range(count)],
        report=report,
        tabulate=lambda: (
            [tabulate_states(system, motions, found, p[:-1], rows)],
            tabulate_trace(names, model, motions, found, rows),
        ),
        doubts=() if _SOUND_NIS[0] < nis.mean < _SOUND_NIS[1] else (doubt,),
        notes=_describe_smoothing(names, smoothing, np.sqrt(np.diag(covariance)), width),
    )


def _find_smoothing(width: "_Width | None", widths: "_Widths") -> tuple[Array, Array]:
    """Return the bias due to smoothing, and the spread between likely widths, both (nt,).

    A machine with dry friction truly stands still, whereas the model creeps within the width of its
    smoothed sign. The error of the filter is proportional to that width, so it is twice the change
    at half the chosen width. If the narrower sign makes the readings less likely, or fails, the
    machine creeps too, and the bias is zero. Both widths are filtered around the answer, on some of
    the trials and in finer steps, because the narrower one may be stiffer. The spread is the
    disagreement between widths of nearly equal likelihood.
    """
    factor, parts = (1.0, 1) if width is None else (width.factor, width.parts)
    likely, value = widths.filter(factor, 2 * parts)
    likelier, moved = widths.filter(_NARROWER[0] * factor, 2 * parts)
    off = (moved - value) / (1.0 - _NARROWER[0]) if likelier > likely > -np.inf else 0.0 * value
    return off, np.zeros(off.size) if width is None else width.spread


def _describe_smoothing(
    names: Sequence[str], smoothing: Array, sd: Array, width: "_Width | None"
) -> tuple[str, ...]:
    """Describe a narrower sign, and parameters whose uncertainty is mostly due to smoothing."""
    said = []
    if width is not None:
        said.append(
            f"The filter smooths the sign of the velocity over {significant(width.factor)} of the"
            " device's `sign_width`, which raises the likelihood of the readings."
        )
    most = smoothing**2 > _MOST * np.maximum(sd**2, np.finfo(float).tiny)
    if most.any():
        listed = [f"`{name}`" for name, here in zip(names, most, strict=True) if here]
        said.append(
            f"Most of the uncertainty of {join_names(listed, _SHOWN)} comes from the smoothed sign"
            " of the velocity, because a machine may stand still."
        )
    return tuple(said)


def _some_of(trials: Sequence[Trial], found: FilterRun) -> tuple[list[Trial], Array]:
    """Return beginnings of evenly spread trials, and a covariance to start from near the answer."""
    stride = found.settings.stride
    count = min(len(trials), _MOVED_TRIALS)
    places = np.linspace(0, len(trials) - 1, count).round().astype(int)
    most = (_MOVED_SAMPLES // count - 1) // stride * stride + 1
    whole = [trials[place] for place in places]
    part = [trial.first(most) for trial in whole]
    share = sum(trial.t.size for trial in part) / sum(trial.t.size for trial in whole)
    share *= count / len(trials)
    return part, _AROUND**2 / share * np.diag(np.diag(found.covariance))


@dataclass(frozen=True)
class _Width:
    """A narrower width over which the filter smooths the sign of a velocity.

    Attributes:
        factor: relative to the device's width; parts: division of the Runge-Kutta step.
        spread: (n,) range of the parameters over widths and steps of nearly equal likelihood.
    """

    factor: float
    parts: int
    spread: Array


class _Widths:
    """Comparison of widths of the smoothed sign on some trials, around an answer.

    Attributes:
        filtered: log likelihood and answer, by width and division of the step.
        step: the longest step, s.
    """

    def __init__(self, filtering: Filtering, found: FilterRun, width: float = 1.0) -> None:
        """Compare other widths with the relative ``width`` at which the answer was ``found``."""
        self.found, self.model, self.width = found, filtering.model, width
        self.narrowed, self.step = filtering.narrowed, filtering.choice.longest_step_s
        self.some, self.covariance = _some_of(filtering.trials, found)
        self.filtered: dict[tuple[float, int], tuple[float, Array]] = {}

    def filter(self, width: float, parts: int) -> tuple[float, Array]:
        """Log likelihood, minus infinity if the motion is lost, and answer, (nt,) physical."""
        if (width, parts) not in self.filtered:
            likely, theta = -np.inf, self.found.theta
            model = self.model
            if width != self.width:
                model = replace(model, functions=self.narrowed(width))
            settings = self.found.settings._replace(
                longest_step=self.step / parts, stride=_MOVED_SAMPLES
            )
            with suppress(FilterFailure):
                outcome = filter_trials(model, self.some, theta, self.covariance, settings)
                likely = sum(float(np.nansum(one.log_likelihood)) for one in outcome.trials)
                theta = outcome.theta
            self.filtered[width, parts] = likely, model.to_physical(theta)[0]
        return self.filtered[width, parts]

    def choose(self) -> _Width | None:
        """Return the width of the highest likelihood; None if no narrower one raises it clearly.

        Friction that stops a machine changes over less than the declared width, and estimates are
        biased in proportion to the difference.
        """
        first, *others = (self.filter(width, _PARTS[1])[0] for width in (1.0, *_NARROWER[:2]))
        if max(others) < first:  # the usual case, at no extra cost: `_find_smoothing` needs both
            return None
        declared = max(self.filter(1.0, parts)[0] for parts in _PARTS)
        if not np.isfinite(declared):  # there is nothing to compare with
            return None
        best = [max(self.filter(width, parts)[0] for parts in _PARTS) for width in _NARROWER]
        if max(best[:2]) < declared + _LIKELIER:
            return None
        most = max(best)
        alike = [key for key, (likely, _) in self.filtered.items() if likely > most - _LIKELIER]
        chosen = min(alike, key=lambda key: key[1])
        far = 0.5 * (most + declared)
        near = [value for likely, value in self.filtered.values() if likely > far]
        spread = np.max(np.abs(np.array(near) - self.filtered[chosen][1]), axis=0)
        return _Width(*chosen, spread)
