"""On which samples the noise levels of the filter are tuned."""

import pytest

from bampipe.identification.sensor_noise import choose_tuning_trials


@pytest.mark.parametrize(
    ("sizes", "places", "samples"),
    [
        ([9000], [0], 3000),
        ([3000, 3000], [0, 1], 1500),
        ([8000] * 11, [0, 2, 4, 6, 8, 10], 500),
        ([400] * 3, [0, 1, 2], 1000),  # all there is
        ([300] * 40, [0, 4, 9, 13, 17, 22, 26, 30, 35, 39], 300),
    ],
)
def test_several_trials_share_the_samples(
    sizes: list[int], places: list[int], samples: int
) -> None:
    assert choose_tuning_trials(sizes) == (places, samples)
