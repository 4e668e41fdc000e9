"""Machines that nobody tuned to: does the diagnosis name what was hidden in them?

A one-joint arm whose motor current is logged at about 100 Hz with a jittering clock, a damper with
a magnetic coil on a testing machine, and a positioning axis in closed loop whose drive is kicked by
pulses. Their motion is integrated here, by Euler steps of 0.1 ms that share no code with bampipe;
each session hides one effect, or none.

    python benchmarks/other_machines.py [--seed N] [CASE...]

Cases are such as arm:stribeck; all by default.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit
from scipy.io import savemat

DT = 1e-4
ARM = ("none", "stribeck", "asymmetric", "load", "position", "presliding", "ripple", "lag")
DAMPER = ("none", "hysteresis", "coil lag", "saturation", "spring")
AXIS = ("none", "flexible load", "asymmetric", "position", "presliding", "stribeck", "delay")
PIPELINE = """schema = "bampipe.pipeline/1"
name = "other"
stages = ["ingest", "filter", "identify", "validate"]
[settings.identify]
method = "least-squares"
[settings.diagnose]
replicates = 4
"""
ARM_DEVICE = """schema = "bampipe.device/1"
name = "arm"
[coordinates.joint]
kind = "rotary"
[constants]
torque_per_ampere = { value = 1.9, unit = "N.m/A" }
[energy]
kinetic = "inertia*ddt(joint)**2/2"
potential = "-weight*cos(joint)"
[inputs]
force = ["current"]
force_unit = "A"
drive = true
[applied]
joint = "torque_per_ampere*current"
[friction.joint]
viscous = { unit = "N.m.s/rad", prior = 1.0, sd = 1.0, lower = 0.0 }
coulomb = { unit = "N.m", prior = 1.0, sd = 1.0, lower = 0.0 }
[parameters]
inertia = { unit = "kg.m2", prior = 0.3, sd = 0.3, lower = 0.01 }
weight = { unit = "N.m", prior = 6.0, sd = 3.0 }
"""


@njit
def _arm(ref, rate, hidden):
    """Position and current of the arm under a proportional-derivative controller."""
    n = len(ref)
    q, v, z, delivered = 0.0, 0.0, 0.0, 0.0
    out = np.zeros((n, 2))
    for k in range(n):
        current = (60.0 * (ref[k] - q) + 6.0 * (rate[k] - v) + 6.3 * np.sin(q)) / 1.9
        current = min(max(current, -12.0), 12.0)
        out[k, 0], out[k, 1] = q, current
        torque, drag, dry, sign = 1.9 * current, 0.9 * v, 1.6, np.tanh(v / 1e-3)
        if hidden == 1:
            dry += 1.0 * np.exp(-((v / 0.12) ** 2))
        elif hidden == 2:
            drag += 0.35 + 0.25 * abs(v)
        elif hidden == 3:
            dry += 0.12 * abs(torque)
        elif hidden == 4:
            dry += 0.6 * np.sin(12.0 * q + 0.7)
        elif hidden == 5:
            z += DT * (v - abs(v) * z) / 0.03
            sign = z
        elif hidden == 6:
            torque += 0.5 * np.sin(20.0 * q) + 0.2 * np.cos(20.0 * q)
        elif hidden == 7:
            delivered += DT * (torque - delivered) / 0.03
            torque = delivered
        v += DT * (torque - drag - dry * sign - 9.0 * np.sin(q)) / 0.35
        q += DT * v
    return out


@njit
def _damper(x, v, a, current, hidden):
    """Force of the damper along a prescribed stroke."""
    out, z, coil = np.zeros(len(x)), 0.0, current[0]
    for k in range(len(x)):
        i, sign = current[k], np.tanh(v[k] / 2e-3)
        if hidden == 2:
            coil += DT * (i - coil) / 0.06
            i = coil
        dry = 40.0 + (380.0 * np.tanh(i / 0.9) if hidden == 3 else 260.0 * i)
        if hidden == 1:
            z += DT * (v[k] - 0.5 * abs(v[k]) * z - 0.5 * v[k] * abs(z)) / 0.002
            sign = z
        out[k] = (350.0 + 420.0 * i) * v[k] + dry * sign + 1.2 * a[k]
        if hidden == 4:
            out[k] += 3000.0 * x[k]
    return out


@njit
def _axis(goal, pulse, hidden):
    """Position and drive of a carriage under cascaded position and velocity loops, each 1 ms."""
    n = len(goal)
    q, v, z, load, w, volts, seen, late = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(50)
    out = np.zeros((n, 2))
    for k in range(n):
        if k % 10 == 0:
            speed = (q - seen) / 1e-3
            seen = q
            volts = min(max(240.0 * (160.0 * (goal[k] - q) - speed) / 35.0, -10.0), 10.0)
        out[k, 0], out[k, 1] = q, volts
        late[k % 50] = 35.0 * volts + pulse[k]
        force, mass = late[k % 50], 95.0
        drag, dry, sign = 200.0, 20.0, np.tanh(v / 2e-4)
        if hidden == 1:
            mass = 70.0
            stretch = load - q
            pull = 25.0 * 75.0**2 * stretch + 25.0 * 2 * 0.04 * 75.0 * (w - v)
            w += DT * -pull / 25.0
            load += DT * w
            force += pull
        elif hidden == 2:
            drag += 35.0 * np.sign(v)
        elif hidden == 3:
            dry += 4.0 * np.sin(120.0 * q + 1.0)
        elif hidden == 4:
            z += DT * (v - abs(v) * z) / 3e-4
            sign = z
        elif hidden == 5:
            dry += 10.0 * np.exp(-((v / 0.01) ** 2))
        elif hidden == 6:
            force = late[(k + 1) % 50]
        v += DT * (force - drag * v - dry * sign - 3.0) / mass
        q += DT * v
    return out


def _write(path: Path, names: str, columns: np.ndarray) -> None:
    np.savetxt(path, columns, delimiter=",", header=names, comments="", fmt="%.7g")


def _head(device: str, rate_hz: float) -> str:
    """What every session file begins with, up to its encoders."""
    return (
        f'schema = "bampipe.session/1"\nsession_id = "machine"\ndevice = "{device}"\n'
        f'sample_rate_hz = {rate_hz}\n[time]\ncolumn = "t"\nunit = "s"\n[encoders]\n'
    )


def _stretches(file: str, seconds: float) -> str:
    """Four trials of one record, ``seconds`` each, the last one to its end."""
    text = ""
    for k in range(4):
        text += f'[[trials]]\nfile = "{file}"\nkind = "free"\nstart_s = {k * seconds}\n'
        text += f"end_s = {(k + 1) * seconds}\n" if k < 3 else ""
    return text


def arm(folder: Path, hidden: int, seed: int) -> None:
    """Two records of 40 s, each cut into stretches of 10 s."""
    rng = np.random.default_rng(seed)
    text = _head("arm.toml", 100.0) + (
        'joint = { column = "q", unit = "rad", resolution = 3.834951969714103e-4 }\n'
        '[channels]\ncurrent = { column = "i", unit = "A" }\n'
    )
    t = np.arange(0.0, 40.0, DT)
    for record in range(2):
        ref = np.zeros_like(t)
        for w in 2 * np.pi * rng.uniform(0.08, 0.9, 5):
            size = rng.uniform(0.2, 0.9) / (0.3 + w / 3)
            ref += size * np.sin(w * t + rng.uniform(0.0, 6.0))
        ref *= np.minimum(1.0, t / 2.0)
        motion = _arm(ref, np.gradient(ref, DT), hidden)
        stamps = np.arange(0.0, 39.98, 0.01)
        at = np.round((stamps + rng.uniform(-1e-3, 1e-3, len(stamps))) / DT).astype(int)
        at[0] = 0
        step = 2 * np.pi / 16384
        q = np.floor(motion[at, 0] / step) * step
        noisy = motion[at, 1] + 0.02 * rng.standard_normal(len(at))
        _write(folder / f"r{record}.csv", "t,q,i", np.column_stack([at * DT, q, noisy]))
        text += _stretches(f"r{record}.csv", 10.0)
    (folder / "session.toml").write_text(text)
    (folder / "arm.toml").write_text(ARM_DEVICE)


def damper(folder: Path, hidden: int, seed: int) -> None:
    """Five tests of 12 s, sines and chirps of several amplitudes, the current in steps."""
    rng = np.random.default_rng(seed)
    text = _head("magnetic_damper", 500.0) + (
        'piston = { column = "x", unit = "mm", resolution = 0.005 }\n'
        '[force]\ncolumns = ["f"]\ncomponents = ["load_cell"]\nunit = "N"\n'
        '[channels]\ncurrent = { column = "i", unit = "A" }\n'
    )
    t = np.arange(0.0, 12.0, DT)
    chirp = 0.3 * t + (2.5 - 0.3) / 24.0 * t**2
    turns = (1.0 * t, chirp, 1.6 * t, chirp, 0.6 * t)
    for test, (size, turn) in enumerate(zip((0.005, 0.01, 0.015, 0.02, 0.012), turns, strict=True)):
        x = size * np.sin(2 * np.pi * turn) * np.minimum(1.0, t)
        v = np.gradient(x, DT)
        levels = rng.permutation([0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
        current = levels[np.minimum((t / 2.0).astype(int), 5)]
        force = _damper(x, v, np.gradient(v, DT), current, hidden)[::20]
        seen = np.floor(x[::20] / 5e-6) * 5e-3
        noise = rng.standard_normal((len(seen), 2)) * [1.0, 0.002]
        columns = [t[::20], seen, force + noise[:, 0], current[::20] + noise[:, 1]]
        _write(folder / f"t{test}.csv", "t,x,f,i", np.column_stack(columns))
        text += f'[[trials]]\nfile = "t{test}.csv"\nkind = "free"\n'
    (folder / "session.toml").write_text(text)


def axis(folder: Path, hidden: int, seed: int) -> None:
    """One record of 25 s in a MATLAB file, cut into four stretches; moves, rests and pulses."""
    rng = np.random.default_rng(seed)
    text = _head("slider", 1000.0) + (
        'carriage = { column = "qm", unit = "m", resolution = 5e-8 }\n'
        '[force]\ncolumns = ["vir", "pulses"]\ncomponents = ["motor"]\nunit = "V"\n'
        "calibration_n_per_v = [[35.0, 1.0]]\nzero_v = [0.0, 0.0]\n"
    )
    t = np.arange(0.0, 25.0, DT)
    goal, at, k = np.zeros_like(t), 0.0, 2000
    while k < len(t) - 12000:
        to, speed = rng.uniform(-0.12, 0.12), rng.uniform(0.05, 0.2)
        length = int(max(1.9 * abs(to - at) / speed, 0.15) / DT)
        s = np.linspace(0.0, 1.0, length)
        ends = min(k + length, len(t))
        goal[k:ends] = (at + (to - at) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2))[: ends - k]
        goal[ends:] = to
        at, k = to, ends + int(rng.uniform(0.05, 0.4) / DT)
    pulse = np.repeat(rng.choice([-60.0, 0.0, 0.0, 60.0], len(t) // 1500 + 1), 1500)[: len(t)]
    motion = _axis(goal, pulse, hidden)[::10]
    seen = np.floor(motion[:, 0] / 5e-8) * 5e-8
    volts = motion[:, 1] + 0.02 * rng.standard_normal(len(seen))  # of the amplifier's monitor
    columns = {"t": t[::10], "qm": seen, "vir": volts, "pulses": pulse[::10]}
    savemat(folder / "record.mat", {name: column[:, None] for name, column in columns.items()})
    (folder / "session.toml").write_text(text + _stretches("record.mat", 6.0))


def diagnosed(make: Callable[[Path, int, int], None], hidden: int, seed: int) -> str:
    """One row of the table: verdict, effects, error before and after, floor."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        (root / "machine").mkdir()
        make(root / "machine", hidden, seed)
        (root / "other.toml").write_text(PIPELINE)
        bampipe = [sys.executable, "-m", "bampipe"]
        run = ["run", "machine", "--pipeline", "other.toml", "--runs", "runs", "-q"]
        for command in (run, ["diagnose", "runs/machine", "-q"]):
            done = subprocess.run([*bampipe, *command], cwd=root, capture_output=True, text=True)
            if command[0] == "diagnose" and done.returncode:
                return done.stderr.strip()
        content = json.loads((root / "runs/machine/models/base/diagnose.json").read_text())
    axis = next(iter(content["axes"].values()))
    errors = f"{axis['rmse_before']:.3g} | {axis['rmse_after']:.3g} | {axis['noise_floor']:.3g}"
    return f"{axis['verdict']} | {', '.join(content['selected'])} | {errors} {axis['unit']}"


def main() -> None:
    """Print one row a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    cases = {f"arm:{n}": (arm, k) for k, n in enumerate(ARM)}
    cases |= {f"damper:{n}": (damper, k) for k, n in enumerate(DAMPER)}
    cases |= {f"axis:{n}": (axis, k) for k, n in enumerate(AXIS)}
    print("| hidden | verdict | named | error before | after | floor |\n|---|---|---|---|---|---|")
    for name in options.cases or cases:
        print(f"| {name} | {diagnosed(*cases[name], options.seed)} |", flush=True)


if __name__ == "__main__":
    main()
