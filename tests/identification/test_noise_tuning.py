"""On which samples the noise levels of the filter are tuned."""

import pytest

from bampipe.identification.sensor_noise import TUNING_SAMPLES, choose_tuning_trials


@pytest.mark.parametrize(
    ("sizes", "places", "samples"),
    [
        ([9000], [0], 3000),
        ([3000, 3000], [0, 1], 1500),
        ([8000] * 11, [0, 2, 4, 6, 8, 10], 500),
        ([400] * 3, [0, 1, 2], 1000),  # all there is
    ],
)
def test_several_trials_share_the_samples(
    sizes: list[int], places: list[int], samples: int
) -> None:
    assert choose_tuning_trials(sizes) == (places, samples)


def test_of_short_trials_more_are_taken() -> None:
    places, samples = choose_tuning_trials([300] * 40)
    assert len(places) == 10
    assert len(places) * samples >= TUNING_SAMPLES
    assert places[0] == 0
    assert places[-1] == 39
