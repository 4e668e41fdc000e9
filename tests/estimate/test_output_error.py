"""Output error on the slider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slider import RATE, TRUTH, derivative, position_only, record

from bampipe.errors import InputError
from bampipe.estimate.output_error import Segment, fit_output
from bampipe.estimate.simulation import simulate

FREE = np.arange(3)
LOWER, UPPER, STEP = np.array([0.0, 0.0, 0.01]), np.full(3, np.inf), 1e-4 * TRUTH


def segments(seed: int, truth=TRUTH, length: int = 250) -> list[Segment]:
    trial = position_only(record(seed, truth=truth))
    speed = np.gradient(trial.y[:, 0], 1.0 / RATE)
    found = []
    for first in range(0, len(trial.t) - length + 1, length):
        part = slice(first, first + length)

        def run(x0: np.ndarray, p: np.ndarray, part: slice = part) -> np.ndarray:
            x = simulate(
                derivative, x0, trial.u[part], p, 1.0 / RATE, width=np.array([1e-3]), n_noise=1,
                max_step=1e-3,
            )  # fmt: skip
            return x[:, :1]

        found.append(
            Segment(
                run,
                trial.y[part],
                np.array([trial.y[first, 0], speed[first]]),
                np.array([1e-5, 1e-4]),
            )
        )
    return found


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_output_error_recovers_the_truth(factor: float) -> None:
    parts = [part for seed in range(3) for part in segments(seed)]
    found = fit_output(parts, factor * TRUTH, FREE, LOWER, UPPER, STEP)
    sd = np.sqrt(np.diag(found.covariance))
    assert found.converged
    assert np.all(np.abs(found.p - TRUTH) < 4.0 * sd)
    np.testing.assert_allclose(found.p, TRUTH, rtol=5e-3)
    assert np.all(sd < 5e-3 * TRUTH)


def test_output_error_keeps_bounds() -> None:
    parts = [part for seed in range(2) for part in segments(seed, np.array([4.0, 0.0, 2.0]))]
    found = fit_output(parts, TRUTH, FREE, np.array([0.0, 0.3, 0.01]), UPPER, STEP)
    assert found.p[1] == 0.3
    assert np.isfinite(found.covariance).all()


def test_too_few_segments_and_a_motion_without_end_are_refused() -> None:
    parts = segments(0)
    with pytest.raises(InputError, match="3 segments are too few"):
        fit_output(parts[:3], TRUTH, FREE, LOWER, UPPER, STEP)
    lost = [replace(part, simulate=lambda x, p: np.full((250, 1), np.inf)) for part in parts]
    with pytest.raises(InputError, match="without bound"):
        fit_output(lost, TRUTH, FREE, LOWER, UPPER, STEP)


def test_a_motion_that_ends_beside_the_point_reached_is_refused() -> None:
    def fragile(part: Segment) -> Segment:
        def run(x0: np.ndarray, p: np.ndarray) -> np.ndarray:
            x = part.simulate(x0, p)
            return x if p[1] <= TRUTH[1] else np.full_like(x, np.nan)

        return replace(part, simulate=run)

    parts = [fragile(part) for part in segments(0)]
    with pytest.raises(InputError, match="without bound"):
        fit_output(parts, TRUTH, FREE, LOWER, UPPER, STEP)


def test_another_model_moves_the_fit_or_comes_less_close() -> None:
    parts = [part for seed in range(2) for part in segments(seed)]
    found = fit_output(parts, TRUTH, FREE, LOWER, UPPER, STEP)
    sd = np.sqrt(np.diag(found.covariance))
    shift = np.array([0.02, 0.01, -0.01]) * TRUTH

    def changed(part: Segment, by: np.ndarray, wobble: float = 0.0) -> Segment:
        def run(x0: np.ndarray, p: np.ndarray) -> np.ndarray:
            found = part.simulate(x0, p + by)
            return found + wobble * np.sin(np.arange(len(found)))[:, None]

        return replace(part, simulate=run)

    # From beside the best fit, the same model with other names for its numbers comes closer.
    beside = replace(found, reached=found.reached.moved(found.p + 10.0 * sd, 1.0))
    moved = beside.moved_by([changed(part, shift) for part in parts])
    np.testing.assert_allclose(moved + 10.0 * sd, -shift, atol=0.05 * np.abs(shift).max())
    assert not found.moved_by([changed(part, shift, 0.01) for part in parts]).any()
