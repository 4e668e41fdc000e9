"""Device and effect files that are wrong: InputError that names the field, never a traceback."""

import copy
import math

import numpy as np
import pytest
from motions import declaration, made_up_device

from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry

BAM = registry.device("bam")
REMOVE = object()


def stribeck():
    return copy.deepcopy(dict(registry.effect("stribeck").declaration))


def label(value):
    """Name of a case's part, the same in every process."""
    return "removed" if value is REMOVE else ascii(value)[:30]


def change(tree, path, value):
    """``tree`` with the entry at dotted ``path`` set to ``value``, or removed."""
    *folders, last = path.split(".")
    for key in folders:
        tree = tree.setdefault(key, {})
    if value is REMOVE:
        del tree[last]
    else:
        tree[last] = value


DEVICES = [
    ("name", REMOVE, "'name' is missing"),
    ("schema", "bampipe.device/9", "schema"),
    ("coordinate", {}, "did you mean 'coordinates'"),
    ("coordinates.yaw.kind", "angular", "coordinates.yaw"),
    ("coordinates.yaw.sign_width", 0.0, "sign_width"),
    ("coordinates.sin", {"kind": "rotary"}, "name of a function"),
    ("coordinates.elbow", {"kind": "rotary"}, "elbow has no inertia"),
    ("constants.L.value", math.nan, "constants.L"),
    ("constants.yaw", {"value": 1.0}, "already"),
    ("definitions.rho", "extension - LL", "did you mean 'L'"),
    ("energy.kinetic", REMOVE, "energy: 'kinetic' is missing"),
    ("energy.kinetic", "mass*ddt(yaw)", "quadratic"),
    ("energy.kinetic", "mass*ddt(yaw)**2*force_x", "kinetic energy"),
    ("energy.potential", "mass*ddt(yaw)", "potential energy"),
    ("energy.potential", "mass*sgn(yaw)", "smooth"),
    ("torque.pitch", "compensation*ddt(ddt(pitch))", "torque"),
    ("inputs.force", ["force_x", "force_y", "force_z", "force_a = 0; import os"], "be a name"),
    ("inputs.force", ["force_x", "force_y"], "unknown symbol 'force_z'"),
    ("applied.yaw", "extension*force_x**2", "effect of a force"),
    ("process_noise.gravity_compensator.torque.elbow", "1", "process_noise.gravity_compensator"),
    ("friction.yaw.coulomb", REMOVE, "friction.yaw"),
    ("friction.yaw.viscous.prior", "three", "prior"),
    ("friction.yaw.viscous.prior", -1.0, "outside"),
    ("parameters.viscous.yaw", {"unit": "", "prior": 0, "sd": 1}, "parameters.viscous"),
    ("limits.yaw.lower", 9.0, "limits.yaw"),
    ("limits.yaw.lower", -(10**400), "limits.yaw"),
]


@pytest.mark.parametrize(("path", "value", "says"), DEVICES, ids=label)
def test_wrong_device_file_is_refused_with_its_field(path, value, says):
    entries = declaration()
    change(entries, path, value)
    with pytest.raises(InputError) as caught:
        compile_model(Model(registry.device_from(entries, "lab.toml")))
    assert says in str(caught.value) and "\n" not in str(caught.value)


EFFECTS = [
    ("summary", "", 'summary: found ""'),
    ("scope", "force_component", "scope"),
    ("scope", "device", "table"),
    ("kind", "energy", "'torque' does not apply"),
    ("torque", REMOVE, "torque"),
    ("torque", {"yaw": "1"}, "one expression"),
    ("torque", "-forc*qd", "did you mean 'force'"),
    ("torque", "-force*qd/0", "division by zero"),
    ("parameters.force.rotary", REMOVE, "rotary"),
    ("parameters.force.rotary.sd", 1e300, "sd: beyond what can be computed with"),
    ("states.force", {"rate": "qd"}, "already"),
    ("definitions.force", "qd", "definitions.force: a parameter has this name already"),
    ("states.z = 0; import os", {"rate": "qd"}, "cannot be a name"),
    ("states.z", {"rate": "qd", "initial": "qdd"}, "initial value"),
    ("states.z", {"rate": "ddt(qd)"}, "rate of an internal state"),
    ("devices", ["other"], "does not have"),
]


@pytest.mark.parametrize(("path", "value", "says"), EFFECTS, ids=label)
def test_wrong_effect_file_is_refused_with_its_field(path, value, says):
    entries = stribeck()
    change(entries, path, value)
    with pytest.raises(InputError) as caught:
        effect = registry.effect_from(entries, "lab.toml")
        compile_model(Model(BAM, ("stribeck:yaw",), (effect,)))
    assert says in str(caught.value) and "\n" not in str(caught.value)


OFFSETS = ["error*qd", "error*ddt(qd)", "error*brake", "error*ddt(f)", "error*sgn(q)*log(q - q)"]


@pytest.mark.parametrize("offset", OFFSETS)
def test_sensor_offset_that_cannot_be_differentiated_is_refused(offset):
    entries = copy.deepcopy(dict(registry.effect("encoder_scale").declaration))
    entries["offset"] = offset
    with pytest.raises(InputError):
        compile_model(Model(BAM, ("encoder_scale:yaw",), (registry.effect_from(entries),)))


def test_an_effect_has_a_target_once():
    with pytest.raises(InputError, match="choose from stribeck:yaw, stribeck:pitch"):
        Model(BAM, ("stribeck",))
    with pytest.raises(InputError, match="already in the model"):
        Model(BAM, ("stribeck:yaw", "stribeck:yaw"))


def test_an_effect_says_when_a_device_lacks_what_it_needs():
    mass = {"mass": ("kg", 2.0, 1.0)}
    rail = made_up_device("mass*ddt(position)**2/2", {"position": "force_x"}, mass, name="rail")
    for name in ("gravity_compensator_lag", "handle_payload", "base_tilt"):
        assert registry.effect(name).targets(rail) == ()
        with pytest.raises(InputError, match="device 'rail' does not have"):
            Model(rail, (name,))
    assert registry.effect("brake_residual_torque").targets(rail) == ()
    assert registry.effect("force_gain").targets(rail) == ("x",)
    assert compile_model(Model(rail, ("force_gain:x",))).inputs == ("force_x",)


def test_force_pairs_of_long_names_leak_the_right_way():
    device = declaration()
    names = {"force_x": "force_left", "force_y": "force_right", "force_z": "force_le"}
    device["inputs"]["force"] = list(names.values())
    for table in (device["applied"], device["side_load"]):
        for axis, text in table.items():
            for old, new in names.items():
                text = text.replace(old, new)
            table[axis] = text
    renamed = registry.device_from(device)
    assert "leftright" in registry.effect("force_crosstalk").targets(renamed)
    system = compile_model(Model(renamed, ("force_crosstalk:rightle",)))
    q, z = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 0))
    u = np.zeros((1, len(system.inputs)))
    u[0, :3] = [1.0, 10.0, 100.0]
    p = system.prior
    p[-1] = 0.05
    np.testing.assert_allclose(system.applied(q, 0 * q, 0 * q, z, u, p), [[1.0, 5.0, 100.0]])
