"""Run folders with made-up results of every stage, for the tests of the report.

The numbers mean nothing; files and fields are those that the stages leave.
"""

from collections.abc import Callable
from pathlib import Path

import made_results
import numpy as np
import pandas as pd
from made_results import diagnosis, filled, write_result

from bampipe.data.store import write_parquet
from bampipe.phrases import diagnosis as phrases
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.filter import FilterResult
from bampipe.results.floor import compare_with_floor
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.run import RunResult
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.terms import TermsResult
from bampipe.results.validate import ValidateResult

AXES = ("yaw", "pitch", "extension")
TORQUE_UNIT = {"yaw": "N.m", "pitch": "N.m", "extension": "N"}
FREE = ("t01_free", "t02_free", "t03_free")
BASE = {
    "viscous.yaw": (4.1712, 0.1283, "N.m.s/rad"),
    "coulomb.yaw": (1.0864, 0.1031, "N.m"),
    "viscous.pitch": (3.7521, 0.2962, "N.m.s/rad"),
    "coulomb.pitch": (2.2541, 0.1092, "N.m"),
    "viscous.extension": (13.3712, 0.4273, "N.s/m"),
    "coulomb.extension": (3.5713, 0.1031, "N"),
    "mass": (3.5521, 0.0132, "kg"),
}
ADDED = {
    "stribeck.yaw.force": (1.0212, 0.0643, "N.m"),
    "stribeck.yaw.speed": (0.0513, 0.0042, "rad/s"),
}
CHILD = "base+stribeck.yaw"
RATE = 100.0
SECONDS = 16.0


def write_all(root: Path) -> Path:
    """Write a session whose yaw lacked Stribeck friction, diagnosed and extended."""
    write_ingest(root)
    write_filter(root)
    write_stiffness(root)
    for model in ("base", CHILD):
        write_model(root, model)
        write_validation(root, model)
        write_diagnosis(root, model)
    write_comparison(root)
    write_record(root)
    return root


def write_ingest(root: Path) -> None:
    """Write what ingest leaves; one trial repaired, one set aside."""
    rows = [_trial(name, "free") for name in FREE]
    rows[-1] |= {"status": "repaired", "repairs": "12 samples missing at 3.2 s: interpolated"}
    aside = {"status": "set_aside", "reason": "force_x frozen"}
    aside |= {"n_samples": 0, "duration_s": np.nan, "sample_rate_hz": np.nan}
    rows.append(_trial("t04_free", "free") | aside)
    rows.append(_trial("t05_locked_yaw", "locked") | {"locked_axis": "yaw"})
    write_parquet(root / "ingest/trials.parquet", pd.DataFrame(rows))

    def samples(number: int) -> pd.DataFrame:
        frame = motion(number)
        columns = {f"q_{axis}": frame[f"q_{axis}"] for axis in AXES}
        return pd.DataFrame({"t": frame["t"], **columns, "force_x": np.cos(frame["t"])})

    write_parquet(root / "ingest/samples.parquet", _by_trial(samples))
    units = {"yaw": ("rad", 47e-6), "pitch": ("rad", 98e-6), "extension": ("m", 30e-6)}
    columns = [f"force_{c}" for c in "xyz"]
    write_result(
        root, IngestResult, session_id=root.name, device="bam", sample_rate_hz=RATE,
        axes={axis: {"unit": u, "resolution": r} for axis, (u, r) in units.items()},
        force={"noise_sd": {"force_x": 0.05}, "unit": "N", "columns": columns},
        recorded_at="2026-10-03T10:12:00+00:00",
    )  # fmt: skip


def _trial(name: str, kind: str) -> dict[str, object]:
    return {
        "trial_id": name, "file": f"trials/{name}.csv", "kind": kind, "locked_axis": None,
        "viscous_n_s_per_m": None, "n_samples": int(SECONDS * RATE), "duration_s": SECONDS,
        "sample_rate_hz": RATE, "status": "ok", "reason": "", "repairs": "",
    }  # fmt: skip


