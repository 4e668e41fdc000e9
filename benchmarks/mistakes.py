"""Set-up mistakes in sessions of the independent simulators: how many are named, and how rightly.

    python benchmarks/mistakes.py bam joint axis damper arm --seeds 3
    python benchmarks/mistakes.py joint --only "degrees for radians"

Each session is recorded soundly, then its session file or its logs are spoilt as a person would.
It goes through ingest and filter; a line says what was named, then comes a table. Of an arm,
`bampipe init` proposes the session before its logs are spoilt.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from independent import MACHINES, arm, record
from independent.sensors import Conditions

import bampipe
from bampipe.setup.proposal import propose, write_proposal

PIPELINE = """schema = "bampipe.pipeline/1"
name = "mistakes"
stages = ["ingest", "filter"]
"""
DEGREES = 180.0 / math.pi
ARM = "ZYY"
"""Axes of the joints of an arm."""
JOINTS = arm.NAMES[: len(ARM)]
FORCES = "force_x+force_y+force_z"
SHORT = {
    "bam": Conditions(trials=4, seconds=10.0, rate_hz=250.0, viscous_trials=1),
    "joint": Conditions(trials=4),
    "axis": Conditions(trials=4, seconds=5.0),
    "damper": Conditions(trials=4),
}


@dataclass(frozen=True)
class Mistake:
    """One mistake of a person.

    Attributes:
        spoil: makes it in a session folder.
        key: what must be named, ``kind:channel``.
    """

    spoil: Callable[[Path], None]
    key: str


def _rewrite(file: Path, pattern: str, new: str | Callable[[re.Match[str]], str]) -> None:
    text, count = re.subn(pattern, new, file.read_text(encoding="utf-8"))
    if not count:
        raise ValueError(f"{file}: nothing matches {pattern!r}")
    file.write_text(text, encoding="utf-8")


def set_text(pattern: str, new: str, file: str = "session.toml") -> Callable[[Path], None]:
    """Return what replaces ``pattern`` in a file of the session."""
    return lambda folder: _rewrite(folder / file, pattern, new)


def scale_number(pattern: str, factor: float) -> Callable[[Path], None]:
    """Return what multiplies the number after ``pattern`` in the session file."""

    def scaled(match: re.Match[str]) -> str:
        return f"{match[1]}{float(match[2]) * factor!r}"

    return lambda folder: _rewrite(folder / "session.toml", f"({pattern})([-0-9.e+]+)", scaled)


def scale_trials(column: str, factors: Sequence[float]) -> Callable[[Path], None]:
    """A column times a factor of its own in each trial."""

    def change(folder: Path) -> None:
        for path, factor in zip(sorted(folder.glob("trials/*.csv")), factors, strict=True):
            frame = pd.read_csv(path)
            frame[column] *= factor
            frame.to_csv(path, index=False)

    return change


def hold_even(folder: Path) -> None:
    """The force of an axis held even, but for noise."""
    for path in folder.glob("trials/*.csv"):
        frame = pd.read_csv(path)
        frame["u"] = 1.0 + 0.02 * np.random.default_rng(31).standard_normal(len(frame))
        frame.to_csv(path, index=False)


def scale_column(column: str, factor: float, offset: float = 0.0) -> Callable[[Path], None]:
    """Return what writes ``factor * column + offset`` in place of a column of every log."""

    def spoil(folder: Path) -> None:
        for file in sorted(folder.rglob("*.csv")):
            frame = pd.read_csv(file)
            frame[column] = frame[column] * factor + offset
            frame.to_csv(file, index=False, float_format="%.14g", lineterminator="\n")

    return spoil


def exchange_columns(one: str, other: str) -> Callable[[Path], None]:
    """Return what exchanges two column names in the session file."""

    def spoil(folder: Path) -> None:
        names = {f'"{one}"': f'"{other}"', f'"{other}"': f'"{one}"'}
        _rewrite(folder / "session.toml", "|".join(names), lambda match: names[match[0]])

    return spoil


def exchange_headers(one: str, other: str) -> Callable[[Path], None]:
    """Return what exchanges two columns of every log."""

    def spoil(folder: Path) -> None:
        for file in sorted(folder.rglob("*.csv")):
            frame = pd.read_csv(file)
            frame[[one, other]] = frame[[other, one]].to_numpy()
            frame.to_csv(file, index=False, float_format="%.14g", lineterminator="\n")

    return spoil


def calibrate(change: Callable[[list[list[float]]], list[list[float]]]) -> Callable[[Path], None]:
    """Return what changes the calibration matrix in the session file."""

    def changed(match: re.Match[str]) -> str:
        return f"{match[1]}{change(json.loads(match[2]))}"

    return lambda folder: _rewrite(
        folder / "session.toml", r"(calibration_n_per_v = )(\[\[.*\]\])", changed
    )


def do_all(*changes: Callable[[Path], None]) -> Callable[[Path], None]:
    """Return what makes several changes."""

    def spoil(folder: Path) -> None:
        for change in changes:
            change(folder)

    return spoil


def flip_rows(*rows: int) -> Callable[[Path], None]:
    """Return what negates rows of the calibration matrix."""
    return calibrate(
        lambda matrix: [
            [-v for v in row] if number in rows else row for number, row in enumerate(matrix)
        ]
    )


def scale_all(factor: float) -> Callable[[Path], None]:
    """Return what multiplies the calibration matrix."""
    return calibrate(lambda matrix: [[v * factor for v in row] for row in matrix])


def identity(matrix: list[list[float]]) -> list[list[float]]:
    """Return the calibration that nobody has made yet."""
    return [[float(i == j) for j in range(len(matrix))] for i in range(len(matrix))]


def per_unit(axis: str, factor: float) -> Callable[[Path], None]:
    """Return what multiplies the counts of one unit of an axis."""
    return scale_number(rf"\n{axis} = .*counts_per_unit = ", factor)


def position(joint: str) -> str:
    """Return the column of a joint's position in the logs of the arm."""
    return f"/joint_states/{joint}/position"


