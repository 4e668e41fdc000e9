"""The unscented filter in plain numpy, point by point: a second opinion on the compiled one.

It propagates the covariance itself; the numbers must be the same.
"""

from collections.abc import Sequence

import numpy as np

from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.unscented import (
    ALPHA,
    FilteredTrial,
    FilterFailure,
    FilterModel,
    FilterOutcome,
    FilterSettings,
    Trial,
    in_sequence,
)

Predicted = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Mean, covariance, expected reading, its covariance, and that of reading and state."""


class _Points:
    """Sigma points of one trial's filter: how they are drawn, carried, read and weighted."""

    def __init__(self, model: FilterModel, trial: Trial, settings: FilterSettings) -> None:
        self.model, self.settings = model, settings
        self.nx, self.nw = model.n_states, settings.noise_sd.size
        self.n = self.nx + model.free.size
        self.t, self.u = trial.t, np.array(trial.u, dtype=float, order="C")
        self.curvature = trial.input_curvature
        self.p = np.array(model.parameters, dtype=float)

    def draw(
        self, mean: np.ndarray, joint: np.ndarray, *noise: np.ndarray, idle: int = 0
    ) -> np.ndarray:
        """Points of the mean and of independent noise of zero mean, (1 + 2 total, total).

        ``idle`` more pairs, which would move nothing, are only counted.
        """
        root = np.diag(np.concatenate([np.zeros(self.n), *noise]))
        known = np.diag(joint) == 0.0
        part = np.ix_(np.flatnonzero(~known), np.flatnonzero(~known))
        root[: self.n, : self.n][part] = np.linalg.cholesky(joint[part])
        away = ALPHA * np.sqrt(len(root) + idle) * root.T
        centre = np.concatenate([mean, np.zeros(len(root) - self.n)])
        return centre + np.vstack([np.zeros(len(root)), away, -away])

    def moments(
        self, values: np.ndarray, idle: int = 0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean of ``values``, deviations from it and these weighted; ``idle`` pairs are unmoved."""
        other = 0.5 / (ALPHA**2 * ((len(values) - 1) // 2 + idle))
        mean = values[0] + other * np.sum(values[1:] - values[0], axis=0)
        weight = np.full((len(values), 1), other)
        weight[0] = 2 * idle * other
        return mean, values - mean, weight * (values - mean)

    def place(self, point: np.ndarray) -> np.ndarray:
        self.model.place_parameters(point[self.nx : self.n], self.p)
        return point[: self.nx].copy()

    def carry(self, points: np.ndarray, k: int) -> None:
        """Carry the states of ``points`` from sample ``k - 1`` to ``k``."""
        dt = float(self.t[k] - self.t[k - 1])
        substeps = max(1, int(np.ceil(dt / self.settings.longest_step - 1e-6)))
        work = np.empty((6, max(2 * self.nx, self.u.shape[1])))
        for point in points:
            x, w = self.place(point), point[self.n : self.n + self.nw].copy()
            late, c0, c1 = self.p[-1], *self.curvature[k - 1 : k + 1]
            shift = 0.25 * late**2 * (c0 + c1) - late * (self.u[k] - self.u[k - 1]) / dt
            runge_kutta(
                self.model.functions.derivative, x, self.u[k - 1] + shift, self.u[k] + shift, c0,
                c1, self.p, w, dt, substeps, work,
            )  # fmt: skip
            point[: self.nx] = x

    def read(self, points: np.ndarray, k: int) -> np.ndarray:
        found, output = np.empty((len(points), 2 * self.nx)), np.empty(2 * self.nx)
        for point, row in zip(points, found, strict=True):
            self.model.functions.measure(self.place(point), self.u[k], self.p, output)
            row[:] = output
        return found[:, self.settings.observed]


def _predict(points: _Points, mean: np.ndarray, joint: np.ndarray, k: int) -> Predicted:
    settings, n = points.settings, points.n
    drawn = points.draw(mean, joint, settings.noise_sd)
    points.carry(drawn, k)
    mean, away, weighted = points.moments(drawn[:, :n])
    walk = settings.walk_sd**2 * (points.t[k] - points.t[k - 1])
    joint = away.T @ weighted + np.diag(np.concatenate([np.zeros(points.nx), walk]))
    drawn = points.draw(mean, joint, idle=points.nw)
    expected, away, weighted = points.moments(points.read(drawn, k), points.nw)
    s = away.T @ weighted + np.diag(settings.reading_sd**2)
    return mean, joint, expected, s, weighted.T @ (drawn - mean)


def filter_by_covariance(
    model: FilterModel,
    trials: Sequence[Trial],
    theta: np.ndarray,
    covariance: np.ndarray,
    settings: FilterSettings,
) -> FilterOutcome:
    """The compiled filter in its covariance form; as `unscented.filter_trials`."""
    nx, (lower, upper) = model.n_states, model.range

    def filter_one(
        index: int, trial: Trial, theta: np.ndarray, covariance: np.ndarray
    ) -> tuple[FilteredTrial, np.ndarray, np.ndarray]:
        points, size, ny = _Points(model, trial, settings), trial.t.size, settings.observed.size
        mean, joint = np.concatenate([trial.x, theta]), np.zeros((points.n, points.n))
        joint[:nx, :nx], joint[nx:, nx:] = np.diag(np.square(trial.x_sd)), covariance
        means, covariances = [mean], [joint]
        innovation, innovation_sd = np.full((2, size, ny), np.nan)
        nis, log_likelihood = np.full((2, size), np.nan)
        for k in range(1, size):
            try:
                mean, joint, expected, s, both = _predict(points, mean, joint, k)
                if np.isfinite(trial.y[k]).all():
                    innovation[k], innovation_sd[k] = trial.y[k] - expected, np.sqrt(np.diag(s))
                    whitened = np.linalg.solve(np.linalg.cholesky(s), innovation[k])
                    nis[k] = whitened @ whitened
                    log_likelihood[k] = -0.5 * (nis[k] + np.linalg.slogdet(2.0 * np.pi * s)[1])
                    gain = np.linalg.solve(s, both).T
                    mean, joint = mean + gain @ innovation[k], joint - gain @ s @ gain.T
                    mean[nx:] = np.clip(mean[nx:], lower, upper)
            except np.linalg.LinAlgError as error:
                raise FilterFailure(index, k, "lost positive definiteness") from error
            joint = 0.5 * (joint + joint.T)
            means.append(mean)
            covariances.append(joint)
        stored = slice(None, None, settings.stride)
        filtered = FilteredTrial(
            trial.t[stored], np.array(means)[stored], np.array(covariances)[stored],
            innovation, innovation_sd, nis, log_likelihood,
        )  # fmt: skip
        return filtered, mean[nx:].copy(), joint[nx:, nx:].copy()

    return in_sequence(filter_one, trials, np.clip(theta, lower, upper), covariance)
