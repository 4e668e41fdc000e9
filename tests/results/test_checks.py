"""Checks of a model by its results, and how results are rounded."""

from typing import Any

import pytest
from made_results import filled

from bampipe.phrases.results import find_failed_checks
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import round_with_sd, significant
from bampipe.results.validate import JudgedError

SOUND: dict[str, Any] = {
    "session": {
        "sample_rate_hz": 500.0, "axes": {"yaw": {"unit": "rad", "resolution": 1e-4}},
        "force": {"noise_sd": {"force_x": 0.05}},
    },
    "fit": {
        "convergence": {"converged": True},
        "input_timing": {"estimate": 5e-4, "sd": 1e-4, "limit": 1e-3},
        "innovations": {"yaw": {"whiteness": {"white": True}, "inputs": {"independent": True}}},
    },
    "yaw": {"standing": "above_floor"},
}  # fmt: skip
TIMING = {"estimate": -9.9e-4, "limit": 1e-3}
COUNTS = {"noise_sd": {"force_x": 0.5}, "unit": "N", "look_like_counts": ["force_x"]}
NOT_WHITE = {"yaw": {"sentence": "Not white", "whiteness": {"white": False}}}
DRIVEN = {"yaw": {"sentence": "Not so", "inputs": {"independent": False}}}


def failed(**changes: dict[str, Any]) -> list[str]:
    content = {name: {**part, **changes.get(name, {})} for name, part in SOUND.items()}
    session, fit, yaw = (
        kind.model_validate(filled(kind, content[name]))
        for kind, name in ((IngestResult, "session"), (IdentifyResult, "fit"), (JudgedError, "yaw"))
    )
    return list(find_failed_checks(session, fit, {"yaw": yaw}))


@pytest.mark.parametrize(
    ("where", "change", "words"),
    [
        ("session", {"placeholders": ["device.ratio"]}, "device.ratio: still a place"),
        ("session", {"axes": {"yaw": {"unit": "rad", "resolution": 0.0}}}, "yaw: resolution"),
        ("session", {"force": {"noise_sd": {"force_x": 0.0}}}, "force_x: the noise"),
        ("session", {"force": COUNTS}, "force_x: its readings look like raw counts of a converter"),
        ("fit", {"methods": {"ukf": {"doubts": ["lost"]}}}, "by the unscented filter: lost"),
        ("fit", {"convergence": {"converged": False}}, "not converged"),
        ("fit", {"input_timing": TIMING | {"sd": 1e-4}}, "input timing: -0.99 ± 0.10 ms"),
        ("fit", {"innovations": NOT_WHITE}, "yaw, innovations: not white"),
        ("fit", {"innovations": DRIVEN}, "yaw, innovations: not so"),
        ("yaw", {"standing": "floor_implausible"}, "yaw: the error is far below its noise floor"),
        ("yaw", {"standing": "floor_missing"}, "yaw: the error is without a noise floor"),
    ],
)
def test_each_check_is_heard(where: str, change: dict[str, Any], words: str) -> None:
    assert failed() == []
    found = failed(**{where: change})
    assert len(found) == 1 and words in found[0]


@pytest.mark.parametrize(("method", "heard"), [("ukf", 1), ("least-squares", 0)])
def test_a_filter_that_is_not_published_says_nothing_against_a_model(
    method: str, heard: int
) -> None:
    assert len(failed(fit={"innovations": NOT_WHITE, "method": method})) == heard


@pytest.mark.parametrize(("sd", "limit"), [(0.0, 0.0), (6e-4, 1e-3)])
def test_a_timing_that_was_not_estimated_or_determined_is_at_no_limit(
    sd: float, limit: float
) -> None:
    assert failed(fit={"input_timing": {"estimate": 1e-3, "sd": sd, "limit": limit}}) == []


@pytest.mark.parametrize(
    ("value", "sd", "words"),
    [
        (4.1700, 0.0011, "4.1700 ± 0.0011"),
        (206.4, 9.96, "206 ± 10"),
        (108623.0, 52.0, "108623 ± 52"),
        (-0.0002, 0.02, "0.000 ± 0.020"),
        (3.2e-9, 1.2e-10, "3.20e-09 ± 0.12e-09"),
        (2.0, 0.0, "2 ± 0"),
        (4.4e-6, 3.8e-6, "4.4e-06 ± 3.8e-06"),
        (14.1340, 0.0024, "14.1340 ± 0.0024"),
    ],
)
def test_both_end_at_the_second_digit_of_the_uncertainty(
    value: float, sd: float, words: str
) -> None:
    assert round_with_sd(value, sd) == words


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.073, "0.0730"), (2.4, "2.40"), (0.03196, "0.0320"), (9.996, "10.0"), (1234.5, "1234"),
        (0.0, "0"), (3.4e-5, "3.40e-05"), (-0.5, "-0.500"), (9.9996e-5, "0.000100"),
    ],
)  # fmt: skip
def test_sentences_round_as_tables_do(value: float, words: str) -> None:
    assert significant(value) == words
