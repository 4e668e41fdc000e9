"""The equations of motion as text."""

import numpy as np
import pytest
import sympy as sp
from motions import made_up_device

from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.readable import describe_equations, model_equations

BAM = registry.device("bam")


def value(text, q, qd, qdd=None):
    """Number that a printed expression stands for."""
    numbers = {c: v.value for c, v in BAM.constants.items()} | {"mass": 3.56}
    for mark, i in (("θ", 0), ("φ", 1), ("r", 2)):
        numbers |= {mark: q[i], f"{mark}p": qd[i]}
    python = text.replace("'", "p").replace(" ", "*").replace("*+*", "+").replace("*-*", "-")
    python = python.replace("^", "**")
    names = {n: sp.Symbol(n) for n in numbers}
    return float(sp.sympify(python, locals=names).subs({names[n]: v for n, v in numbers.items()}))


def test_what_is_printed_is_what_is_computed():
    text = describe_equations(BAM).splitlines()
    lines = dict(line.strip().split(" = ", 1) for line in text if " = " in line)
    system = compile_model(Model(BAM))
    q, qd = np.array([0.2, 0.4, 1.1]), np.array([0.5, -0.3, 0.2])
    matrix = system.mass_matrix(q[None], system.prior)[0]
    assert value(lines["M[θ,θ]"], q, qd) == pytest.approx(matrix[0, 0])
    assert value(lines["M[θ,φ]"], q, qd) == pytest.approx(matrix[0, 1])
    assert value(lines["M[φ,φ]"], q, qd) == pytest.approx(matrix[1, 1])
    assert "M[θ,r]" not in lines
    p = np.where([x.name == "mass" for x in system.parameters], 3.56, 0.0)
    z, u = np.zeros((1, 0)), np.zeros((1, len(system.inputs)))
    needed = system.required(q[None], qd[None], 0 * q[None], z, u, p)[0]
    needed[1] += 3.56 * 9.81 * (1.1 - 0.461) * np.cos(0.4)
    for i, mark in enumerate("θφr"):
        assert value(lines[f"h[{mark}]"], q, qd) == pytest.approx(needed[i])
    assert lines["Q[θ]"] == (
        "-brake_yaw sgn(θ') - coulomb.yaw sgn(θ') + force_x r cos(φ) - viscous.yaw θ'"
    )
    assert lines["L"] == "0.461 m  (Table II)"
    assert lines["mass"] == "3.56 ± 0.5 kg  (prior, to be estimated)"


def test_names_of_constants_may_be_those_of_internal_symbols():
    kinetic, constants = "0.001388888889*p0*mass*ddt(s)**2", {"p0": ("1", 2.0), "q0": ("N", 3.0)}
    rail = made_up_device(
        kinetic,
        {"s": "force_x"},
        {"mass": ("kg", 2.0, 1.0)},
        constants={name: {"unit": u, "value": v} for name, (u, v) in constants.items()},
        energy={"kinetic": kinetic, "potential": "q0*s"},
    )
    text = describe_equations(rail)
    assert "M[s,s] = 0.002778 mass p0" in text
    assert "h[s] = q0" in text


def test_a_wrong_device_is_an_input_error():
    rail = made_up_device("maas*ddt(s)**2/2", {"s": "force_x"}, {"mass": ("kg", 2.0, 1.0)})
    with pytest.raises(InputError, match="did you mean 'mass'"):
        describe_equations(rail)


def test_a_negative_number_put_in_has_one_sign():
    numbers = {"viscous.carriage": -2.5, "offset": -0.25, "coulomb.carriage": 3.0, "mass": 50.0}
    lines = model_equations(Model(registry.device("slider")), numbers)
    applied = next(line for line in lines if line.startswith("Q["))
    assert "(-" not in applied and "0.25" in applied and "2.5 s'" in applied
