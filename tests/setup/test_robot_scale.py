"""The scale of a robot's drives is known by its bodies; how much friction there is, is a guess."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bampipe.data.device_file import complete_device
from bampipe.estimate.low_pass import Band
from bampipe.physics import Model, System, compile_model
from bampipe.physics.registry import device_from
from bampipe.setup.drawn_bodies import Comparison, JointMotion
from bampipe.setup.hypotheses import scale_correction
from bampipe.setup.plausibility import Plausibility, judge_setup
from bampipe.setup.robot_search import DRAWN_SAMPLES, DrawnSearch
from bampipe.setup.search import Finding, shorten
from bampipe.setup.turned_trials import find_turned_trials
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

RATE = 100.0
JOINTS = ("one", "two", "three", "four")
OFF = np.array([1.15, 0.9, 1.2, 0.85])
"""Of the drawn numbers, what the bodies truly have."""


Drawn = tuple[float, float, float]
DOWN: Drawn = (0.0, 0.0, -9.81)
SHARED = {
    "m1": {"turns": {"one": 1.0}}, "m2": {"turns": {"two": 1.0}}, "m3": {"turns": {"three": 45.0}},
    "m4": {"turns": {"three": 32.0, "four": 32.0}},
}  # fmt: skip
"""Motors of which the last one turns two joints, as those of a wrist do."""


@cache
def arm(gravity: Drawn = DOWN, is_shared: bool = False) -> System:
    joints = {
        name: {
            "kind": "revolute", "position": [0.0, 0.0, 0.3], "rotation": [1.3, 0.0, 0.4],
            "mass": 4.0 - k, "center": [0.05, -0.04, 0.15],
            "inertia": [0.03, 0.0, 0.0, 0.03, 0.0, 0.01], "effort": 80.0, "velocity": 2.2,
        } | ({"after": JOINTS[k - 1]} if k else {})
        for k, name in enumerate(JOINTS)
    }  # fmt: skip
    table = {"name": "arm", "robot": {"joints": joints, "gravity": gravity}}
    table["robot"] |= {"motors": SHARED} if is_shared else {}  # type: ignore[operator]
    return compile_model(Model(device_from(complete_device(table, None, ""))))  # type: ignore[arg-type]


def motions(
    factor: float, viscous: float, gravity: Drawn = DOWN, tool: float = 1.0, is_shared: bool = False
) -> list[Motion]:
    """Two trials whose torques read ``factor`` times too much.

    Under a gravity in the base's frame, m/s2, and with a last body ``tool`` times as heavy.
    """
    system = arm(gravity, is_shared)
    p = system.prior
    for i, item in enumerate(system.parameters):
        short, _, name = item.name.rpartition(".")
        if short.startswith(("mass", "first", "inertia")) and not item.fixed:
            p[i] *= OFF[JOINTS.index(name)] * (tool if name == JOINTS[-1] else 1.0)
        elif short in ("viscous", "coulomb"):
            p[i] = viscous if short == "viscous" else 4.0
    found = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 8.0, 1.0 / RATE)
        rate = 2.0 * np.pi * rng.uniform(0.1, 0.5, (3, 4))
        angle = rate[:, None] * t[:, None] + rng.uniform(0.0, 6.0, (3, 1, 4))
        size = np.array([0.7, 0.4, 0.2])[:, None, None]
        q = (size * np.sin(angle)).sum(axis=0)
        qd = (size * rate[:, None] * np.cos(angle)).sum(axis=0)
        qdd = -(size * rate[:, None] ** 2 * np.sin(angle)).sum(axis=0)
        none = np.zeros((len(t), 0)), np.zeros((len(t), len(system.inputs)))
        torque = system.required(q, qd, qdd, *none, p)
        torque += rng.normal(0.0, 0.1, torque.shape)
        one_each = np.vstack([np.zeros(4), np.eye(4)])
        still = np.zeros((5, 4))
        by_force = system.applied(still, still, still, np.zeros((5, 0)), one_each, p)[1:].T
        torque = factor * torque @ np.linalg.inv(by_force).T
        channels = dict(zip(system.inputs, torque.T, strict=True))
        found.append(Motion(f"t{seed}", t, q, qd, qdd, np.full_like(qd, 1e-4), channels))
    return found


def counted(motion: Motion, factors: np.ndarray, zeros: np.ndarray | float = 0.0) -> Motion:
    """The motion as encoders read it that count otherwise than drawn, (4,) each."""
    q = motion.q * factors + zeros
    return replace(motion, q=q, qd=motion.qd * factors, qdd=motion.qdd * factors)


FORCES = tuple(f"torque_{name}" for name in JOINTS)


def search_in(given: list[Motion], is_shared: bool = False) -> DrawnSearch:
    units = ("rad",) * 4 + ("N.m",) * 4
    eye, none = np.eye(8), np.zeros(8)
    system = arm(is_shared=is_shared)
    signals = Signals(JOINTS, system.inputs, (), (), units, units, eye, none, 0.0 * eye, none)
    folds = Folds.of_trials(["t0", "t1"], [], ["t0", "t1"])
    given = shorten(given, DRAWN_SAMPLES)
    return DrawnSearch(system, given, Band(RATE, (10.0,) * 4), folds, signals)


def find_mistakes(given: list[Motion]) -> tuple[Finding, ...]:
    return search_in(given).find_mistakes()


@pytest.mark.parametrize(("third", "named"), [(0.34, False), (0.18, True)])
def test_what_spoils_a_joint_that_was_right_is_no_mistake(third: float, named: bool) -> None:
    """A counterbalance that the device lacks made all drives of a measured arm look halved."""
    search = search_in([])
    before, after = (
        Plausibility(np.array(error), np.ones(4), arm().prior, np.full(len(arm().prior), objection))
        for error, objection in (((0.10, 0.55, 0.08, 0.21), 1.0), ((0.12, 0.32, third, 0.21), 0.5))
    )
    twice = scale_correction(search.signals, FORCES, 2.0, 0.0)
    search.judge = lambda chosen: after if chosen else before
    assert bool(search.confirm((twice,), ())) == named


def test_a_drive_that_one_trial_has_turned_is_named_with_it() -> None:
    given = [*motions(1.0, 2.0), *motions(1.0, 2.0)]
    names = [f"t{k}" for k in range(4)]
    signs = np.array([1.0, -1.0, 1.0, 1.0])
    channels = {n: s * given[2].channels[n] for n, s in zip(FORCES, signs, strict=True)}
    given[2] = replace(given[2], channels=channels)
    search, folds = search_in(given[:2]), Folds.of_trials(names, [], names)
    found = find_turned_trials(search.system, given, search.band, folds, search.signals)
    assert [(k, one.correction.signals) for k, one in found.items()] == [(2, (FORCES[1],))]
    assert found[2].after.error[1] < 0.2 * found[2].before.error[1]


def turned(factor: float, zero: float, joint: int, drive: float) -> list[Motion]:
    """Motions of which a joint, or its drive, is counted otherwise than drawn."""
    found, at, name = [], np.eye(len(JOINTS))[joint], FORCES[joint]
    for motion in motions(1.0, 2.0):
        channels = {**motion.channels, name: drive * motion.channels[name]}
        found.append(replace(counted(motion, factor**at, zero * at), channels=channels))
    return found


def test_a_drive_that_reads_nothing_explains_no_motion() -> None:
    search = search_in(turned(1.0, 0.0, 1, 0.0))
    held = judge_setup(search.system, search.motions, search.band, search.folds, 4)
    assert held is not None and (held.left > 0.5).tolist() == [False, True, False, False]


GEARS = np.array([1.1, 1.0, 1.0, 0.9])
Named = tuple[str, tuple[str, ...], object, float]
"""Kind, signals, factor and offset of a mistake."""
GIVEN: dict[str, tuple[list[Motion], list[Named]]] = {
    "sound": (motions(1.0, 2.0), []),
    "much friction": (motions(1.0, 9.0), []),
    # Bodies come out wrong in shape, more in what few motions show than their spread says.
    "reductions known badly": ([counted(m, GEARS) for m in motions(1.0, 9.0)], []),
    "another unit": (motions(4.0, 2.0), [("scale", FORCES, pytest.approx(0.25), 0.0)]),
    "drive reversed": (turned(1.0, 0.0, 1, -1.0), [("sign", ("torque_two",), -1.0, 0.0)]),
    "from the vertical": (
        turned(1.0, 0.5 * np.pi, 1, 1.0), [("zero", ("two",), 1.0, -0.5 * np.pi)]
    ),
    "encoder reversed": (turned(-1.0, 0.0, 2, 1.0), [("sign", ("three",), -1.0, 0.0)]),
    # A reduction is none of a list.
    "torque of the motor": (
        turned(1.0, 0.0, 1, 1.0 / 70.0),
        [("scale", ("torque_two",), pytest.approx(70.0, rel=0.25), 0.0)],
    ),
    "position of the motor": (
        turned(70.0, 0.0, 0, 1.0), [("scale", ("one",), pytest.approx(1.0 / 70.0, rel=0.03), 0.0)]
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", GIVEN)
def test_what_free_bodies_take_on_is_found_with_bodies_as_drawn(case: str) -> None:
    given, named = GIVEN[case]
    found = [finding.correction for finding in find_mistakes(given)]
    assert [(one.kind, one.signals, one.factor, one.offset) for one in found] == named


def test_two_joints_of_a_makers_zero_posture_are_found_together() -> None:
    """Setting one of them right alone leaves the other joints worse than before."""
    zeros = 0.5 * np.pi * np.array([0.0, 1.0, -1.0, 0.0])
    found = find_mistakes([counted(m, np.ones(4), zeros) for m in motions(1.0, 2.0)])
    zeros = {f.correction.signals[0]: f.correction.offset for f in found}
    assert zeros == {"two": -0.5 * np.pi, "three": 0.5 * np.pi}
    assert all(f.after.unexplained is None and f.after.worst_error < 0.15 for f in found)


@pytest.mark.parametrize(
    "gravity", [pytest.param((9.81, 0.0, 0.0), marks=pytest.mark.long), (0.0, 6.937, -6.937)]
)
def test_a_base_that_does_not_stand_is_found_with_the_joint_that_is_reversed(
    gravity: tuple[float, float, float],
) -> None:
    found = find_mistakes([counted(m, REVERSED) for m in motions(1.0, 2.0, gravity)])
    named = {f.correction.kind: f.correction.signals for f in found}
    assert named == {"gravity": (), "sign": ("two",)}
    (mounted,) = (f.correction.change.gravity for f in found if f.correction.kind == "gravity")
    assert mounted == pytest.approx(gravity, abs=1e-3)
    assert all(f.after.worst_error < 0.15 for f in found[-1:])


REVERSED = np.array([1.0, -1.0, 1.0, 1.0])


def test_rounding_errors_of_a_point_mass_on_its_axis_are_no_torque() -> None:
    """Such a body needs none: taken for one, they gave a unit that was wrong by 1e15."""
    robot, motion = arm().model.device.robot, motions(1.0, 2.0)[0]
    point = {"center": (0.0, 0.0, 0.15), "inertia": (0.0,) * 6}
    last = robot.joints[-1].model_copy(update=point)
    robot = robot.model_copy(update={"joints": (*robot.joints[:-1], last)})
    drives = np.column_stack([motion.channels[name] for name in FORCES])
    compared = Comparison(robot, (True,) * 4, [JointMotion(*motion.kinematics)], drives, np.ones(4))
    *others, of_last = compared.hold(compared.nominal)
    assert of_last.share == 0.0 and not of_last.is_sure
    assert all(drive.is_sure for drive in others)


def test_a_slide_that_weighs_upwards_while_friction_brakes_it_is_mounted_otherwise() -> None:
    """Its mass could be its drive's; fitted, the weight gave a negative one, and no word."""
    z = {"kind": "prismatic", "mass": 3.0, "effort": 80.0, "velocity": 1.0}
    table = {"name": "slide", "robot": {"joints": {"z": z}}}
    robot = device_from(complete_device(table, None, "")).robot
    t = np.arange(0.0, 8.0, 1.0 / RATE)[:, None]
    motion = JointMotion(0.1 * np.sin(t), 0.1 * np.cos(t), -0.1 * np.sin(t))
    drives = 3.0 * (motion.change - 9.81) + 2.0 * np.sign(motion.rate)
    compared = Comparison(robot, (False,), [motion], drives, np.ones(1), has_offset=False)
    tried = compared.nominal, compared.best_mounting(compared, 0.02)
    assert [compared.hold(m)[0].is_contradicted for m in tried] == [True, False]


