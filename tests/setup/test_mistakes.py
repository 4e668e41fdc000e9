"""Mistakes in session files of independent simulators are named; sound ones are left alone."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import independent
import mistakes
import numpy as np
import pandas as pd
import pytest
from independent.sensors import Conditions
from independent_runs import STAGES, run_short
from mistakes import MISTAKES, Case, run_case, set_text

import bampipe
from bampipe.phrases.results import list_setup_faults
from bampipe.results.setup import SetupResult

NAMED = [
    ("joint", "degrees for radians"),
    pytest.param("joint", "motor constant left at 1", marks=pytest.mark.long),
    ("axis", "clock and rate in milliseconds"),
    ("damper", "force and current exchanged"),
    ("bam", "encoder of the pitch reversed"),
]


@pytest.mark.parametrize(("machine", "mistake"), NAMED)
def test_a_mistake_is_named_as_what_it_is(machine: str, mistake: str) -> None:
    """`benchmarks/mistakes.py` makes every mistake on every machine."""
    found = run_case(Case(machine, mistake, 31))
    assert found.verdict in ("named", "tied") and found.beside == 0, found.line()


def test_both_are_given_where_one_axis_cannot_tell_encoder_from_force() -> None:
    found = run_case(Case("joint", "encoder reversed", 31))
    assert found.verdict == "tied" and found.beside == 0, found.line()


def test_what_ingest_sees_is_said_by_ingest() -> None:
    """Of time, `test_bad_sessions` says it."""
    assert run_case(Case("axis", "metres for millimetres", 31)).verdict == "read"


@pytest.mark.parametrize(
    ("machine", "effect"),
    [
        ("joint", "load_dependent_friction:joint"),
        pytest.param("axis", "flexible_load:carriage", marks=pytest.mark.long),
        # A third of the torque about the pitch is left: other set-ups are tried, and none is right.
        ("bam", "gravity_compensator_lag"),
    ],
)
def test_a_missing_effect_is_no_mistake(machine: str, effect: str) -> None:
    found = run_case(Case(machine, "", 31, (effect,)))
    assert found.verdict == "nothing" and found.beside == 0, found.line()


def test_what_a_slow_trial_alone_does_not_determine_is_no_mistake(tmp_path: Path) -> None:
    """Two slow trials of a lagging motor: from either, the other is extrapolated by 14 times."""
    slow = Conditions(creep=True, trials=2, seconds=8.0, pace=0.4)
    independent.record("joint", tmp_path / "session", 5102, {"actuator_lag:current": 1.0}, slow)
    found = inspect_session(tmp_path)
    assert found.mistakes == ()
    assert found.axes["joint"].state == "sound"
    assert found.axes["joint"].error_percent < 10.0


def inspected(root: Path, *changes: Callable[[Path], None], machine: str = "joint") -> SetupResult:
    """The set-up of a machine's session, changed by ``changes`` before it is read."""
    independent.record(machine, root / "session", 31, {}, mistakes.SHORT[machine])
    for change in changes:
        change(root / "session")
    return inspect_session(root)


def inspect_session(root: Path) -> SetupResult:
    """What `filter` says of the set-up of the session in a folder."""
    run = run_short(root / "session", root, ("ingest", "filter"))
    return SetupResult.read(run.root / "filter/setup.json")


def stop(folder: Path) -> None:
    for file in folder.glob("trials/*.csv"):
        frame = pd.read_csv(file)
        frame.loc[frame["t"] > 0.6, "q"] = frame["q"].iloc[55]
        frame.to_csv(file, index=False)


AMPERES = (
    set_text("value = 10.0", "value = 1.0", "joint.toml"),
    set_text(r"prior = (\d+)\.0, sd = (\d+)\.0", r"prior = \1e-1, sd = \2e-1", "joint.toml"),
)
WEIGHTLESS = (
    set_text(r'potential = ".*"', 'potential = "0"', "joint.toml"),
    set_text(r"moment\w* = .*\n", "", "joint.toml"),
)


@pytest.mark.parametrize(
    ("machine", "changes", "state", "said"),
    [
        # Torques in amperes: nothing contradicts priors that fit, and a source that owns up to it.
        ("joint", AMPERES, "sound", r"torque_per_ampere .* is 1 N.m/A, source 'data sheet'"),
        # Its current follows position, and is none.
        ("joint", WEIGHTLESS, "unexplained", "a torque that follows the position of joint"),
        ("axis", (mistakes.hold_even,), "unexplained", "carriage: the bare device explains"),
        ("joint", (stop,), "hardly_moves", "joint hardly moves: it stands still in"),
    ],
    ids=["scale of one", "no weight", "hardly follows", "hardly moves"],
)
def test_a_doubt_is_said_where_no_mistake_is_found(
    machine: str, changes: Sequence[Callable[[Path], None]], state: str, said: str, tmp_path: Path
) -> None:
    found = inspected(tmp_path, *changes, machine=machine)
    (axis,), (line,) = found.axes.values(), list_setup_faults(found)
    assert found.mistakes == () and axis.state == state and re.match(said, line)
    assert [*found.unexplained.values()] == [line] * (state == "unexplained")


