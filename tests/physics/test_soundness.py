"""Where the equations of motion cannot be solved, it is said in physical words."""

import numpy as np
import pytest
from motions import made_up_device, made_up_effect

from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.trials.motion import Motion
from bampipe.trials.soundness import require_sound


def arm(rotor: float):
    """A slider on a turning arm: no inertia about the pivot where the slider is at it."""
    return made_up_device(
        "(mass*(reach**2*ddt(angle)**2 + ddt(reach)**2) + I*ddt(angle)**2)/2",
        {"angle": "reach*force_x", "reach": "force_z"},
        {"mass": ("kg", 2.0, 1.0)},
        coordinates={"angle": {"kind": "rotary"}, "reach": {"kind": "linear"}},
        constants={"I": {"value": rotor, "unit": "kg.m2", "source": "assumed"}},
        inputs={"force": ["force_x", "force_z"]},
    )


def hold(system, q):
    """Hold a machine at poses (T, n_q) without any input."""
    flat, t = np.zeros_like(q), np.arange(len(q)) * 0.01
    idle = dict.fromkeys(system.inputs, 0 * t)
    require_sound(system, [Motion("t01", t, q, flat, flat, flat, idle)])


def check(system, reach):
    hold(system, np.stack([np.full(len(reach), 0.3), reach], axis=1))


def test_no_inertia_at_the_pivot_without_a_rotor():
    system = compile_model(Model(arm(0.0)))
    check(system, np.linspace(0.2, 0.8, 7))
    with pytest.raises(InputError) as caught:
        check(system, np.linspace(0.4, -0.4, 5))
    said = str(caught.value)
    assert "no inverse" in said
    assert "angle = 0.3 rad, reach = 0 m, 0.020 s: angle has no inertia there" in said
    assert "trial t01" in said
    check(compile_model(Model(arm(0.01))), np.linspace(0.4, -0.4, 5))


@pytest.mark.parametrize(
    "pose", [(0.0, 0.0, 0.461), (0.5, np.pi / 2, 1.0), (0.5, -np.pi / 2, 0.461)]
)
def test_the_manipulator_has_inertia_everywhere(pose):
    """Its drives turn with it, so rho = 0 and a vertical rod are poses like any other."""
    system = compile_model(Model(registry.device("bam")))
    hold(system, np.array([pose]))
    rate = np.empty(6)
    x = np.array([*pose, 0.1, -0.1, 0.1])
    system.derivative(x, np.ones(len(system.inputs)), system.prior, np.zeros(4), rate)
    assert np.isfinite(rate).all()


def test_the_effect_that_gives_no_number_is_named():
    text = "-size*sqrt(0.5 - reach)"  # of a negative number beyond 0.5 m
    size = {"size": ("N", 1.0, 1.0)}
    effect = made_up_effect("axis", "torque", size, torque=text, name="hollow")
    model = Model(arm(0.01), ("return_spring:angle", "hollow:reach"), (effect,))
    system = compile_model(model)
    check(system, np.linspace(0.1, 0.4, 4))
    with pytest.raises(InputError, match=r"effect 'hollow:reach' gives no number .*reach = 0.6 m"):
        check(system, np.array([0.2, 0.6, 0.8]))