@pytest.mark.parametrize(("tool", "factor"), [(1.0, None), (5.0, 5.0 * OFF[3])])
def test_a_heavy_tool_is_no_mistake_of_units(tool: float, factor: float | None) -> None:
    search = search_in(motions(1.0, 2.0, tool=tool))
    assert search.find_mistakes() == ()
    if factor is None:
        assert search.heavier is None
    else:
        assert search.heavier is not None and search.heavier.place == 3
        assert search.heavier.factor == pytest.approx(factor, rel=0.2)


@pytest.mark.parametrize(
    ("motor", "factor", "kind"),
    [
        (2, -1.0, "sign"),
        (3, 1000.0, "scale"),
        pytest.param(3, -1.0, "sign", marks=pytest.mark.long),
        pytest.param(2, 1.0 / 3.0, "scale", marks=pytest.mark.long),
    ],
)
def test_one_mistaken_drive_of_motors_that_turn_several_joints_is_found(
    motor: int, factor: float, kind: str
) -> None:
    given = motions(1.0, 2.0, is_shared=True)
    name = f"torque_m{motor + 1}"
    wrong = [replace(m, channels={**m.channels, name: factor * m.channels[name]}) for m in given]
    assert search_in(given, is_shared=True).find_mistakes() == ()
    (found,) = search_in(wrong, is_shared=True).find_mistakes()
    assert (found.correction.kind, found.correction.signals) == (kind, (name,))
    assert found.correction.factor == pytest.approx(1.0 / factor, rel=0.25)
