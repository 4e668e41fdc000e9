"""Which numbers no motion can tell apart, derived from the equations alone."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from physics.small_arm import ARM

from bampipe.physics import Model, compile_model, registry
from bampipe.physics.device import Device
from bampipe.physics.registry import device, device_from
from bampipe.physics.structure import structure

RAIL = re.findall(
    r"```toml\n(.*?)```", (Path(__file__).parents[2] / "docs/devices.md").read_text(), re.S
)[0]


def test_the_drive_of_the_bam_enters_only_in_sums() -> None:
    found = structure(compile_model(Model(registry.device("bam"))))
    (group,) = found.together
    assert set(group.members) == {"I_g", "I_hs", "I_s10", "I_t", "I_xx", "I_yy", "I_zz", "N"}
    assert set(group.combinations) == {
        "I_yy - I_zz",
        "I_g + I_hs + I_s10 N^2 + I_xx",
        "I_hs + I_s10 N^2 + I_t + I_zz",
    }
    named = {number.name: number.value for number in found.numbers}
    assert {"L", "design_mass", "g", "I_xy", *group.combinations} <= set(named)
    sum_ = 0.0288 + 0.004313 + 0.01552 * 25 + 0.821
    assert abs(named["I_g + I_hs + I_s10 N^2 + I_xx"] - sum_) < 1e-12


def test_slopes_are_those_of_the_residual() -> None:
    """The inertia about pitch acts with the pitch acceleration alone, L as a difference says."""
    device = registry.device("bam")
    system = compile_model(Model(device))
    found = structure(system)
    rng = np.random.default_rng(5)
    q = np.stack([*rng.uniform(-0.4, 0.4, (2, 20)), rng.uniform(0.8, 1.4, 20)], axis=1)
    qd, qdd = rng.normal(size=(2, 20, 3))
    u, z = rng.normal(size=(20, len(system.inputs))), np.zeros((20, 0))
    slopes = found.slopes(q, qd, qdd, z, u, system.prior)
    place = {number.name: i for i, number in enumerate(found.numbers)}
    pitch = slopes[:, :, place["I_g + I_hs + I_s10 N^2 + I_xx"]]
    np.testing.assert_allclose(pitch, np.stack([0 * q[:, 0], -qdd[:, 1], 0 * q[:, 0]], axis=1))
    step = 1e-5
    changed = {**device.declaration, "constants": {**device.declaration["constants"]}}
    changed["constants"]["L"] = {**changed["constants"]["L"], "value": 0.461 + step}
    moved = compile_model(Model(registry.device_from(changed)))
    there, here = (s.residual(q, qd, qdd, z, u, system.prior) for s in (moved, system))
    np.testing.assert_allclose(slopes[..., place["L"]], (there - here) / step, rtol=1e-3, atol=1e-3)


def test_any_device_is_understood_and_what_hides_another() -> None:
    rail = registry.device_from(tomllib.loads(RAIL), "rail.toml")
    (group,) = structure(compile_model(Model(rail))).together
    assert set(group.combinations) == {
        "g mass sin(tilt)",
        "mass + 2 pulley_inertia/pulley_radius^2",
    }
    exact = registry.device_from(tomllib.loads(RAIL.replace("= 9.81", "= 9.81, sd = 0.0")))
    assert "mass sin(tilt)" in structure(compile_model(Model(exact))).together[0].combinations
    assert structure(compile_model(Model(registry.device("slider")))).together == ()
    # Sympy cannot tell that the logarithm of the saturation is real.
    effects = ("channel_saturation:supply", "drive_sag:joint")
    assert structure(compile_model(Model(registry.device("servo_pendulum"), effects))).numbers
    device = registry.device("bam")
    bare = registry.device_from({k: v for k, v in device.declaration.items() if k != "torque"})
    (group,) = structure(compile_model(Model(bare, ("handle_payload",)))).together
    assert {"L", "mass", "handle_payload.payload"} <= set(group.members)
    assert "handle_payload.payload + mass" in group.combinations
    assert "g" not in group.members
    (group,) = structure(compile_model(Model(device, ("handle_payload",)))).together
    assert "L" not in group.members  # the compensator shows it


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
    z = rng.normal(size=(SAMPLES, len(system.memory_names + system.changes)))
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
