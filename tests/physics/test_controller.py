"""Controllers in device files: the law that comes out, and mistakes that are named."""

import copy

import numpy as np
import pytest

from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.control_law import compile_law
from bampipe.physics.model import Model
from bampipe.physics.system import compile_model
from bampipe.physics.units import check_device


def declared(**controller: object):
    content = copy.deepcopy(dict(registry.device("slider").declaration))
    content["controller"] = {**content["controller"], **controller}
    return registry.device_from(content, "axis.toml")


def test_the_servo_saturates_and_the_slider_damps_with_its_measured_rate():
    law = compile_law(registry.device("servo_pendulum"))
    assert law is not None and law.inputs == ("goal", "gain", "supply", "t")
    out = np.empty(1)
    for goal, duty in ((0.02, 0.02 * 1.15), (1.0, 1.0), (-1.0, -1.0)):
        r = np.array([goal, 1.15, 7.4, 0.0])
        law.command(np.zeros(2), r, np.empty(0), out)
        assert out[0] == pytest.approx(duty, rel=1e-6)
    device = registry.device("slider")
    compile_model(Model(device))  # generated code of the same device, kept beside the law's
    law = compile_law(device)
    out = np.empty(1)
    law.command(np.array([0.1, 0.5]), np.array([0.2, 10.0, 3.0, 0.0]), np.empty(0), out)
    assert out[0] == pytest.approx(3.0 * (10.0 * 0.1 - 0.5))
    assert compile_law(registry.device("bam")) is None


def test_a_loop_with_an_integral_part_and_a_law_of_the_wrong_unit():
    device = declared(
        channels={"goal": "m", "gain": "N/m", "wind": "N/m/s"},
        states={"wound": {"unit": "m.s", "rate": "goal - carriage", "lower": -1, "upper": 0.4}},
        command={"force_motor": "gain*(goal - carriage) + wind*wound"},
    )
    assert check_device(device) == []
    law = compile_law(device)
    assert law.limits == ((-1.0, 0.4),)
    out = np.empty(2)
    law.command(np.array([0.1, 0.5]), np.array([0.3, 10.0, 7.0, 0.0]), np.array([0.2]), out)
    assert out == pytest.approx([10.0 * 0.2 + 7.0 * 0.2, 0.2])
    wrong = declared(states={"wound": {"unit": "m", "rate": "goal - carriage"}})
    assert any("controller.states.wound.rate" in line for line in check_device(wrong))
    device = declared(command={"force_motor": "position_gain*(goal - carriage)"})
    assert any(line.startswith("controller.command.force_motor") for line in check_device(device))


@pytest.mark.parametrize(
    ("controller", "words"),
    [
        ({"command": {"force_engine": "1"}}, "one expression is needed for each of force_motor"),
        ({"gains": {}}, 'unknown key "gains"'),
        ({"channels": ["goal"]}, "channels: found .*, expected a table"),
        ({"channels": {"mass": "kg"}}, "'mass' is already taken by"),
        ({"rate_hz": -5}, "rate_hz: found -5, expected 0 or more"),
        ({"states": {"wound": {"rate": "goal - carriage"}}}, "states.wound: 'unit' is missing"),
        ({"states": {"goal": {"unit": "m.s", "rate": "1"}}}, "'goal' is already taken by"),
        (
            {"states": {"wound": {"unit": "m.s", "rate": "1", "lower": 2, "upper": 1}}},
            "lower must be below upper",
        ),
    ],
)
def test_mistakes_are_named(controller, words):
    with pytest.raises(InputError, match=words):
        declared(**controller)


@pytest.mark.parametrize(
    ("law", "words"), [("mass*goal", "unknown symbol 'mass'"), ("ddt(carriage)", "has no ddt")]
)
def test_a_controller_knows_neither_parameters_nor_derivatives(law, words):
    with pytest.raises(InputError, match=words):
        compile_law(declared(command={"force_motor": law}))
