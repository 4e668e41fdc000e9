"""Verdicts of several axes that one effect acts on, and what a search refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.discover import growth, verdict
from bampipe.discover.settings import Settings
from bampipe.results.diagnose import Stretch
from bampipe.trials.noise_floor import NoiseFloor

AXES = ("shoulder", "elbow")


@pytest.mark.parametrize("shoulder_after", [0.95, 0.11])
def test_an_effect_that_fails_where_it_helps_most_is_missing_nowhere(monkeypatch, shoulder_after):
    """It acts on two joints, halves the error of the elbow, and the shoulder decides."""

    def evidence(*error):
        system = SimpleNamespace(coordinates=AXES, torque_units=("N.m", "N.m"))
        return SimpleNamespace(held_out_rmse=np.array(error), system=system)

    replay = SimpleNamespace(held_out_rmse=np.array([0.1, 0.1]), share=np.zeros(2))
    floor = NoiseFloor.of_errors([replay.held_out_rmse] * 4)
    search = SimpleNamespace(
        initial=evidence(1.0, 1.0), evidence=evidence(shoulder_after, 0.3), selected=("gain",),
        main={"gain": 0}, final=(replay,) * 4, level=SimpleNamespace(replicates=(replay,) * 4),
        groups={"gain": ()}, wider={}, contests={}, steps=(), cut_short=False, first={},
        transient={}, refused=(), still=(), floor=floor,
        explainable=np.full(2, 0.2), explainable_after=np.full(2, 0.2),
    )  # fmt: skip
    second = SimpleNamespace(stretch=Stretch(trial_id="t01", t_start=0.0, t_end=1.0))
    monkeypatch.setattr(verdict, "_reach", lambda *_: {0, 1})
    monkeypatch.setattr(verdict, "_odds_of_group", lambda *_: {"gain": 1.0})
    monkeypatch.setattr(verdict, "rank", lambda *_: ())
    monkeypatch.setattr(
        verdict, "error_without_second", lambda e, axis: (second, float(e.held_out_rmse[axis]))
    )
    found = verdict.conclude(search, Settings())
    shoulder, elbow = found.axes
    if shoulder_after < 0.5:
        assert [shoulder.verdict, elbow.verdict] == ["missing", "missing"]
        assert found.selected == shoulder.effects == elbow.effects == ("gain",)
    else:
        assert [shoulder.verdict, elbow.verdict] == ["unknown_effect", "undecided"]
        assert found.selected == shoulder.effects == elbow.effects == ()
        assert list(elbow.likely) == ["gain"]


@pytest.mark.parametrize(
    ("error", "without", "slope", "why"),
    [
        (0.97, 0.5, 1.0, "held_out"),  # 2.3 % is not worth an effect
        (0.90, 0.5, 1.0, "held_out"),  # nor is less than a quarter of what was promised
        (0.50, 0.4, 0.5, "held_out"),  # nor what makes both sides of the equation small
        (0.50, 0.4, 1.0, "replays"),
        (2e9, 0.4, 1.0, "runs_away"),  # no figure says anything of it then
        (2e9, 0.4, 0.1, "scale"),
    ],
)
def test_what_is_added_and_refused_stands_with_what_it_did(monkeypatch, error, without, slope, why):
    system = SimpleNamespace(coordinates=("elbow",))

    def fitted(whole, rest, slope):
        evidence = SimpleNamespace(held_out_rmse=np.array([whole]), rest=rest, system=system)
        return SimpleNamespace(
            evidence=evidence, error=np.array([whole]), slope_by_force=np.array([slope]),
            scorer=SimpleNamespace(independent_samples=np.array([100.0])),
        )  # fmt: skip

    monkeypatch.setattr(growth, "error_without_second", lambda e, axis: (None, e.rest))
    score = SimpleNamespace(gain=np.array([60.0]))
    addition = SimpleNamespace(score=score, excess=np.array([60.0]))
    before, after = fitted(1.0, 0.9, 1.0), fitted(error, without, slope)
    found = growth.describe_refusal("lag:x", addition, before, after, Settings())
    assert (found.axis, found.why) == ("elbow", why)
    after = (None, None) if error > 10.0 else (error / slope, without / slope)
    assert found.held_out_rmse_before == 1.0
    assert (found.held_out_rmse_after, found.without_worst_second_after) == after


@pytest.mark.parametrize(("misfit", "least", "most"), [(1.0, 0.97, 1.0), (4.74, 0.8, 0.88)])
def test_scores_decide_the_less_the_less_replays_look_like_the_measurement(misfit, least, most):
    """Between 60 and 37 in log likelihood, good to a tenth."""
    contest = tuple(SimpleNamespace(effect=n, score=x) for n, x in (("lag", 60.0), ("delay", 37.0)))
    search = SimpleNamespace(
        groups={"lag": ()}, wider={}, unlike=("delay",), misfit=misfit, log_prior={},
        contests={"lag": contest},
    )  # fmt: skip
    odds = verdict._odds_of_group(search, "lag", Settings())
    assert least < odds["lag"] < most and sum(odds.values()) == pytest.approx(1.0)


def test_of_two_that_fit_alike_the_one_that_is_hard_to_believe_has_next_to_no_odds():
    """An encoder whose counts are a ninth wrong, 3.8 standard deviations, and a spring."""
    names = ("encoder_scale", "spring")
    contest = tuple(SimpleNamespace(effect=n, score=263.0) for n in names)
    search = SimpleNamespace(
        groups={"spring": ("encoder_scale",)}, wider={}, unlike=(), misfit=1.0,
        contests={"spring": contest}, log_prior={"spring": {"encoder_scale": -0.5 * (3.8**2 - 1)}},
    )  # fmt: skip
    odds = verdict._odds_of_group(search, "spring", Settings())
    assert odds["encoder_scale"] == pytest.approx(0.0012, rel=0.05)
