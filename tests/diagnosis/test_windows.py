"""Where a prediction fails most: named by trial, in words that hold at any scale."""

from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.diagnosis.shape import _size
from bampipe.stages.diagnose import _map_variables


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (-2e-5, "m", "-0.02 mm"),
        (-1e-9, "m", "0.00 mm"),
        (0.25, "m", "0.25 m"),
        (-0.001, "rad", "0.00 rad"),
        (1.554, "rad", "1.55 rad"),
    ],
)
def test_a_small_stroke_is_given_in_millimetres_and_no_zero_has_a_sign(
    value: float, unit: str, words: str
) -> None:
    assert _size(value, unit) == words


def test_blocks_of_one_trial_are_mapped_under_its_name() -> None:
    """As residuals.parquet has them: the page for exploring joins the two."""
    motions = [SimpleNamespace(trial_id=f"t1@{k}.0s", t=np.arange(k, k + 3.0)) for k in (0, 4)]
    initial = SimpleNamespace(
        motions=motions,
        band=SimpleNamespace(thinned_rows=lambda n: np.arange(n)),
        system=SimpleNamespace(coordinates=()),
    )
    found = _map_variables(initial)  # type: ignore[arg-type]
    assert set(found["trial_id"]) == {"t1"}
    assert found["t"].tolist() == [0.0, 1.0, 2.0, 4.0, 5.0, 6.0]
