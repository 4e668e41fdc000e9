"""Names beside something unknown that is far above the noise; grids over several shapes."""

from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.diagnosis.candidates import build_candidate_model, compile_candidate
from bampipe.diagnosis.dictionary import Dictionary
from bampipe.diagnosis.probability import _share_explained
from bampipe.diagnosis.ranges import MachineScale
from bampipe.physics import registry

AXIS = MachineScale(
    np.array([-0.05]), np.array([0.2]), np.array([0.3]), np.array([100.0]),
    np.array([50.0]), {"carriage": ("m", "N")}, 1e-3, 20.0, (16.0,),
)  # fmt: skip


@pytest.mark.parametrize(
    ("without", "probability"),
    [
        ((30.0, 1.0), 1.0 - 20.0 / 30.0),  # only the axis that is far shows it
        ((30.0, 1.5), 1.0),  # the other one does, by 40 nats
        ((20.2, 1.1), 1.0),  # the other one does, if by less than 14, by more than the far one
    ],
)
def test_what_only_an_axis_far_above_the_noise_shows_is_as_sure_as_its_share(without, probability):
    rows = {(): (20.0, 1.0), (("-stribeck:yaw", ()),): without}
    search = SimpleNamespace(
        p=SimpleNamespace(independent=np.array([100.0, 100.0])),
        residual_rows=lambda keys: [np.full(50, level) for level in rows[keys]],
    )
    found = _share_explained(search, "stribeck:yaw", np.array([True, False]))
    assert found == pytest.approx(probability)


@pytest.mark.parametrize("name", ["loose_load:carriage", "loose_drive:carriage"])
def test_a_grid_over_several_shapes_covers_each_of_their_ranges(name):
    item = compile_candidate(build_candidate_model(registry.device("slider"), name))
    grid = Dictionary(None, (), {name: item}, AXIS).grid(name)
    assert len(set(grid)) == len(grid) <= 300
    values = [sorted({shape[k] for _, shape in grid}) for k in range(len(grid[0][1]))]
    own = [item.parameters[i].name.rpartition(".")[2] for i in item.searched_indices]
    assert len(values[own.index("gap")]) == max(map(len, values)) >= 9
    for each in values:
        assert len(each) >= 3
        assert each[0] <= 0.2 and each[-1] >= 0.8
