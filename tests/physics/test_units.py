"""Dimensional analysis: what is built in is consistent, what is not is said plainly."""

import copy
from fractions import Fraction

import pytest
from motions import declaration
from small_arm import ARM

from bampipe.errors import InputError
from bampipe.physics import expression, registry
from bampipe.physics.effect import state_units
from bampipe.physics.model import Model
from bampipe.physics.units import PURE, check_device, check_effect, dimension, parse_unit

BAM = registry.device("bam")


def exponents(text):
    return tuple(int(e) for e in parse_unit(text, "here").exponents)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", (0, 0, 0, 0, 0)),
        ("1/rad", (0, 0, 0, 0, 0)),
        ("N.m.s/rad", (1, 2, -1, 0, 0)),
        ("N.m.s2/rad2", (1, 2, 0, 0, 0)),
        ("rad/N/m", (-1, -2, 2, 0, 0)),
        ("m.s-1", (0, 1, -1, 0, 0)),
        ("N.m/A", (1, 2, -2, -1, 0)),
        ("Ohm", (1, 2, -3, -2, 0)),
    ],
)
def test_units_have_the_exponents_of_their_definitions(text, expected):
    assert exponents(text) == expected


def test_equal_quantities_in_other_words_are_equal():
    mechanical = [("J", "N.m"), ("W", "N.m/s"), ("Pa.m2", "N")]
    electrical = [("V.A", "W"), ("Ohm.A", "V"), ("H.A2", "J"), ("C.V", "J"), ("F.V", "C")]
    for a, b in [*mechanical, *electrical, ("Wb", "V.s"), ("T.m2", "Wb")]:
        assert parse_unit(a, "") == parse_unit(b, "")


@pytest.mark.parametrize(
    "text", ["Nm", "mm", "deg", "N*m", "m^2", "N..m", "/s", "m2.", "m s", "µm"]
)
def test_a_unit_that_is_not_coherent_si_is_refused(text):
    with pytest.raises(InputError, match="not an SI unit"):
        parse_unit(text, "constants.L")


def test_dimensions_print_as_units_and_stay_exact():
    for text, said in {"J": "N.m", "N.s/m": "kg/s", "m2/s3": "m2/s3", "1/s": "1/s"}.items():
        assert str(parse_unit(text, "")) == said
    metre = parse_unit("m", "")
    assert (metre ** Fraction(1, 2)) ** 2 == metre
    assert metre / metre == PURE and str(PURE) == "a pure number"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a*b/c", "m.kg/s"),
        ("sqrt(a**4)", "m2"),
        ("a**0.5*a**1.5", "m2"),
        ("sgn(a)*b", "kg"),
        ("clip(a, -a, 3*a)", "m"),
        ("b*exp(-a/a)", "kg"),
        ("abs(a)*heaviside(c)", "m"),
        ("a/2 + 0.25*a", "m"),
    ],
)
def test_expressions_have_the_dimension_of_their_parts(text, expected):
    symbols = {"a": parse_unit("m", ""), "b": parse_unit("kg", ""), "c": parse_unit("s", "")}
    assert dimension(expression.parse(text, ""), symbols) == parse_unit(expected, "")


def test_a_number_that_may_carry_a_unit_is_let_pass():
    symbols = {"a": parse_unit("m", ""), "c": parse_unit("s", "")}
    assert dimension(expression.parse("a/0.02", ""), symbols) is None
    assert dimension(expression.parse("c + 0.002", ""), symbols) == parse_unit("s", "")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a + c", "'a + c' puts together 'a' (m) and 'c' (s)"),
        ("max(a, c)", "puts together"),
        ("sin(a)", "sin() takes a pure number, and 'a' is in m"),
        ("a + 1", "'1' (a pure number)"),
        ("a*d", "unknown symbol 'd'"),
    ],
)
def test_unlike_quantities_are_named(text, says):
    symbols = {"a": parse_unit("m", ""), "c": parse_unit("s", "")}
    with pytest.raises(InputError) as caught:
        dimension(expression.parse(text, ""), symbols)
    assert says in str(caught.value)


