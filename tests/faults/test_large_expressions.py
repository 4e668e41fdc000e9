"""Declarations that are short to write and long to derive: refused in bounded time, by name."""

import threading
import time
from collections.abc import Mapping
from contextlib import suppress

import pytest

from bampipe.declarations.files import device_faults
from bampipe.errors import InputError
from bampipe.physics import Model, derivation, registry
from bampipe.physics.derivation import derive
from bampipe.physics.time_limit import OutOfTime, time_limit


def device(definitions: Mapping[str, str], kinetic: str, potential: str = "0") -> dict[str, object]:
    """A joint with these energies, in units of ``inertia`` and ``stored``."""
    return {
        "name": "joint",
        "coordinates": {"joint": {"kind": "rotary"}, "wrist": {"kind": "rotary"}},
        "constants": {
            "inertia": {"value": 1.0, "unit": "kg.m2"},
            "stored": {"value": 1.0, "unit": "J"},
        },
        "definitions": definitions,
        "energy": {"kinetic": f"inertia*({kinetic})", "potential": potential},
        "inputs": {"force": ["torque"], "force_unit": "N.m"},
        "applied": {"joint": "torque"},
    }


def nested(depth: int) -> dict[str, str]:
    """``d1`` to ``d<depth>``, each of which contains the one before twice."""
    chain = {f"d{k}": f"sin(d{k - 1}) + cos(d{k - 1})" for k in range(1, depth + 1)}
    return {"d0": "joint", **chain}


LONG = {
    "nested": (
        device(nested(10), "(2 + d10)*qd_joint**2 + qd_wrist**2"),
        "energy.kinetic: deriving the equations of motion takes too long", "'d10'",
    ),
    "power": (
        device({"reach": "cos(joint) + sin(wrist) + cos(joint - wrist) + sin(2*joint) + joint"},
               "(2 + reach**12)*qd_joint**2 + qd_wrist**2"),
        "energy.kinetic: deriving the equations of motion takes too long", "'reach'",
    ),
    "size": (
        device(nested(20), "qd_joint**2 + qd_wrist**2"),
        "definitions.d11: more than 20000 operations", "'d10'",
    ),
    "rates": (
        device({**nested(8), "jerk": "ddt(ddt(d8))"}, "qd_joint**2 + qd_wrist**2"),
        "definitions.jerk: more than 20000 operations", "'d8'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LONG)
def test_a_device_that_takes_too_long_is_refused(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    declaration, words, definition = LONG[name]
    if "takes too long" in words:  # where size is what is refused, a slow machine must not be first
        monkeypatch.setattr(derivation, "LONGEST_S", 0.3)
    start = time.process_time()
    equations, (fault,) = device_faults(declaration, "joint.toml")
    assert time.process_time() - start < 10.0
    assert equations == "" and fault.startswith("joint.toml: ")
    assert words in fault and f"above all definition {definition}" in fault, fault


def test_an_effect_that_takes_too_long_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derivation, "LONGEST_S", 1.0)
    reach = "cos(q) + sin(2*q) + cos(3*q) + sin(5*q) + q"
    effect = registry.effect_from({
        "name": "swing", "summary": "s", "scope": "axis", "kind": "energy", "source": "s",
        "looks_like": "s", "kinetic": f"swung*({reach})**12*qd**2",
        "parameters": {"swung": {"unit": "kg.m2", "prior": 0.0, "sd": 1.0}},
    })  # fmt: skip
    with pytest.raises(InputError, match=r"effect 'swing:joint': kinetic.*takes too long"):
        derive(Model(registry.device("servo_pendulum"), ["swing:joint"], [effect]))


def test_units_are_judged_before_anything_is_derived(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derivation, "LONGEST_S", 0.0)
    declaration = device(nested(10), "(2 + d10)*qd_joint**2 + qd_wrist", potential="stored*d10")
    equations, (fault,) = device_faults(declaration, "joint.toml")
    assert equations == "" and "energy.kinetic" in fault and "puts together" in fault


def test_a_deep_potential_energy_is_derived() -> None:
    declaration = device(nested(8), "qd_joint**2 + qd_wrist**2", potential="stored*d8")
    assert device_faults(declaration, "joint.toml")[1] == []


def spin(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_the_time_limit_counts_one_thread_and_outlives_a_finalizer() -> None:
    other = threading.Thread(target=spin, args=(0.6,))
    other.start()
    with time_limit(0.3):
        time.sleep(0.8)
    other.join()
    with pytest.raises(OutOfTime), time_limit(0.2):
        with suppress(OutOfTime):
            while True:
                pass
        while True:
            pass


def test_the_time_limit_holds_in_any_thread() -> None:
    outcomes = []

    def work() -> None:
        try:
            with time_limit(0.2):
                spin(5.0)
        except OutOfTime:
            outcomes.append(time.thread_time())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(outcomes) == 1 and outcomes[0] < 2.0
    with time_limit(0.2):
        pass
    spin(0.5)  # nothing arrives late
