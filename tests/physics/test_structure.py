"""Which numbers no motion can tell apart, derived from the equations alone."""

import re
import tomllib
from pathlib import Path

import numpy as np

from bampipe.physics import Model, compile_model, registry
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
    difference = (
        moved.residual(q, qd, qdd, z, u, system.prior)
        - system.residual(q, qd, qdd, z, u, system.prior)
    ) / step
    np.testing.assert_allclose(slopes[:, :, place["L"]], difference, rtol=1e-3, atol=1e-3)


def test_any_device_is_understood() -> None:
    rail = registry.device_from(tomllib.loads(RAIL), "rail.toml")
    (group,) = structure(compile_model(Model(rail))).together
    assert set(group.combinations) == {
        "g mass sin(tilt)",
        "mass + 2 pulley_inertia/pulley_radius^2",
    }
    assert structure(compile_model(Model(registry.device("slider")))).together == ()


def test_a_payload_and_the_lever_hide_each_other_without_a_compensator() -> None:
    device = registry.device("bam")
    bare = registry.device_from({k: v for k, v in device.declaration.items() if k != "torque"})
    (group,) = structure(compile_model(Model(bare, ("handle_payload",)))).together
    assert {"L", "mass", "handle_payload.payload"} <= set(group.members)
    assert "handle_payload.payload + mass" in group.combinations
    assert "g" not in group.members
    (group,) = structure(compile_model(Model(device, ("handle_payload",)))).together
    assert "L" not in group.members  # the compensator shows it