@pytest.mark.parametrize("name", registry.effect_names())
def test_built_in_effects_have_a_place_and_are_consistent_at_each(name):
    effect = registry.effect(name)
    devices = [registry.device_from(ARM), *map(registry.device, registry.device_names())]
    places = [(device, target) for device in devices for target in effect.targets(device)]
    assert places
    for device, target in places:
        assert check_effect(effect, device, target) == []


def wrong_device(change):
    entries = declaration()
    change(entries)
    return check_device(registry.device_from(entries))


def test_wrong_units_and_expressions_of_a_device_are_found_where_they_matter():
    found = wrong_device(lambda d: d["constants"]["I_g"].update(unit="kg.m"))
    assert len(found) == 1 and found[0].startswith("energy.kinetic: ") and "(kg.m)" in found[0]
    found = wrong_device(lambda d: d["applied"].update(pitch="force_y"))
    assert found == ["applied.pitch: is N where N.m is needed"]
    found = wrong_device(lambda d: d["energy"].update(potential="mass*g*sin(pitch)"))
    assert found == ["energy.potential: is N where N.m is needed"]
    found = wrong_device(lambda d: d["definitions"].update(rho="extension - pitch"))
    assert found == [
        "definitions.rho: 'extension - pitch' puts together 'extension' (m) "
        "and 'pitch' (a pure number)"
    ]
    found = wrong_device(lambda d: d["friction"]["yaw"]["viscous"].update(unit="N.m.s2/rad"))
    assert found == ["friction.yaw.viscous: unit 'N.m.s2/rad' where kg.m2/s is needed"]
    found = wrong_device(lambda d: d["process_noise"]["gravity_compensator"].update(unit="N"))
    assert found == [
        "process_noise.gravity_compensator.torque.pitch: is a pure number where m is needed"
    ]
    found = wrong_device(lambda d: d["inputs"].update(force_unit="N.m"))
    fields = [f"applied.{axis}" for axis in ("yaw", "pitch", "extension")]
    assert [f.partition(":")[0] for f in found] == fields
    found = wrong_device(lambda d: d["constants"]["L"].update(unit="inch"))
    assert len(found) == 1 and "constants.L" in found[0] and "'inch'" in found[0]
    found = wrong_device(lambda d: d["torque"].update(pitch="compensatoin"))
    assert found == ["torque.pitch: unknown symbol 'compensatoin', did you mean 'compensation'?"]


def wrong_effect(name, target, **changes):
    entries = copy.deepcopy(dict(registry.effect(name).declaration))
    for key, value in changes.items():
        entries[key] = value
    return check_effect(registry.effect_from(entries), BAM, target)


def test_a_wrong_effect_is_found_at_the_axis_where_it_is_wrong():
    assert wrong_effect("stribeck", "yaw", torque="-force*exp(-(qd/speed)**2)*qd") == [
        "torque: is W where N.m is needed"
    ]
    found = wrong_effect("stribeck", "extension", torque="-force*exp(-qd**2/speed)*sgn(qd)")
    assert found == ["torque: exp() takes a pure number, and '-qd ** 2 / speed' is in m/s"]
    assert wrong_effect("force_bias", "x", input="f - bias*t") == [
        "input: 'f - bias * t' puts together 'f' (N) and 'bias * t' (kg.m/s)"
    ]
    assert wrong_effect("transmission_compliance", "yaw", offset="compliance*q")[0].startswith(
        "offset: is "
    )
    states = {"deflection": {"unit": "", "rate": "qd - deflection/distance"}}
    assert "puts together" in wrong_effect("presliding", "extension", states=states)[0]
    torque = "-force*sin(q)"
    assert wrong_effect("stribeck", "yaw", torque=torque) == []
    assert wrong_effect("stribeck", "extension", torque=torque) == [
        "torque: sin() takes a pure number, and 'q' is in m"
    ]


def test_states_have_the_unit_of_their_axis():
    names = ["flexible_load:carriage", "stribeck:carriage"]
    flexible, stribeck = Model(registry.device("slider"), names).effects
    assert state_units(flexible, registry.device("slider")) == {"stretch": "m", "rate": "m/s"}
    assert state_units(stribeck, registry.device("slider")) == {}
