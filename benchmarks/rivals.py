"""Other programs on the sessions of `emps.py` and `measured_sets.py`: same records, same split.

    python -m venv rivals && rivals/bin/pip install 'mujoco[sysid]' pysindy==2.1 figaroh==1.0.2
    rivals/bin/python benchmarks/rivals.py [--data FOLDER]

- `mujoco.sysid` and PySINDy on EMPS: fitted to DATA_EMPS; the open loop over DATA_EMPS_PULSES from
  its first 20 samples, RMSE in mm, as in `emps.py`.
- FIGAROH on the TX40, by `beside_figaroh.py`: error held out, five folds, per joint.

What is not installed is skipped, and stored so. Needs nothing of bampipe.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

ROOT = Path(__file__).resolve().parents[1]
GIVEN, DT = 20, 1e-3
SCOPE = {
    "mujoco": (
        "“fits a 24-parameter model … by minimizing rollout tracking error” (README of its SO-101"
        " example)"
    ),
    "pysindy": (
        "“selecting relevant terms for the model from a library of candidate functions” (its"
        " documentation)"
    ),
    "figaroh": (
        "“geometric calibration and dynamic parameter identification of rigid multi-body systems”"
        " (its page on PyPI)"
    ),
}
"""What each is for, in its makers' words; naming what a model lacks is in none of them."""


