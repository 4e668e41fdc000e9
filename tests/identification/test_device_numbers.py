"""What estimates rest on, in words."""

import numpy as np

from bampipe.identification.identifiability import _describe_leaning, _describe_number
from bampipe.physics.structure import DeterminableNumber
from bampipe.results.identify import DeviceNumber


def test_what_may_be_zero_moves_by_no_share_of_itself() -> None:
    """The second estimate is as large as its uncertainty at best."""
    total = np.array([[1e4, 0.0, 3e3], [0.0, 1e4, 3e3], [3e3, 3e3, 1e4]])
    number = DeterminableNumber("lever", 0.5, "m")
    found = _describe_number(number, total, 2, 2, ["large", "small"], np.array([2.0, 0.01]), [0, 1])
    assert set(found.moves_percent) == {"large"}
    assert np.isclose(found.moves_percent["large"], -0.3 * 0.5 / 2.0)


def test_the_five_largest_moves_are_named() -> None:
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