def test_an_axis_that_moves_beyond_reason_is_said(tmp_path: Path) -> None:
    found = inspected(tmp_path, mistakes.scale_column("q", 180.0 / np.pi))
    doubt = r"joint moves through .* see whether its position is in degrees"
    assert any(re.match(doubt, line) for line in list_setup_faults(found))


def test_a_device_without_a_scale_is_refused(tmp_path: Path) -> None:
    gain = '[parameters]\ngain = { unit = "1", prior = 1.0, sd = 1.0 }'
    free = set_text(r"\[parameters\]", gain, "joint.toml")
    used = set_text(r"torque_per_ampere\*current", "gain*torque_per_ampere*current", "joint.toml")
    with pytest.raises(bampipe.InputError, match="the scale of its equation is undetermined"):
        inspected(tmp_path, free, used)


def test_evidence_is_measured_and_no_effect_is_looked_for_under_a_mistake(tmp_path: Path) -> None:
    independent.record("joint", tmp_path / "session", 31, {}, mistakes.SHORT["joint"])
    MISTAKES["joint"]["encoder reversed"].spoil(tmp_path / "session")
    reversed_joint = run_short(tmp_path / "session", tmp_path, (*STAGES, "report"))
    (mistake,) = SetupResult.read(reversed_joint.root / "filter/setup.json").mistakes
    assert mistake.axes == ("joint",)
    assert mistake.error_before["joint"] > 50.0
    assert mistake.error_after["joint"] < 3.0
    assert "of the applied force" in mistake.evidence
    q = reversed_joint.kinematics["q_joint"]
    assert np.ptp(q) > 0.5
    with pytest.raises(bampipe.InputError, match="the set-up is wrong: "):
        bampipe.diagnose(reversed_joint, replicates=4, jobs=1)
    page = Path(reversed_joint.root / "report/report.html").read_text(encoding="utf-8")
    first = page.partition('class="verdict">')[2]
    said = "Set-up: the encoder of joint counts", "Set-up: current has the wrong"
    assert first.startswith(said)
    assert "leaves something unexplained" not in page


@pytest.mark.parametrize(
    ("machine", "column", "factors", "named"),
    [
        pytest.param("joint", "q", (1, -1, 1, 1), "t02: joint", marks=pytest.mark.long),
        pytest.param(
            "axis", "u", (1, -1, -1, 1), "t02 and t03: carriage or force_motor",
            marks=pytest.mark.long,
        ),
        # Each of another damper.
        ("damper", "f", (1, -2, -3, 4), "t02 and t03: piston or force_load_cell"),
        pytest.param(
            "bam", "enc_pitch", (1, -1, 1, -1, 1), "t02_free and t04_free: pitch has",
            marks=pytest.mark.long,
        ),
    ],
)  # fmt: skip
def test_trials_with_a_sign_of_their_own_are_named_and_taken_in(
    machine: str, column: str, factors: Sequence[float], named: str, tmp_path: Path
) -> None:
    turn = mistakes.scale_trials(column, factors)
    (mistake,) = inspected(tmp_path, turn, machine=machine).mistakes
    assert mistake.sentence.startswith(named)
    signals = json.loads(re.findall(r"negated = (\[.*?\])", mistake.sentence)[0])
    entries = [
        set_text(f'(file = "trials/t0{n}\\w*.csv")', rf"\1\nnegated = {json.dumps(signals)}")
        for n, factor in enumerate(factors, 1)
        if factor < 0
    ]
    assert inspected(tmp_path / "taken", turn, *entries, machine=machine).mistakes == ()


def test_a_gear_that_was_left_out_is_found_whatever_its_reduction(tmp_path: Path) -> None:
    """The weight of the joint goes with the sine of its angle: 70 is none of a usual gain."""
    (mistake,) = inspected(tmp_path, mistakes.scale_column("q", 70.0)).mistakes
    assert (mistake.kind, mistake.signals) == ("scale", ("joint",))
    assert mistake.factor == pytest.approx(1.0 / 70.0, rel=0.03)
