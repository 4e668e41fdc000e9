"""Which estimate is published: least squares, or the filter where it agrees and is more precise."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from independent_runs import record_trials
from made_results import write_model

from bampipe.data.run_folder import RunFolder
from bampipe.identification.choice import find_objections
from bampipe.identification.estimates import Estimate
from bampipe.identification.identifiability import _describe_leaning, _describe_number
from bampipe.physics.structure import DeterminableNumber
from bampipe.progress import silent
from bampipe.results.identify import DeviceNumber, IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.validate import ValidateResult
from bampipe.stages import identify, validate

NAMED: Any = SimpleNamespace(
    parameters=[SimpleNamespace(name=f"p{k}") for k in range(3)],
    coordinates=("yaw", "pitch"), torque_units=("N.m", "N.m"),
)  # fmt: skip


def estimate(
    value: list[float], sd: float, doubts: tuple[str, ...] = (), error: float = 0.1
) -> Estimate:
    """Three parameters with one standard deviation, and an error on the second axis."""
    problem: Any = SimpleNamespace(free=np.arange(3))
    return Estimate(
        "ukf", np.array([*value, 0.0]), problem, sd**2 * np.eye(3), np.zeros(3, dtype=bool),
        np.array([0.1, error]), [{}] * 3, {}, lambda: (None, None), doubts,  # type: ignore[arg-type, return-value]
    )  # fmt: skip


SQUARES = estimate([1.0, 2.0, 3.0], 0.1)


def test_a_filter_that_agrees_and_is_more_precise_is_published() -> None:
    assert find_objections(NAMED, estimate([1.1, 1.9, 3.1], 0.05), SQUARES) == ()
    # The largest of several differences by chance is larger than one of them.
    far = replace(SQUARES, p=np.array([1.0, 2.0, 3.39, 0.0]), covariance=0.09**2 * np.eye(3))
    assert find_objections(NAMED, far, SQUARES) == ()


@pytest.mark.parametrize(
    ("filtered", "words"),
    [
        (estimate([1.0, 2.5, 3.0], 0.05), r"it estimates `p1` at 2\.5.* more than chance"),
        (estimate([1.0, 2.0, 3.0], 0.12), r"standard deviations are 1\.20 times as large"),
        (estimate([1.0, 2.0, 3.0], 0.05, ("it is off",)), "it is off"),
        (
            estimate([1.0, 2.0, 3.0], 0.05, error=0.13),
            r"error of 0\.130 N\.m on pitch, those of least squares 0\.100",
        ),
    ],
    ids=["far", "loose", "doubted", "worse"],
)
def test_what_speaks_against_a_filter_is_said(filtered: Estimate, words: str) -> None:
    (said,) = find_objections(NAMED, filtered, SQUARES)
    assert re.search(words, said)


@pytest.mark.parametrize(("error", "doubts"), [(0.11, 0), (0.13, 1)])
def test_a_filter_that_errs_more_is_published_on_request(error: float, doubts: int) -> None:
    task: Any = SimpleNamespace(system=NAMED, config=identify.Config(method="ukf"))
    published, others = identify._choose(task, SQUARES, estimate([1.0, 2.0, 3.0], 0.1, (), error))
    assert len(published.doubts) == doubts and others == [SQUARES]


def test_a_drive_that_friction_stops_at_once_is_not_simulated(tmp_path) -> None:
    """Its friction is a hundred times its inertia: steps of a simulation would be of 0.1 us."""
    _, _, truth = record_trials(tmp_path, "drive", 99201)
    run = RunFolder(tmp_path / "runs/drive")
    write_model(run.root, "base", device=run.read(IngestResult).device)
    identify.execute(run, run.root, identify.Config(), silent)
    found = run.read(IdentifyResult, "base")
    assert found.method == "least-squares"
    assert any("by the unscented filter: following the motion" in note for note in found.notes)
    assert found.parameters["coulomb.rotor"].estimate == pytest.approx(
        truth["coulomb.rotor"], rel=0.01
    )
    inertia = found.parameters["inertia"]
    assert abs(inertia.estimate - truth["inertia"]) < 3.0 * inertia.sd
    validate.execute(run, run.root, validate.Config(), silent)
    judged = run.read(ValidateResult, "base")
    assert judged.axes["rotor"].noise_floor is not None
    assert "its drive prescribes the motion" in judged.free_run.reason


def test_the_five_largest_moves_are_named_and_zero_has_no_share() -> None:
    moves = {f"p{k}": float(k) for k in range(8)}
    number = DeviceNumber(
        name="lever", value=0.5, unit="m", bound_sd=1.0, partner=None, correlation=0.0,
        moves_percent=moves,
    )  # fmt: skip
    (sentence,) = _describe_leaning([number])
    assert sentence == (
        "An error of 1 % in `lever` would move `p7` by +7.0 %, `p6` by +6.0 %, `p5` by +5.0 %,"
        " `p4` by +4.0 %, `p3` by +3.0 % and 2 more by less."
    )
    # The second estimate is as large as its uncertainty at best.
    total = np.array([[1e4, 0.0, 3e3], [0.0, 1e4, 3e3], [3e3, 3e3, 1e4]])
    number = DeterminableNumber("lever", 0.5, "m")
    found = _describe_number(number, total, 2, 2, ["large", "small"], np.array([2.0, 0.01]), [0, 1])
    assert set(found.moves_percent) == {"large"}
    assert np.isclose(found.moves_percent["large"], -0.3 * 0.5 / 2.0)