def read_record(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Position, m, and force, N, of one EMPS record."""
    found = loadmat(path)
    return found["qm"].ravel(), (found["vir"] * found["gtau"]).ravel()


def start_of(q: np.ndarray) -> tuple[float, float]:
    """Position and velocity at the last sample given, by a parabola."""
    p = np.polyfit(DT * np.arange(1 - GIVEN, 1), q[:GIVEN], 2)
    return float(p[2]), float(p[1])


def rmse_mm(found: np.ndarray, q: np.ndarray) -> float:
    """RMSE after the samples given, mm."""
    return 1e3 * float(np.sqrt(np.mean((found - q[GIVEN : GIVEN + len(found)]) ** 2)))


def run_mujoco(source: Path) -> dict[str, Any]:
    """A slide with mass, damping, dry friction and offset, fitted to its free run on DATA_EMPS."""
    import mujoco
    from mujoco import rollout, sysid

    xml = """<mujoco><option timestep="0.001" integrator="implicitfast" gravity="0 0 0">
      <flag contact="disable"/></option><worldbody><body name="carriage">
      <inertial pos="0 0 0" mass="50" diaginertia="1 1 1"/>
      <joint name="slide" type="slide" axis="1 0 0" damping="100" frictionloss="20"/>
      </body></worldbody><actuator><motor name="drive" joint="slide"/>
      <motor name="offset" joint="slide"/></actuator>
      <sensor><jointpos name="position" joint="slide"/></sensor></mujoco>"""
    spec = mujoco.MjSpec.from_string(xml)
    model = spec.compile()

    def follow(
        changed: mujoco.MjModel, q: np.ndarray, force: np.ndarray, offset: float
    ) -> np.ndarray:
        x, v = start_of(q)
        begin = sysid.create_initial_state(changed, np.array([x]), np.array([v]))
        control = np.column_stack([force[GIVEN - 1 : -1], np.full(len(force) - GIVEN, offset)])
        data = mujoco.MjData(changed)
        return np.asarray(rollout.rollout(changed, data, begin, control)[1]).ravel()

    q, force = read_record(source / "DATA_EMPS.mat")
    x, v = start_of(q)
    begin = sysid.create_initial_state(model, np.array([x]), np.array([v]))
    t = DT * np.arange(len(q) - GIVEN + 1)
    control = sysid.TimeSeries(t, np.column_stack([force[GIVEN - 1 :], np.ones_like(t)]))
    sensor = sysid.TimeSeries.from_names(t[1:], q[GIVEN:, None], model)
    parameters = sysid.ParameterDict()

    def add(name: str, start: float, most: float, change: Callable[[Any, float], None]) -> None:
        least = -most if name == "offset" else 1e-3
        parameters.add(
            sysid.Parameter(
                name, nominal=start, min_value=least, max_value=most,
                modifier=lambda s, p: change(s, float(p.value[0])),
            )
        )  # fmt: skip

    add("mass", 50.0, 300.0, lambda s, x: setattr(s.body("carriage"), "mass", x))
    add("viscous", 100.0, 1000.0, lambda s, x: s.joint("slide").damping.__setitem__(0, x))
    add("coulomb", 20.0, 100.0, lambda s, x: setattr(s.joint("slide"), "frictionloss", x))
    add("offset", 0.0, 20.0, lambda s, x: s.actuator("offset").gear.__setitem__(0, x))
    sequence = sysid.ModelSequences("emps", spec, "record", begin, control, sensor)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    found, _ = sysid.optimize(
        initial_params=parameters, residual_fn=residual, optimizer="mujoco", verbose=False
    )
    value = {name: float(found[name].value[0]) for name in ("mass", "viscous", "coulomb", "offset")}
    fitted = sysid.apply_param_modifiers_spec(found, spec).compile()
    fitted.actuator_gear[1, 0] = 1.0  # the offset is in the control
    score = {}
    for name, file in (("train", "DATA_EMPS.mat"), ("test", "DATA_EMPS_PULSES.mat")):
        q, force = read_record(source / file)
        score[name] = rmse_mm(follow(fitted, q, force, value["offset"]), q)
    return {"parameters": value, "open_loop_mm": score}


def run_pysindy(source: Path) -> dict[str, Any]:
    """Acceleration by a sparse sum of candidates, by smoothed differences; then its free run."""
    import pysindy

    library = pysindy.CustomLibrary(
        library_functions=[lambda x: x, lambda x: np.sign(x), lambda x: x * np.abs(x)],
        function_names=[lambda x: x, lambda x: f"sign({x})", lambda x: f"{x}|{x}|"],
        include_bias=True,
    )
    q, force = read_record(source / "DATA_EMPS.mat")
    v = pysindy.SmoothedFiniteDifference()._differentiate(q[:, None], DT)
    model = pysindy.SINDy(
        feature_library=library, optimizer=pysindy.STLSQ(threshold=1e-3, normalize_columns=True),
        differentiation_method=pysindy.SmoothedFiniteDifference(),
    )  # fmt: skip
    model.fit(v, t=DT, u=force[:, None], feature_names=["v", "F"])
    names, weight = model.get_feature_names(), model.coefficients()[0]
    score = {}
    for name, file in (("train", "DATA_EMPS.mat"), ("test", "DATA_EMPS_PULSES.mat")):
        q, force = read_record(source / file)
        x, speed = start_of(q)
        found = np.empty(len(q) - GIVEN)
        for k in range(len(found)):
            f = force[GIVEN - 1 + k]
            features = {
                "1": 1.0, "v": speed, "F": f, "sign(v)": np.sign(speed), "sign(F)": np.sign(f),
                "v|v|": speed * abs(speed), "F|F|": f * abs(f),
            }  # fmt: skip
            rate = sum(w * features[n] for w, n in zip(weight, names, strict=True))
            now = speed + DT * rate
            x, speed = x + 0.5 * DT * (speed + now), now
            found[k] = x
        score[name] = rmse_mm(found, q)
    mass = 1.0 / float(weight[names.index("F")])
    return {
        "parameters": {n: float(w) * mass for n, w in zip(names, weight, strict=True)}
        | {"mass": mass},
        "open_loop_mm": score,
    }


def run_figaroh(data: Path) -> dict[str, Any]:
    """Error held out, per joint, without and with the wrist's coupling put in by hand."""
    command = [sys.executable, str(Path(__file__).with_name("beside_figaroh.py")), str(data)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = re.findall(r"^(.*), held out: (.*) %$", done.stdout, re.M)
    return {"held_out_percent": {what: [float(x) for x in row.split()] for what, row in found}}


def processor_seconds() -> float:
    """Of this process and of those it has waited for."""
    return sum(os.times()[:4])


def main() -> None:
    """Run each that is installed, and store what it finds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "real")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "rivals.json")
    parser.add_argument("--only", nargs="*", default=list(SCOPE), choices=SCOPE)
    given = parser.parse_args()
    runs: dict[str, Callable[[], dict[str, Any]]] = {
        "mujoco": lambda: run_mujoco(given.data / "emps"),
        "pysindy": lambda: run_pysindy(given.data / "emps"),
        "figaroh": lambda: run_figaroh(given.data),
    }
    rows, versions = {}, {"python": platform.python_version()}
    if given.out.exists():
        before = json.loads(given.out.read_text(encoding="utf-8"))
        rows, versions = before["result"], before["versions"]
    for name, run in ((name, runs[name]) for name in given.only):
        begin, row = processor_seconds(), {"scope": SCOPE[name], "note": ""}
        try:
            versions[name] = version(name)
            row |= run()
        except PackageNotFoundError:
            row["note"] = "not installed"
        except Exception as error:  # a rival that fails is a row
            row["note"] = f"{type(error).__name__}: {error}".splitlines()[0]
        rows[name] = row | {"seconds": processor_seconds() - begin}
        print(name, rows[name], flush=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    head = {"command": "python benchmarks/rivals.py", "commit": commit, "versions": versions}
    given.out.write_text(json.dumps({**head, "result": rows}, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