def motion(number: int) -> pd.DataFrame:
    """Return t, positions and velocities of one made-up trial."""
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    columns = {"t": t}
    for place, axis in enumerate(AXES):
        speed = 2.0 * np.pi * (0.21 + 0.13 * place + 0.02 * number)
        size = (0.6, 0.4, 0.2)[place]
        offset = (0.0, 0.05, 1.1)[place]
        columns[f"q_{axis}"] = offset + size * np.sin(speed * t) * np.sin(0.3 * t)
        columns[f"qd_{axis}"] = np.gradient(columns[f"q_{axis}"], t)
    return pd.DataFrame(columns)


def _by_trial(frame_of: Callable[[int], pd.DataFrame]) -> pd.DataFrame:
    frames = {name: frame_of(number) for number, name in enumerate(FREE)}
    return pd.concat(frames, names=["trial_id"]).reset_index(level=0).reset_index(drop=True)


def write_filter(root: Path) -> None:
    """Write what the filter stage leaves."""
    write_parquet(root / "filter/kinematics.parquet", _by_trial(motion))
    axes = {
        axis: {
            "unit": "m" if axis == "extension" else "rad", "bandwidth_hz": 23.4,
            "resolution": 47e-6, "position_sd": 4.4e-6, "velocity_sd": 0.36e-3,
            "acceleration_sd": 0.046,
        }
        for axis in AXES
    }  # fmt: skip
    write_result(root, FilterResult, method="kalman", method_reason="default", axes=axes)


