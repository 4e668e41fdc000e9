"""What a device has against gravity (eqs 15, 16), and which parameters shift forces in time."""

import tomllib

import numpy as np
import pytest
from motions import with_values

from bampipe.physics import Model, System, compile_model, registry

Q = np.array([[0.1, 0.2, 1.1], [-0.4, -0.3, 0.8]])
QD = np.array([[0.3, -0.1, 0.2], [0.0, 0.4, -0.3]])
BALANCED = 3.56 * 9.81 * (Q[:, 2] - 0.461) * np.cos(Q[:, 1])


def torque(system: System, values: dict[str, float], z: np.ndarray | None = None) -> np.ndarray:
    p = with_values(system, values)
    z = np.zeros((2, len(system.memory_names))) if z is None else z
    return system.compensation(Q, QD, z, np.zeros((2, len(system.inputs))), p)


def test_the_compensator_balances_gravity_on_pitch() -> None:
    system = compile_model(Model(registry.device("bam")))
    found = torque(system, {})
    assert [system.coordinates[i] for i in system.compensated] == ["pitch"]
    np.testing.assert_allclose(found[:, 1], BALANCED, rtol=1e-12)
    assert not found[:, [0, 2]].any()


def test_effects_of_the_compensator_change_its_torque_and_others_do_not() -> None:
    names = ("gravity_compensator_mistuned", "gravity_compensator_lag", "base_tilt")
    system = compile_model(Model(registry.device("bam"), names))
    wrong = {"gravity_compensator_mistuned.error": 0.1}
    behind = Q[:, 2:] - 0.461 - 0.05
    found = torque(system, wrong, behind)[:, 1]
    np.testing.assert_allclose(found, 1.1 * BALANCED - 3.56 * 9.81 * 0.05 * np.cos(Q[:, 1]))


def test_an_offset_where_nothing_is_to_be_balanced_is_none() -> None:
    system = compile_model(Model(registry.device("slider")))
    assert system.compensated == ()
    assert system.compensation(*[np.zeros((3, 1))] * 2, np.zeros((3, 0)), np.zeros((3, 1)),
                               system.prior).tolist() == [[0.0]] * 3  # fmt: skip


OWN = """
schema = "bampipe.effect/1"
name = "late_push"
summary = "One channel is read early"
scope = "force_component"
kind = "input"
looks_like = "residual like the rate of that force"
source = "test"
input = "f - lead*f_rate"
[parameters.lead]
unit = "s"
prior = 0.0
sd = 0.01
strength = true
"""


@pytest.mark.parametrize(
    ("effects", "delays"),
    [
        ((), ()),
        (("force_gain:x", "force_drift:y", "transmission_compliance:yaw"), ()),
        (("stribeck:yaw", "force_delay"), ("force_delay.delay",)),
        (("late_push:z",), ("late_push.z.lead",)),
    ],
)
def test_delays_are_told_from_what_they_do(
    effects: tuple[str, ...], delays: tuple[str, ...]
) -> None:
    own = registry.effect_from(tomllib.loads(OWN), "late_push.toml")
    system = compile_model(Model(registry.device("bam"), effects, (own,)))
    assert system.delays == delays
