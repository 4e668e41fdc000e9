"""The three official tasks of EMPS, by physics fitted to DATA_EMPS and judged on DATA_EMPS_PULSES.

    python benchmarks/emps.py [--data FOLDER]

FOLDER/emps has both records (Janot, Gautier and Brunot 2019, hal-02178709). The session is that of
`sample_runs/positioning_axis` with whole records, and that with pulses is a trial held out: neither
a parameter nor the choice of an effect has seen it. Models are those of `bampipe extend --auto`.

1. Open loop: position from the motor's force and the first 20 samples, RMSE over the rest, mm.
   Each model is run with the parameters of its identification, by inverse dynamics, and with those
   that minimise its own free run over DATA_EMPS (`refit`).
2. Inverse dynamics: error of the force with the authors' filters (`published.toml`), per cent.
3. Closed loop: errors of position and force, per cent.

What holds the open loop back is named by one more number, which is no result: the error where the
dry friction alone is chosen on the test record.

Then a claim that can fail. DATA_EMPS_PULSES alone is diagnosed, priors from DATA_EMPS: is the
flexibility named that the authors suspect? Beside it stands what the pulses show without
any model: apparent mass and delay between force and acceleration, by frequency.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measured import (
    ROOT,
    Array,
    bampipe,
    load,
    need,
    parse,
    read,
    read_ladder,
    read_trial,
    rms,
    run_free,
    store,
)
from scipy.io import loadmat, savemat
from scipy.optimize import least_squares

from bampipe import open_run
from bampipe.errors import InputError
from bampipe.physics import System
from bampipe.trials.motion import Motion

SAMPLE = ROOT / "sample_runs" / "positioning_axis"
FILES = {"train": "DATA_EMPS.mat", "test": "DATA_EMPS_PULSES.mat"}
TRIALS = {"train": "DATA_EMPS", "test": "DATA_EMPS_PULSES"}
GIVEN = 20
"""Samples of the test record that a model may see."""
PUBLISHED = {
    "dynoNet": 2.64, "polynomial NARX": 5.17, "linear state space": 5.53,
    "authors' physics": 8.60, "ARX": 12.6, "LSTM": 74.0, "GRU": 220.0,
}  # fmt: skip
"""mm; README of nonlinear_benchmarks at 0f8f7ac, and the authors' parameters run here."""
VOLT_N = 35.1507