def effort(joint: str) -> str:
    """Return the column of a joint's drive in the logs of the arm."""
    return f"/joint_states/{joint}/effort"


def record_session(machine: str, folder: Path, seed: int, effects: Mapping[str, float]) -> None:
    """Write a session of a machine, without a mistake."""
    if machine != "arm":
        record(machine, folder, seed, effects, SHORT[machine])
        return
    arm.record_logs(folder, seed, ARM, effects, style="joint_states", seconds=8.0)
    write_proposal(folder, propose(folder))


SOUND = Mistake(lambda folder: None, "")
MISTAKES: Mapping[str, Mapping[str, Mistake]] = {
    "bam": {
        "encoder of the yaw reversed": Mistake(per_unit("yaw", -1.0), "sign:yaw"),
        "encoder of the pitch reversed": Mistake(per_unit("pitch", -1.0), "sign:pitch"),
        "encoder of the extension reversed": Mistake(per_unit("extension", -1.0), "sign:extension"),
        "one force component reversed": Mistake(flip_rows(2), "sign:force_z"),
        "force of the hand for that on the hand": Mistake(flip_rows(0, 1, 2), f"sign:{FORCES}"),
        "counts per degree for a radian": Mistake(
            do_all(per_unit("yaw", 1 / DEGREES), per_unit("pitch", 1 / DEGREES)),
            "scale:yaw+pitch",
        ),
        "counts per millimetre for a metre": Mistake(
            per_unit("extension", 1e-3), "scale:extension"
        ),
        "a quarter of the counts (no quadrature)": Mistake(per_unit("yaw", 0.25), "scale:yaw"),
        "counts per radian left at 1": Mistake(per_unit("yaw", 1 / 21333.3333), "scale:yaw"),
        "encoder columns exchanged": Mistake(
            exchange_columns("enc_yaw", "enc_pitch"), "exchange:yaw+pitch"
        ),
        "force wires exchanged": Mistake(
            exchange_headers("force_x_v", "force_y_v"), "exchange:force_x+force_y"
        ),
        "force calibrated in kgf": Mistake(scale_all(1 / 9.81), f"scale:{FORCES}"),
        "force calibrated in grams": Mistake(scale_all(1000 / 9.81), f"scale:{FORCES}"),
        "gain of one amplifier ten times": Mistake(
            calibrate(lambda m: [m[0], m[1], [10.0 * v for v in m[2]]]), "scale:force_z"
        ),
        "calibration left at 1": Mistake(calibrate(identity), f"scale:{FORCES}"),
        "pitch counted from the vertical": Mistake(
            set_text(r"(\npitch = .*zero_counts = )(-?\d+)", r"\g<1>12008"), "zero:pitch"
        ),
        "extension counted from the centre of gravity": Mistake(
            set_text(r"(\nextension = .*zero_counts = )(-?\d+)", r"\g<1>18367"), "zero:extension"
        ),
        "brake commands negative": Mistake(
            do_all(*(scale_column(f"brake_{a}", -1.0) for a in ("yaw", "pitch", "extension"))),
            "sign:brake_yaw+brake_pitch+brake_extension",
        ),
        "clock in milliseconds for microseconds": Mistake(scale_column("time_us", 1e-3), "clock:"),
    },
    "joint": {
        "encoder reversed": Mistake(scale_column("q", -1.0), "sign:joint"),
        "current reversed": Mistake(scale_column("i", -1.0), "sign:current"),
        "degrees for radians": Mistake(scale_column("q", DEGREES), "scale:joint"),
        "revolutions for radians": Mistake(scale_column("q", 0.5 / math.pi), "scale:joint"),
        "radians for degrees": Mistake(
            set_text('unit = "rad", resolution = 5e-05', 'unit = "deg", resolution = 5e-05'),
            "scale:joint",
        ),
        "milliamperes for amperes": Mistake(scale_column("i", 1000.0), "scale:current"),
        "motor constant left at 1": Mistake(
            set_text("value = 10.0", "value = 1.0", "joint.toml"), "scale:current"
        ),
        "position and current exchanged": Mistake(
            exchange_columns("q", "i"), "exchange:joint+current"
        ),
        "clock in milliseconds for seconds": Mistake(scale_column("t", 1000.0), "clock:"),
    },
    "axis": {
        "encoder reversed": Mistake(scale_column("q", -1.0), "sign:carriage"),
        "force reversed": Mistake(flip_rows(0), "sign:force_motor"),
        "millimetres for metres": Mistake(scale_column("q", 1000.0), "scale:carriage"),
        "metres for millimetres": Mistake(
            set_text('unit = "m", resolution = 1e-07', 'unit = "mm", resolution = 1e-07'),
            "scale:carriage",
        ),
        "calibration left at 1": Mistake(scale_all(1 / 35.0), "scale:force_motor"),
        "force in millinewtons": Mistake(scale_all(1000.0), "scale:force_motor"),
        "position and force exchanged": Mistake(
            exchange_columns("q", "u"), "exchange:carriage+force_motor"
        ),
        "clock in milliseconds for seconds": Mistake(scale_column("t", 1000.0), "clock:"),
        "clock and rate in milliseconds": Mistake(
            do_all(
                scale_column("t", 1000.0),
                set_text("sample_rate_hz = 1000.0", "sample_rate_hz = 1.0"),
            ),
            "clock:",
        ),
    },
    "damper": {
        "encoder reversed": Mistake(scale_column("x", -1.0), "sign:piston"),
        "load cell reversed": Mistake(scale_column("f", -1.0), "sign:force_load_cell"),
        "millimetres for metres": Mistake(set_text('unit = "mm"', 'unit = "m"'), "scale:piston"),
        "kilonewtons for newtons": Mistake(scale_column("f", 1e-3), "scale:force_load_cell"),
        "milliamperes for amperes": Mistake(scale_column("i", 1000.0), "scale:current"),
        "force and current exchanged": Mistake(
            exchange_columns("f", "i"), "exchange:force_load_cell+current"
        ),
        "position and force exchanged": Mistake(
            exchange_columns("x", "f"), "exchange:piston+force_load_cell"
        ),
        "clock in milliseconds for seconds": Mistake(scale_column("t", 1000.0), "clock:"),
    },
    "arm": {
        "encoder of the elbow reversed": Mistake(
            scale_column(position("elbow"), -1.0), "sign:elbow"
        ),
        "drive of the shoulder reversed": Mistake(
            scale_column(effort("shoulder"), -1.0), "sign:torque_shoulder"
        ),
        "positions exchanged": Mistake(
            exchange_headers(position("shoulder"), position("elbow")), "exchange:shoulder+elbow"
        ),
        "drives exchanged": Mistake(
            exchange_headers(effort("shoulder"), effort("elbow")),
            "exchange:torque_shoulder+torque_elbow",
        ),
        "degrees for radians": Mistake(
            do_all(*(scale_column(position(joint), DEGREES) for joint in JOINTS)),
            f"scale:{'+'.join(JOINTS)}",
        ),
        "degrees for radians, one joint": Mistake(
            scale_column(position("elbow"), DEGREES), "scale:elbow"
        ),
        "torque of the motor for that of the joint": Mistake(
            scale_column(effort("elbow"), 0.01), "scale:torque_elbow"
        ),
        "shoulder counted from the vertical": Mistake(
            scale_column(position("shoulder"), 1.0, 0.5 * math.pi), "zero:shoulder"
        ),
        "clock in milliseconds for seconds": Mistake(
            scale_column("/joint_states/header/stamp", 1000.0), "clock:"
        ),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One session: a machine with one mistake, or sound with hidden effects."""

    machine: str
    mistake: str
    seed: int
    effects: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What was said of one session.

    Attributes:
        case: the session.
        verdict: "named", "tied" (named beside others that the trials cannot tell from it), "read"
            (ingest named it), "missed", or "nothing" of a sound session.
        beside: other mistakes named.
        said: the sentences; seconds: that ingest and filter took.
    """

    case: Case
    verdict: str
    beside: int
    said: str
    seconds: float

    def line(self) -> str:
        """One line of the log."""
        what = self.case.mistake or " + ".join(self.case.effects) or "sound"
        return f"{self.case.machine} {self.case.seed} {what}: {self.verdict} | {self.said}"


def run_case(case: Case) -> Outcome:
    """Record, spoil and judge one session."""
    mistake = MISTAKES[case.machine][case.mistake] if case.mistake else SOUND
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        folder = root / "session"
        strengths = dict.fromkeys(case.effects, 1.0)
        record_session(case.machine, folder, case.seed, strengths)
        mistake.spoil(folder)
        (root / "mistakes.toml").write_text(PIPELINE)
        begun = time.perf_counter()
        try:
            run = bampipe.run_session(
                folder, runs=root / "runs", pipeline=str(root / "mistakes.toml")
            )
        except bampipe.InputError as refusal:
            seconds = time.perf_counter() - begun
            verdict = "read" if case.mistake and "unit" in str(refusal) else "missed"
            return Outcome(case, verdict, 0, str(refusal).replace(name, ""), seconds)
        seconds = time.perf_counter() - begun
        setup = json.loads((run.root / "filter/setup.json").read_text(encoding="utf-8"))
        repairs = "; ".join(run.trials["repairs"])
    return judge(case, mistake.key, setup["mistakes"], repairs, seconds)


def judge(
    case: Case, key: str, found: Sequence[Mapping[str, Any]], repairs: str, seconds: float
) -> Outcome:
    """Hold what was named against what was done."""

    def key_of(one: Mapping[str, Any]) -> str:
        return f"{one['kind']}:{'+'.join(one['signals'])}"

    said = " / ".join(one["sentence"] for one in found)
    named = [key_of(one) for one in found]
    tied = [key_of(other) for one in found for other in one.get("alternatives", [])]
    if key in named and not any(one.get("alternatives") for one in found):
        verdict = "named"
    elif key in named or key in tied:
        verdict = "tied"
    elif key == "clock:" and "time stamps are in" in repairs:
        verdict, said = "read", repairs.partition(";")[0]
    else:
        verdict = "missed" if key else "nothing"
    right = key in named or verdict == "tied"
    return Outcome(case, verdict, len(found) - right, said, seconds)


def write_table(outcomes: Sequence[Outcome]) -> str:
    """Mistakes by machine and outcome, with their number if it is more than one, as Markdown."""
    lines = ["| machine | named | beside others alike | by ingest | missed |", "|-|-|-|-|-|"]
    spoilt = [o for o in outcomes if o.case.mistake]
    for machine in dict.fromkeys(o.case.machine for o in spoilt):
        cells = []
        for verdict in ("named", "tied", "read", "missed"):
            counts = Counter(
                o.case.mistake for o in spoilt if (o.case.machine, o.verdict) == (machine, verdict)
            )
            cells.append(", ".join(f"{m} ({n})" if n > 1 else m for m, n in counts.items()))
        lines.append(f"| {machine} | {' | '.join(cells)} |")
    if spoilt:
        right = sum(o.verdict != "missed" for o in spoilt)
        beside = sum(o.beside > 0 for o in spoilt)
        lines.append(
            f"\n{right} of {len(spoilt)} named ({right / len(spoilt):.1%}), in {beside} something"
            " else as well."
        )
    sound = [o for o in outcomes if not o.case.mistake]
    if sound:
        wrong = sum(o.beside > 0 or o.verdict != "nothing" for o in sound)
        lines.append(f"\n{wrong} of {len(sound)} sound sessions said to be mistaken.")
    return "\n".join(lines)


def hidden_in(machine: str) -> tuple[str, ...]:
    """Return the effects that a simulator can hide; those of the arm on one joint each."""
    if machine == "arm":
        single = [name for name in arm.EFFECTS if name != "friction_of_sum"]
        return (*(f"{name}:shoulder" for name in single), "friction_of_sum:shoulder-elbow")
    return (*MACHINES[machine].EFFECTS, *MACHINES[machine].UNKNOWN)


def main(arguments: Sequence[str]) -> None:
    """Run the cases asked for, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machine", nargs="*", default=list(MISTAKES), help=", ".join(MISTAKES))
    parser.add_argument("--only", nargs="*", default=[], help="names of mistakes")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--sound", action="store_true", help="sound sessions, each with an effect")
    parser.add_argument("--out", type=Path, help="add the outcomes as JSON, a line each")
    options = parser.parse_args(arguments)
    cases = []
    for machine in options.machine:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            if options.sound:
                cases += [Case(machine, "", seed, e) for e in ((), *zip(hidden_in(machine)))]
            else:
                names = options.only or list(MISTAKES[machine])
                cases += [Case(machine, name, seed) for name in names]
    outcomes = []
    for case in cases:
        outcomes.append(run_case(case))
        print(outcomes[-1].line(), flush=True)
        if options.out:
            with options.out.open("a", encoding="utf-8") as log:
                log.write(json.dumps(asdict(outcomes[-1])) + "\n")
    print(write_table(outcomes))


if __name__ == "__main__":
    main(sys.argv[1:])
