"""The filter on live samples: state, parameters, and an alarm when they become inconsistent."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.data.stream import MOST_COMPLAINTS
from bampipe.estimate.consistency import WindowTest
from bampipe.estimate.online import OnlineFilter
from bampipe.estimate.unscented import FilterFailure
from bampipe.monitor.start import FIRST_LOOK, MonitorOptions, Start, start_from_samples
from bampipe.physics import System
from bampipe.results.rounding import NORMAL_95

PORTION = 512
"""Samples filtered at once, which bounds the memory."""


class Monitor:
    """Filters samples, keeps the distribution of state and parameters, tests the innovations.

    Attributes:
        alarm: whether the last complete window was inconsistent or held no useful sample;
            alarms: number of runs of such windows.
        restarts: how often the motion was restarted after a gap or a failure of the filter.
        samples: number of samples received.
    """

    def __init__(
        self,
        system: System,
        start: Start | None,
        options: MonitorOptions,
        complain: Callable[[str], None],
    ) -> None:
        """Start from ``start``, or if it is None from the first `FIRST_LOOK` samples.

        ``complain`` is called for the first few restarts of the motion.
        """
        self.system, self.options, self._complain = system, options, complain
        self.alarm, self.alarms, self.restarts, self.samples = False, 0, 0, 0
        self.start: Start | None = None
        self._filter: OnlineFilter | None = None
        self._test: WindowTest | None = None
        self._waiting: list[tuple[Array, Array, Array]] = []
        self._threshold, self._t, self._axis = np.nan, np.nan, ""
        self._first_t = np.nan
        self._useless = 0
        if start is not None:
            self._start_filter(start)

    def push(self, names: Sequence[str], values: Array) -> None:
        """Filter samples (T, m) with columns ``names``, as in a `Conversion`."""
        brakes = {name: f"brake_{axis}" for axis, name in self.system.model.device.brakes.items()}
        for first in range(0, len(values), PORTION):
            part = values[first : first + PORTION]
            if not np.isfinite(self._first_t):
                self._first_t = float(part[0, 0])
            t = part[:, 0].copy()
            given = dict(zip(names, part.T, strict=True)) | {"t": part[:, 0] - self._first_t}
            absent = np.zeros(len(part))
            columns = [given.get(brakes.get(name, name), absent) for name in self.system.inputs]
            u = np.column_stack(columns) if columns else np.zeros((len(part), 0))
            q = part[:, [names.index(f"q_{axis}") for axis in self.system.coordinates]]
            self.samples += len(part)
            if self.start is None:
                useful = np.isfinite(q).all(axis=1)
                self._useless = 0 if useful.any() else self._useless + len(part)
                self._set_alarm(self._useless >= FIRST_LOOK)
                self._waiting.append((t[useful], u[useful], q[useful]))
                if sum(len(item[0]) for item in self._waiting) < FIRST_LOOK:
                    self._t = float(t[-1])
                    continue
                t, u, q = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
                self._waiting.clear()
                self._start_filter(start_from_samples(self.system, t, u, q, self.options))
            self._filter_samples(t, u, q)

    def note_lines_without_sample(self, lines: int) -> None:
        """Raise the alarm if a whole window of lines contained no sample."""
        if lines >= (FIRST_LOOK if self.start is None else self.start.window):
            self._set_alarm(True)

    def report(self) -> dict[str, object]:
        """Return the current state as JSON values, without estimates before the filter starts."""
        content: dict[str, object] = {
            "t": None if np.isnan(self._t) else self._t,
            "samples": self.samples,
            "restarts": self.restarts,
            "alarm": self.alarm,
            "alarms": self.alarms,
        }
        if self._filter is None or self.start is None or self._test is None:
            return content
        model, n = self.start.model, len(self.system.coordinates)
        mean, sd = self._filter.mean, np.sqrt(np.diag(self._filter.covariance))
        names = ("position", "position_sd", "velocity", "velocity_sd")
        values = np.column_stack([mean[:n], sd[:n], mean[n : 2 * n], sd[n : 2 * n]]).tolist()
        content["state"] = {
            axis: dict(zip(names, row, strict=True))
            for axis, row in zip(self.system.coordinates, values, strict=True)
        }
        theta, half = mean[model.n_states :], NORMAL_95 * sd[model.n_states :]
        ends = (model.to_physical(at)[0] for at in (theta, theta - half, theta + half))
        rows = np.column_stack([np.clip(end, model.lower, model.upper) for end in ends]).tolist()
        free = [self.system.parameters[place] for place in model.free]
        content["parameters"] = {
            one.name: {"estimate": value, "lower": low, "upper": high, "unit": one.unit}
            for one, (value, low, high) in zip(free, rows, strict=True)
        }
        ratio, axes = self._test.ratio, self.system.coordinates
        content["nis"] = {
            "window": ratio if np.isfinite(ratio) else None,
            "threshold": self._threshold,
            "windows": self._test.windows,
            "worst": self._axis,
            "useless": [axes[i] for i in np.flatnonzero(self._test.useless)],
        }
        return content

    def _set_alarm(self, inconsistent: bool) -> None:
        self.alarms += inconsistent and not self.alarm
        self.alarm = inconsistent

    def _start_filter(self, start: Start) -> None:
        self.start = start
        self._test = WindowTest(len(self.system.coordinates), start.window)
        self._threshold = start.threshold

    def _filter_samples(self, t: Array, u: Array, q: Array) -> None:
        """Filter samples in stretches; a gap between them restarts the motion."""
        ahead = np.diff(t, prepend=t[0] if np.isnan(self._t) else self._t)
        gaps = (int(i) for i in np.flatnonzero(ahead > self.options.gap_s) if i > 0)
        for first, last in pairwise([0, *gaps, len(ahead)]):
            if ahead[first] > self.options.gap_s and self._filter is not None:
                self._restart(f"a gap of {ahead[first]:.3g} s before {t[first]:.3f} s")
            self._filter_stretch(t[first:last], u[first:last], q[first:last])
        self._t = float(t[-1])

    def _filter_stretch(self, t: Array, u: Array, q: Array) -> None:
        start, test = self.start, self._test
        assert start is not None and test is not None
        if self._filter is None:
            rows = np.flatnonzero(np.isfinite(q).all(axis=1))
            first = int(rows[0]) if rows.size else len(t)
            self._add_unfiltered(np.isfinite(q[:first]))
            if not rows.size:
                return
            t, u, q = t[first:], u[first:], q[first:]
            x, x_sd = start.state(self.system, q[0], u[0])
            self._filter = OnlineFilter(
                start.model, start.settings, x, x_sd, start.theta, start.covariance
            )
        try:
            found = self._filter.advance(t, u, q)
        except FilterFailure as failure:
            self._filter = None
            self._add_unfiltered(np.zeros(q.shape, dtype=bool))
            self._restart(f"near {t[min(failure.sample, t.size - 1)]:.3f} s {failure.reason}")
            return
        with np.errstate(over="ignore"):
            squares = np.square(found.innovation / found.innovation_sd)
        complete = np.isfinite(q).all(axis=1)
        present = np.isfinite(q) & (np.isfinite(found.nis) | ~complete)[:, None]
        self._take_innovations(test, found.nis, squares, present)

    def _add_unfiltered(self, present: Flags) -> None:
        """Count samples that were not filtered; ``present``: see `WindowTest.take`."""
        if self._test is not None:
            nothing = np.full(present.shape, np.nan)
            self._take_innovations(self._test, np.full(len(present), np.nan), nothing, present)

    def _take_innovations(
        self, test: WindowTest, nis: Array, squares: Array, present: Flags
    ) -> None:
        for mean in test.take(nis, squares, present):
            self._set_alarm(bool(mean > self._threshold))
            worst = np.where(test.useless, np.inf, test.by_reading)
            self._axis = self.system.coordinates[int(np.argmax(worst))]

    def _restart(self, why: str) -> None:
        """Restart the motion; the parameters keep their present estimates."""
        self.restarts += 1
        if self.restarts <= MOST_COMPLAINTS:
            self._complain(f"{why}: the motion is restarted")
        if self._filter is not None and self.start is not None:
            nx = self.start.model.n_states
            self.start = replace(
                self.start,
                theta=self._filter.mean[nx:].copy(),
                covariance=self._filter.covariance[nx:, nx:],
            )
        self._filter = None
