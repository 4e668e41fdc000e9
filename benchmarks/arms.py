"""Arms of the independent simulator, taken from URDF and logs as a newcomer would take them.

    python benchmarks/arms.py [--case NAME ...] [--seeds N] [--noise SHARE] [--out DIR]

Each case hides something in an arm, lets `bampipe init` propose the session, runs and diagnoses it.
A row a case: whether every column went to its joint with its sign, what was named, the held-out
error over its floor before and after, and the seconds of each command.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import tomllib
from pathlib import Path

from independent import arm
from measured import bampipe

CASES: dict[str, tuple[int, str, str, dict[str, float]]] = {
    "nothing": (211, "ZYYX", "joint_states", {}),
    "late drive": (212, "ZYYX", "joint_states", {"actuator_delay:elbow": 1.0}),
    "offset": (213, "ZYYX", "joint_states", {"drive_offset:shoulder": 1.0}),
    "cable and spring": (
        214, "ZYYX", "joint_states", {"cable:base_yaw": 1.0, "return_spring:forearm": 1.0}
    ),
    "friction with load": (215, "ZYY", "joint_states", {"load_dependent_friction:shoulder": 1.0}),
    "counterbalance": (216, "ZYY", "joint_states", {"counterbalance:shoulder": 1.0}),
    "coupled wrist": (217, "ZYYXY", "joint_states", {"friction_of_sum:forearm-wrist_pitch": 1.0}),
    "Stribeck, a slide": (218, "ZYx", "numbered", {"stribeck:shoulder": 1.0}),
    "spring, seven joints": (219, "ZYZYZYZ", "joint_states", {"return_spring:wrist_yaw": 1.0}),
    "offset, by currents": (220, "ZYYX", "controller", {"drive_offset:forearm": 1.0}),
    "sticking: nothing": (8104, "ZYX", "joint_states", {}),
    "sticking less: nothing": (8102, "ZYY", "joint_states", {}),
    "sticking: offset": (8108, "ZYY", "joint_states", {"drive_offset:shoulder": 1.0}),
    "sticking more: offset": (8106, "ZYZ", "joint_states", {"drive_offset:shoulder": 1.0}),
    "sticking, four joints: offset": (8103, "ZYYX", "joint_states", {"drive_offset:elbow": 1.0}),
    "sticking: Stribeck": (8105, "ZYY", "joint_states", {"stribeck:shoulder": 1.0}),
    "sticking: late drive": (8107, "ZYY", "joint_states", {"actuator_delay:elbow": 1.0}),
}  # fmt: skip
"""By name: seed, axes of the joints, headers, what is hidden."""
SOFT_HZ = {8102: 10.0, 8103: 5.0, 8104: 4.0, 8105: 5.0, 8106: 3.0, 8107: 3.0, 8108: 4.0}
"""By seed: how softly drives follow their paths, where joints stick as they turn round."""
STICKING: dict[str, float] = {"rate_hz": 250.0, "seconds": 12.0, "noise": 0.01}
"""How those are recorded."""


def is_paired(folder: Path, names: list[str], turned: list[str]) -> bool:
    """Whether every column went to its joint, and every drive got its sign."""
    session = tomllib.loads((folder / "session.toml").read_text())
    drives = {name.partition("_")[2]: c for name, c in session["channels"].items()}
    for number, name in enumerate(names, 1):
        for what, column in (("position", session["encoders"][name]), ("drive", drives[name])):
            said = column["column"]
            by_number = f"_{number} " in said or said.endswith(f"_{number - 1}")
            if name not in said and not by_number:
                return False
            if what == "drive" and (column.get("scale", 1.0) < 0.0) != (name in turned):
                return False
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", action="append", choices=CASES)
    parser.add_argument("--seeds", type=int, default=1, help="of each case, counted from its own")
    parser.add_argument(
        "--noise", type=float, default=0.03, help="of drives, share of dry friction"
    )
    parser.add_argument("--out", type=Path, default=Path(tempfile.mkdtemp()))
    given = parser.parse_args()
    print("| hidden | init | named | over the floor | run, s | diagnose, s |\n|-|-|-|-|-|-|")
    for case in given.case or CASES:
        first, kinds, style, effects = CASES[case]
        how = STICKING if first in SOFT_HZ else {"noise": given.noise}
        for seed in range(first, first + 100 * given.seeds, 100):
            folder = given.out / f"{re.sub(r'[:,]', '', case).replace(' ', '_')}_{seed}"
            turned = ["shoulder"] if seed % 2 else []
            arm.record_logs(
                folder, seed, kinds, effects, style=style, turned=turned,
                soft_hz=SOFT_HZ.get(first, 0.0), **how,
            )  # fmt: skip
            runs = ["--runs", str(given.out / "runs")]
            bampipe("init", str(folder))
            names = list(arm.NAMES[: len(kinds)])
            paired = "right" if is_paired(folder, names, turned) else "wrong"
            to_run, _ = bampipe("run", str(folder), *runs)
            run = given.out / "runs" / folder.name
            to_diagnose, _ = bampipe("diagnose", str(run), *runs)
            found = json.loads((run / "models/base/diagnose.json").read_text())
            worst = {
                axis: (entry["rmse_before"] / entry["noise_floor"],
                       entry["rmse_after"] / entry["noise_floor"])
                for axis, entry in found["axes"].items()
            }  # fmt: skip
            axis = max(worst, key=lambda name: worst[name][0])
            print(
                f"| {', '.join(effects) or case} | {paired} | {', '.join(found['selected']) or '–'}"
                f" | {axis} {worst[axis][0]:.2f} to {worst[axis][1]:.2f}"
                f" | {to_run:.0f} | {to_diagnose:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
