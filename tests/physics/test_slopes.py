"""Slopes of the residual that no parameter changes: written out, against differences."""

import numpy as np
import pytest
from physics.small_arm import ARM

from bampipe.physics import Model, compile_model
from bampipe.physics.device import Device
from bampipe.physics.registry import device, device_from

SAMPLES = 1500
"""More than are taken together."""
ROBOT = device_from(ARM)


@pytest.mark.parametrize(
    ("machine", "effects"),
    [
        (device("bam"), ()),
        (device("bam"), ("stribeck:yaw", "handle_payload")),
        (device("bam"), ("transmission_compliance:yaw", "force_bias:x")),
        (ROBOT, ()),
        (ROBOT, ("shear_thinning:one", "friction_of_sum:one-two")),
        (ROBOT, ("gear_loss:two", "encoder_scale:one")),
    ],
)
def test_slopes_equal_differences(machine: Device, effects: tuple[str, ...]) -> None:
    system = compile_model(Model(machine, effects))
    rng, n = np.random.default_rng(3), len(system.coordinates)
    q, qd, qdd = 0.5 * rng.normal(size=(3, SAMPLES, n))
    u, p = rng.normal(size=(SAMPLES, len(system.inputs))), system.prior
    motion = q, qd, qdd
    z = rng.normal(size=(SAMPLES, len(system.memory_names)))
    wanted = sorted(system.lasting)

    found = system.slopes(wanted, *motion, u)

    base = system.residual(*motion, z, u, p)
    for k, i in enumerate(wanted):
        moved = p.copy()
        moved[i] += 1.0
        difference = system.residual(*motion, z, u, moved) - base
        scale = np.abs(base).max() + np.abs(difference).max()
        assert np.abs(found[:, :, k] - difference).max() < 1e-12 * scale, system.parameters[i].name


@pytest.mark.parametrize("machine", [device("bam"), ROBOT])
def test_every_slope_that_no_parameter_changes_is_written_out(machine: Device) -> None:
    system = compile_model(Model(machine))
    assert system.lasting == {i for i, constant in enumerate(system.constant) if constant}


def test_what_is_not_asked_for_is_left_out() -> None:
    system = compile_model(Model(ROBOT))
    motion = (np.ones((5, len(system.coordinates))) for _ in range(3))
    assert system.slopes([], *motion, np.ones((5, len(system.inputs)))).shape[2] == 0