def write_stiffness(root: Path) -> None:
    """Write one axis with its loops."""
    phase = np.linspace(0.0, 6.0 * np.pi, 1200)
    torque = 45.0 * np.sin(phase)
    deflection = torque / 2300.0 + 1e-3 * np.sign(np.cos(phase))
    loops = pd.DataFrame(
        {
            "trial_id": "t05_locked_yaw", "axis": "yaw", "cycle": (phase // (2 * np.pi)),
            "branch": np.where(np.cos(phase) > 0, "rising", "falling"), "t": phase,
            "torque": torque, "deflection": deflection, "post_yield": np.abs(torque) < 30.0,
        }
    )  # fmt: skip
    write_parquet(root / "stiffness/loops.parquet", loops)
    yaw = {
        "stiffness": 2304.2, "sd": 13.1, "unit": "N.m/rad", "n_cycles": 3,
        "bandwidth_rad_s": 25.13, "bandwidth_hz": 4.0, "bandwidth_pose": "recorded",
        "poses": {"recorded": {"yaw": 0.1, "pitch": 0.05, "extension": 1.1}},
        "loop_width": 5.53, "loop_width_unit": "N.m", "energy_per_cycle": 0.197, "energy_unit": "J",
        "cycles": [{"trial_id": "t05_locked_yaw"}],
    }  # fmt: skip
    write_result(root, StiffnessResult, axes={"yaw": yaw})


def parameters(model: str) -> dict[str, tuple[float, float, str]]:
    """Return the made-up parameters of ``model``."""
    return {**BASE, **(ADDED if model == CHILD else {})}


def write_model(root: Path, model: str) -> None:
    """Write what identification leaves."""
    made_results.write_model(root, model, *(("stribeck:yaw",) if model == CHILD else ()))
    named = {
        name: {
            "estimate": value, "sd": sd, "unit": unit, "at_bound": name == "stribeck.yaw.speed",
            "filter_sd": 0.5 * sd,
        }
        for name, (value, sd, unit) in parameters(model).items()
    }  # fmt: skip
    bounds = {
        "yaw": {"position": 2.8e-3, "velocity": 43e-3},
        "pitch": {"position": 5.2e-3, "velocity": 62e-3},
        "extension": {"position": 0.9e-3, "velocity": 19e-3},
    }
    methods = {
        method: {
            "held_out_rmse": {"yaw": 0.1, "pitch": 0.2, "extension": 0.4},
            "parameters": {
                name: {"estimate": value + shift * sd, "sd": sd}
                for name, (value, sd, unit) in parameters(model).items()
            },
        }
        for method, shift in (("ukf", 0.0), ("least-squares", 0.4))
    }
    sds = np.array([sd for _, sd, _ in parameters(model).values()])
    together = 0.4 ** np.abs(np.subtract.outer(range(len(sds)), range(len(sds))))
    covariance = {"names": list(named), "matrix": (together * np.outer(sds, sds)).tolist()}
    write_result(
        root, IdentifyResult, model=model, method="ukf", parameters=named, state_3sigma=bounds,
        methods=methods, covariance=covariance, blocks=24,
        convergence={"converged": True, "total_s": 48.0, "settled_s": {"mass": 16.93}},
        nis={"mean": 1.0231, "by_trial": {}},
        input_timing={"estimate": 1.2e-4, "sd": 3.1e-5, "unit": "s"},
    )  # fmt: skip

    def states(number: int) -> pd.DataFrame:
        frame = motion(number)
        for axis in AXES:
            frame[f"torque_user_{axis}"] = 4.0 * frame[f"qd_{axis}"]
        frame["torque_gravity_pitch"] = 20.0 * np.cos(frame["q_pitch"])
        return frame

    write_parquet(root / f"models/{model}/states.parquet", _by_trial(states))
    t = np.arange(0.0, SECONDS * len(FREE), 0.05)
    trace = {
        "t_total": t,
        "trial_id": np.array(FREE)[np.minimum((t // SECONDS).astype(int), len(FREE) - 1)],
    }
    for name, (value, sd, _) in parameters(model).items():
        fading = np.exp(-t / 6.0)
        trace[name] = value + fading * 5.0 * sd * np.cos(t)
        trace[f"{name}_sd"] = sd * (1.0 + 8.0 * fading)
    write_parquet(root / f"models/{model}/trace.parquet", pd.DataFrame(trace))


def held_out(model: str) -> dict[str, float]:
    """Return the made-up held-out error of ``model``."""
    return {"yaw": 0.2117 if model == CHILD else 0.5623, "pitch": 0.2342, "extension": 0.6123}


FLOOR = {"yaw": 0.2034, "pitch": 0.2291, "extension": 0.6012}


def write_validation(root: Path, model: str) -> None:
    """Write what validation leaves."""
    axes = {
        axis: {
            "rmse": 0.98 * error, "rmse_without_friction": 3.1234, "held_out_rmse": error,
            "noise_floor": FLOOR[axis], "noise_floor_sd": 0.001, "fit_percent": 91.24,
            "standing": compare_with_floor(error, FLOOR[axis], 0.001), "unit": TORQUE_UNIT[axis],
        }
        for axis, error in held_out(model).items()
    }  # fmt: skip
    write_result(
        root, ValidateResult, model=model, axes=axes, cutoff_hz=dict.fromkeys(AXES, 8.0),
        trials={name: {**axes, "held_out": True} for name in FREE},
        forces={"force_x": {"rmse": 0.1234, "unit": "N"}}, notes=["A note of the validation."],
    )  # fmt: skip
    size = 0.3 if model == "base" else 0.1

    def residuals(number: int) -> pd.DataFrame:
        frame = motion(number)
        columns: dict[str, object] = {"t": frame["t"], "held_out": number > 0}
        wave = size * np.sin(7.0 * frame["t"])
        for axis in AXES:
            without = 2.0 * np.gradient(frame[f"qd_{axis}"], frame["t"])
            friction = 4.0 * frame[f"qd_{axis}"] + np.tanh(frame[f"qd_{axis}"] / 0.01)
            columns[f"torque_measured_{axis}"] = without + friction + wave
            columns[f"torque_predicted_{axis}"] = without + friction
            columns[f"torque_predicted_without_friction_{axis}"] = without
            columns[f"residual_{axis}"] = wave
        return pd.DataFrame(columns)

    write_parquet(root / f"models/{model}/residuals.parquet", _by_trial(residuals))
    write_terms(root, model)


def _text(summary: str, formula: str) -> dict[str, object]:
    return {
        "summary": summary, "formulas": [formula], "looks_like": "a step",
        "source": "Stribeck 1902", "on_the_machine": "Grease the joint",
    }  # fmt: skip


def write_terms(root: Path, model: str) -> None:
    """Write the equations and terms that validation leaves."""
    speed = np.linspace(-0.8, 0.8, 9)

    def curve(axis: str, mean: np.ndarray) -> dict[str, object]:
        return {
            "axis": axis, "unit": TORQUE_UNIT[axis], "variable": "velocity",
            "variable_unit": "rad/s", "center": speed.tolist(), "mean": mean.tolist(),
            "low": (mean - 0.1).tolist(), "high": (mean + 0.1).tolist(), "variance_share": 0.9,
        }  # fmt: skip

    terms = [
        {
            "name": "friction:yaw", "parameters": ["viscous.yaw", "coulomb.yaw"],
            "text": _text("Viscous and Coulomb friction", "torque = -viscous*qd - coulomb*sgn(qd)"),
            "curves": [curve("yaw", 4.0 * speed + np.sign(speed))],
        }
    ]  # fmt: skip
    if model == CHILD:
        terms.append(
            {
                "name": "stribeck:yaw", "parameters": list(ADDED),
                "text": _text("Friction rises as the speed falls", "torque = -force*exp(-qd**2)"),
                "curves": [curve("yaw", np.sign(speed) * np.exp(-((speed / 0.1) ** 2)))],
            }
        )  # fmt: skip
    equations = ["M[θ,θ] = 3.552 (L - r)^2", "Q[θ] = -1.086 sgn(θ') - 4.171 θ'"]
    write_result(root, TermsResult, model=model, equations=equations, terms=terms)


def write_diagnosis(root: Path, model: str) -> None:
    """Write what the diagnosis leaves: Stribeck friction of yaw missing from the base model."""
    missing = model == "base"
    axes = {}
    for axis, error in held_out(model).items():
        lacking = missing and axis == "yaw"
        axes[axis] = {
            "verdict": "missing" if lacking else "nothing_missing",
            "unknown": 0.012, "explained": 0.9883, "force_rms": 3.1,
            "explainable_share": 0.812 if lacking else 0.013,
            "rmse_before": error, "rmse_after": 0.2117 if lacking else error,
            "rmse_beyond_bias": 0.1834, "noise_floor": FLOOR[axis], "unit": TORQUE_UNIT[axis],
        }  # fmt: skip
    speed = np.linspace(-0.8, 0.8, 15)
    size = 1.0 if missing else 0.0
    maps = {
        axis: {
            "velocity": _map("rad/s", speed, size * np.sign(speed) * np.exp(-((speed / 0.1) ** 2))),
            "position": _map("rad", speed, 0.05 * np.sin(9.0 * speed)),
            "acceleration": _map("rad/s2", 5.0 * speed, 0.04 * np.cos(5.0 * speed)),
            "trial": _map("", [0.0, 1.0, 2.0], np.array([0.02, -0.03, 0.01])),
            "direction": _map("", [-1.0, 1.0], np.array([0.02, -0.03])),
        }
        for axis in AXES
    }
    ranking = [
        _candidate("stribeck:yaw", 0.2117, 0.0004, 0.973, ["presliding:yaw"]),
        _candidate("presliding:yaw", 0.2323, 0.0021, 0.027, ["stribeck:yaw"]),
        _candidate("asymmetric_coulomb:yaw", 0.5589, 0.41, 0.0, []),
    ]

    def variables(number: int) -> pd.DataFrame:
        frame = motion(number)
        columns = {f"{axis}.velocity": frame[f"qd_{axis}"] for axis in AXES}
        return pd.DataFrame({"t": frame["t"], **columns})

    write_parquet(root / f"models/{model}/map_variables.parquet", _by_trial(variables))
    window = {
        "axis": "yaw", "trial_id": FREE[1], "t_start": 3.2, "t_end": 3.7, "rmse": 1.234,
        "doing": "reversing slowly with the arm extended",
    }  # fmt: skip
    sets = {("stribeck:yaw",): 0.973, ("presliding:yaw",): 0.027} if missing else {(): 1.0}
    found = filled(
        DiagnoseResult,
        {
            **diagnosis(axes, sets),
            "model": model,
            "ranking": ranking if missing else [],
            "descriptions": {
                "presliding": _text("Friction builds up over a distance", "torque = -z"),
                "asymmetric_coulomb": _text("Friction differs by direction", "torque = -abs(qd)"),
            }
            if missing
            else {},
            "chance": {
                "replicates": 12, "largest": [1.23, 4.56], "measured": 2.34,
                "effect": "backlash:pitch", "p_value": 0.412,
            },
            "suggested_trial": {"sentence": "Move yaw back and forth at 0.02 rad/s for 20 s."}
            if missing
            else None,
            "maps": maps,
            "worst_windows": [window],
            "next": "bampipe extend RUN stribeck:yaw --model base" if missing else "nothing to add",
        },
    )  # fmt: skip
    said = phrases.describe_axes(DiagnoseResult.model_validate(found))
    for axis, sentence in said.items():
        found["axes"][axis]["sentence"] = sentence
    write_result(root, DiagnoseResult, **{**found, "sentence": " ".join(said.values())})


def _map(unit: str, centre: object, mean: np.ndarray) -> dict[str, object]:
    return {
        "unit": unit, "center": np.asarray(centre).tolist(), "mean": mean.tolist(),
        "low": (mean - 0.04).tolist(), "high": (mean + 0.04).tolist(), "count": [100] * len(mean),
    }  # fmt: skip


def _candidate(
    effect: str, after: float, p: float, probability: float, alike: list[str]
) -> dict[str, object]:
    return {
        "effect": effect, "axis": "yaw", "held_out_rmse_before": held_out("base")["yaw"],
        "held_out_rmse_after": after, "unit": "N.m", "p_value": p, "score": 1.0,
        "probability": probability, "indistinguishable_from": alike,
    }  # fmt: skip


def write_comparison(root: Path) -> None:
    """Write the ladder of the two models."""
    ladder = [
        {
            "model": model, "parent": "base" if model == CHILD else None,
            "added": "stribeck:yaw" if model == CHILD else None,
            "held_out_rmse": held_out(model), "noise_floor": FLOOR,
        }
        for model in ("base", CHILD)
    ]  # fmt: skip
    named: dict[str, dict[str, object]] = {}
    for model in ("base", CHILD):
        for name, (value, sd, unit) in parameters(model).items():
            entry = {"estimate": value, "sd": sd, "unit": unit}
            named.setdefault(name, {})[model] = entry
    moved = [
        {
            "parameter": "coulomb.yaw", "model": CHILD, "change": -0.21, "sd": 0.1,
            "sentence": "coulomb.yaw fell by 0.21 N.m, twice its uncertainty.",
        }
    ]  # fmt: skip
    write_result(root, CompareResult, best=CHILD, ladder=ladder, parameters=named, moved=moved)


def write_record(root: Path) -> None:
    """Write run.json."""
    hashes = {f"session/trials/{name}.csv": f"{number:x}" * 64 for number, name in enumerate(FREE)}
    order = ("ingest", "filter", "stiffness", "identify:base")
    stages = {
        name: {
            "key": f"{number}bcdef0123456789".ljust(64, "0"), "code": "c" * 64,
            "config": {"model": "base"},
            "inputs": {f"{order[number - 1]}/x": "e" * 64} if number else
            {"session/session.toml": "a" * 64, **hashes},
            "outputs": {f"{name}/x": "e" * 64},
            "versions": {"bampipe": "0.1.0", "python": "3.11.9"},
        }
        for number, name in enumerate(order)
    }  # fmt: skip
    write_result(root, RunResult, stages=stages)
