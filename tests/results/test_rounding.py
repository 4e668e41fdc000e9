"""An estimate has the digits that its uncertainty leaves it."""

import pytest

from bampipe.results.rounding import round_with_sd, significant


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
