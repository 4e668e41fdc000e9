"""A machine with an axis that nothing drives: a pole that hangs on a motorised cart."""

from pathlib import Path

import numpy as np
import pytest
from conftest import Command

from bampipe.files import read_json
from bampipe.physics import Model, compile_model, registry

DEVICE = """
schema = "bampipe.device/1"
name = "cartpole"
[coordinates.cart]
kind = "linear"
[coordinates.pole]
kind = "rotary"
[energy]
kinetic = "M*ddt(cart)**2/2 + ml*cos(pole)*ddt(cart)*ddt(pole) + J*ddt(pole)**2/2"
potential = "-ml*9.81*cos(pole)"
[inputs]
force = ["push"]
force_unit = "N"
drive = true
[applied]
cart = "push"
pole = "0"
[friction.cart]
viscous = { unit = "N.s/m", prior = 5.0, sd = 5.0, lower = 0.0 }
coulomb = { unit = "N", prior = 2.0, sd = 2.0, lower = 0.0 }
[friction.pole]
viscous = { unit = "N.m.s/rad", prior = 0.01, sd = 0.01, lower = 0.0 }
coulomb = { unit = "N.m", prior = 0.005, sd = 0.01, lower = 0.0 }
[parameters]
M = { unit = "kg", prior = 1.0, sd = 1.0, lower = 0.05 }
ml = { unit = "kg.m", prior = 0.1, sd = 0.1, lower = 0.001 }
J = { unit = "kg.m2", prior = 0.05, sd = 0.05, lower = 0.001 }
"""
SESSION = """
schema = "bampipe.session/1"
session_id = "cart"
device = "cartpole.toml"
sample_rate_hz = 200.0
[time]
column = "t"
unit = "s"
[encoders]
cart = { column = "x", unit = "m", resolution = 2e-5 }
pole = { column = "angle", unit = "rad", resolution = 1.5e-3 }
[channels]
push = { column = "push", unit = "N" }
"""
TRUTH = {"M": 1.3, "ml": 0.12, "J": 0.06, "viscous.cart": 6.0, "coulomb.cart": 2.5}


def log(seed: int) -> np.ndarray:
    """Time, position, angle and force, 8 s at 200 Hz, integrated by Euler steps of 0.25 ms."""
    rng = np.random.default_rng(seed)
    dt, rows = 2.5e-4, []
    t = np.arange(0.0, 8.0, dt)
    tones = 2 * np.pi * rng.uniform(0.1, 1.2, 4)
    goal = (0.15 * np.sin(tones * t[:, None] + rng.uniform(0, 6, 4)) / (0.6 + tones / 4)).sum(1)
    x, angle, v, w = float(goal[0]), 0.3, 0.0, 0.0
    m, ml, j = TRUTH["M"], TRUTH["ml"], TRUTH["J"]
    for k in range(len(t)):
        push = 144.0 * (goal[k] - x) - 12.0 * v
        if k % 20 == 0:
            rows.append((t[k], x, angle, push))
        force = push - 6.0 * v - 2.5 * np.tanh(v / 1e-3)
        torque = -0.006 * w - 0.004 * np.tanh(w / 1e-3)
        c, s = ml * np.cos(angle), ml * np.sin(angle)
        first, second, share = force + s * w * w, torque - 9.81 * s, m * j - c * c
        v += dt * (j * first - c * second) / share
        w += dt * (m * second - c * first) / share
        x, angle = x + dt * v, angle + dt * w
    table = np.array(rows)
    table[:, 1] = 2e-5 * np.floor(table[:, 1] / 2e-5)
    table[:, 2] = 1.5e-3 * np.floor(table[:, 2] / 1.5e-3)
    table[:, 3] += 0.1 * rng.standard_normal(len(table))
    return table


def test_is_identified_by_the_filter_and_not_diagnosed(tmp_path: Path, command: Command) -> None:
    folder = tmp_path / "cart"
    folder.mkdir()
    text = SESSION
    for seed in range(2):
        header = "t,x,angle,push"
        np.savetxt(folder / f"r{seed}.csv", log(seed), delimiter=",", header=header, comments="")
        text += f'[[trials]]\nfile = "r{seed}.csv"\nkind = "free"\n'
    (folder / "session.toml").write_text(text)
    (folder / "cartpole.toml").write_text(DEVICE)
    runs = ("--runs", tmp_path / "runs", "-q")
    code, out, err = command("run", folder, "--until", "validate", *runs)
    assert code == 0, err
    assert "pole failed" not in " ".join(out.split())

    model = tmp_path / "runs/cart/models/base"
    found = read_json(model / "identify.json")["parameters"]
    for name, value in TRUTH.items():
        entry = found[name]
        assert abs(entry["estimate"] - value) < 4.0 * entry["sd"] + 0.02 * value, (name, entry)
    assert read_json(model / "validate.json")["axes"]["pole"]["fit_percent"] is None
    code, _, err = command("diagnose", tmp_path / "runs/cart", "-q")
    assert code == 2 and "no force acts on pole" in err


@pytest.mark.parametrize("device", registry.device_names())
def test_built_in_devices_are_driven_on_every_axis(device: str) -> None:
    assert compile_model(Model(registry.device(device))).undriven == ()