def write_session(source: Path, folder: Path, records: Sequence[str] = tuple(FILES)) -> Path:
    """The records as they were stored; the second of two is held out.

    The steps of `pulses_N` are volts that the controller's output receives; DATA_EMPS has none.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = (SAMPLE / "session.toml").read_text(encoding="utf-8")
    text = text[: text.index("# One record")]
    text = text.replace('session_id = "positioning_axis"', f'session_id = "{folder.name}"')
    text = text.replace('device = "slider"', 'device = "device.toml"')
    text += f'pulse = {{ column = "pulses_N", unit = "N", scale = {VOLT_N} }}\n'
    for name in records:
        content = {k: v for k, v in loadmat(source / FILES[name]).items() if k[0] != "_"}
        if not (folder / FILES[name]).exists():  # the format holds the date: results stay current
            savemat(folder / FILES[name], {"pulses_N": np.zeros_like(content["qm"]), **content})
        text += f'[[trials]]\nfile = "{FILES[name]}"\nkind = "free"\n'
        text += "hold_out = true\n" if name != records[0] else ""
    (folder / "session.toml").write_text(text, encoding="utf-8")
    device = (ROOT / "bampipe/physics/devices/slider.toml").read_text(encoding="utf-8")
    for old, now in (
        ('velocity_gain = "N.s/m" }', 'velocity_gain = "N.s/m", pulse = "N" }'),
        ("- qd_carriage)", "- qd_carriage) + pulse"),
    ):
        assert device.count(old) == 1, old
        device = device.replace(old, now)
    (folder / "device.toml").write_text(device, encoding="utf-8")
    return folder


def put_priors(device: Path, run: Path) -> None:
    """Make the estimates of a run the priors of a device file."""
    text, found = device.read_text(encoding="utf-8"), read(run, "base", "identify")["parameters"]
    for name in ("mass", "offset", "viscous", "coulomb"):
        entry = found.get(name) or found[f"{name}.carriage"]
        text, count = re.subn(
            rf"({name}\b[^\[]*?prior = )[-\d.]+(,? ?\n?sd = )[\d.]+",
            rf"\g<1>{entry['estimate']!r}\g<2>{entry['sd']!r}", text, count=1,
        )  # fmt: skip
        assert count == 1, name
    device.write_text(text, encoding="utf-8")


def start_of(t: Array, q: Array) -> tuple[Array, Array]:
    """Position and velocity at the last of the samples that are given, by a parabola."""
    p = np.polyfit(t[:GIVEN] - t[GIVEN - 1], q[:GIVEN], 2)
    return p[2:], p[1:2]


def run_open(system: System, p: Array, motion: Motion, position: Array) -> Array:
    """Error of the free run after the samples given, m."""
    first, last = GIVEN - 1, len(motion.t) - 1
    q = run_free(system, p, motion, first, last, *start_of(motion.t, position))
    return np.asarray(q[1:, 0] - position[GIVEN:])


def refit(
    system: System, p: Array, motion: Motion, position: Array, free: list[int], sd: Array
) -> Array:
    """The parameters that minimise the free run over a record, held by ``sd`` about ``p``."""
    limits = [(item.lower, item.upper) for item in system.parameters]
    lower, upper = np.array(limits).T

    def changed(z: Array) -> Array:
        moved = p.copy()
        moved[free] += sd * z
        return np.clip(moved, lower, upper)

    def error(z: Array) -> Array:
        try:
            left = 1e3 * run_open(system, changed(z), motion, position)[::20]
        except InputError:  # runs away: worse than any
            left = np.full(len(position[GIVEN::20]), 1e3)
        return np.concatenate([left / np.sqrt(len(left)), 0.03 * z])

    found = least_squares(error, np.zeros(len(free)), diff_step=1e-3, max_nfev=25)
    return changed(found.x)


def score(run: Path, model: str, records: dict[str, Array]) -> dict[str, Any]:
    """Tasks 1 and 2 for one model, as identified and with its free run over DATA_EMPS fitted."""
    system, p = load(run, model)
    found = read(run, model, "identify")["parameters"]
    motions = {name: read_trial(run, trial, system) for name, trial in TRIALS.items()}
    free = [i for i, item in enumerate(system.parameters) if not item.fixed]
    sd = np.array([0.05 * abs(p[i]) + found[system.parameters[i].name]["sd"] for i in free])
    fitted = refit(system, p, motions["train"], records["train"], free, sd)
    dry = [system.index("coulomb.carriage")]
    oracle = refit(system, p, motions["test"], records["test"], dry, np.ones(1))
    inverse = read(run, model, "validate")["axes"]["carriage"]

    def errors(parameters: Array) -> dict[str, float | None]:
        return {n: measure_open(system, parameters, m, records[n]) for n, m in motions.items()}

    return {
        "open_loop_mm": errors(p),
        "open_loop_fitted_mm": errors(fitted),
        "open_loop_friction_of_the_test_mm": errors(oracle)["test"],
        "friction_of_the_test_n": float(oracle[dry[0]] - p[dry[0]]),
        "inverse_percent": inverse["held_out_relative_error_percent"],
        "parameters": {name: [e["estimate"], e["sd"]] for name, e in found.items()},
    }


def measure_open(system: System, p: Array, motion: Motion, position: Array) -> float | None:
    """RMSE of the free run, mm; None where it runs away."""
    try:
        return 1e3 * rms(run_open(system, p, motion, position))
    except InputError:
        return None


def closed_loop(run: Path, model: str) -> dict[str, Any]:
    """Errors of position and force on the test record, and held out, per cent."""
    found = read(run, model, "validate")
    free, axis = found["free_run"], found["axes"]["carriage"]
    if free.get("mode") != "closed_loop":
        return {"reason": free.get("reason")}
    return {
        "position_percent": free["trials"][TRIALS["test"]]["carriage"]["relative_error_percent"],
        "force_percent": free["forces"]["force_motor"]["relative_error_percent"],
        "held_out_percent": axis["held_out_relative_error_percent"],
    }


def look_at_pulses(
    record: dict[str, Array], viscous: float, coulomb: float
) -> list[dict[str, float]]:
    """Apparent mass, kg, and delay, ms, from force to acceleration: mean over pulses, no model."""
    dt = float(np.mean(np.diff(record["t"])))
    q, before, length = record["q"], 50, 300
    v, a = np.gradient(q, dt), np.gradient(np.gradient(q, dt), dt)
    a[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / dt**2
    left = record["force"] - viscous * v - coulomb * np.sign(v)
    step = np.diff(record["pulses"])
    edges = [k for k in np.flatnonzero(step) if 500 < k < len(q) - 500 and abs(v[k]) > 0.02]
    spectra = []
    for signal in (left, a):
        mean = np.mean(
            [np.sign(step[k]) * signal[k - before : k - before + length] for k in edges], axis=0
        )
        spectra.append(np.fft.rfft(mean - mean[: before - 5].mean()))
    hz = np.fft.rfftfreq(length, dt)
    ratio = spectra[0] / spectra[1] * np.sinc(hz * dt) ** 2  # of the second difference
    chosen = np.flatnonzero((hz > 12.0) & (hz < 210.0))[::6]
    return [
        {"hz": float(hz[k]), "mass_kg": float(abs(ratio[k])),
         "delay_ms": float(1e3 * np.angle(ratio[k]) / (2.0 * np.pi * hz[k]))}
        for k in chosen
    ]  # fmt: skip


def read_record(path: Path) -> dict[str, Array]:
    """Time s, position m, force N and pulses of one file."""
    found = {k: np.ravel(v).astype(float) for k, v in loadmat(path).items() if k[0] != "_"}
    return {
        "t": found["t"], "q": found["qm"], "force": found["gtau"] * found["vir"],
        "pulses": found.get("pulses_N", np.zeros(0)),
    }  # fmt: skip


def search(work: Path, session: Path, positions: dict[str, Array]) -> dict[str, Any]:
    """What `extend --auto` finds on DATA_EMPS, and how far that carries."""
    run = work / "runs" / session.name
    bampipe("run", session, "--runs", work / "runs", "--until", "validate")
    seconds, told = bampipe("extend", run, "--auto")
    ladder = read_ladder(run)
    return {
        "seconds": seconds,
        "told": told.replace(f"{work}/", ""),
        "effects": [effect for _, added in ladder for effect in added],
        "as_found": score(run, ladder[-1][0], positions),
        "diagnosis": read(run, "base", "diagnose")["axes"]["carriage"],
    }


def climb(
    work: Path, session: Path, effects: Sequence[str], positions: dict[str, Array]
) -> list[dict[str, Any]]:
    """The three tasks effect by effect, with the authors' filters and least squares."""
    runs, run = ("--runs", work / "authors"), work / "authors" / session.name
    bampipe("run", session, *runs, "--pipeline", SAMPLE / "published.toml")
    model, rungs, known = "base", [], {"base"}
    for effect in ("", *effects):
        if effect:
            bampipe("extend", run, effect, "--model", model)
            (model,) = {*open_run(run).models} - known  # a long name is shortened
            known.add(model)
        rungs.append(
            {"added": effect, **score(run, model, positions), "closed": closed_loop(run, model)}
        )
        print(rungs[-1], flush=True)
    return rungs


def diagnose_pulses(work: Path, source: Path) -> dict[str, Any]:
    """The verdict on DATA_EMPS_PULSES alone, with the parameters of DATA_EMPS as priors."""
    session = write_session(source, work / "pulses", ["test"])
    put_priors(session / "device.toml", work / "authors" / "emps")
    bampipe("run", session, "--runs", work / "runs", "--until", "validate")
    run = work / "runs" / session.name
    bampipe("diagnose", run, "--model", "base")
    found = read(run, "base", "diagnose")
    return {
        "band_hz": read(run, "base", "validate")["cutoff_hz"],
        "verdict": found["axes"]["carriage"],
        "ranking": found["ranking"][:6],
    }


def main() -> None:
    """Run all, print and store."""
    given, work = parse(
        __doc__,
        effects={
            "nargs": "*",
            "help": "take these effects; neither search for them nor diagnose the pulses",
        },
    )
    source = need(given.data / "emps")
    records = {name: read_record(source / file) for name, file in FILES.items()}
    positions = {name: record["q"] for name, record in records.items()}
    session = write_session(source, work / "emps")
    found = search(work, session, positions) if given.effects is None else None
    effects = found["effects"] if found else given.effects
    rungs = climb(work, session, effects, positions)
    friction = [rungs[0]["parameters"][f"{name}.carriage"][0] for name in ("viscous", "coulomb")]
    result = {
        "published_mm": PUBLISHED,
        "search": found,
        "rungs": rungs,
        "transfer": look_at_pulses(records["test"], *friction),
        "pulses": diagnose_pulses(work, source) if found else None,
    }
    print(store("emps", result, given.out))


if __name__ == "__main__":
    main()
