"""Effects on machines other than the BAM: motors, channels, dry friction that a device commands."""

import numpy as np
import pytest
from motions import RATE, of_mechanism, residual, smooth_motion, with_values
from motions import typical_parameters as typical
from small_arm import ARM

from bampipe.estimate.simulation import Arm, make_plant, simulate
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.effect import unit_of


@pytest.mark.parametrize(("word", "sign"), [("sum", 1.0), ("difference", -1.0)])
def test_what_turns_with_two_joints_acts_on_both(word, sign):
    """A drum on the sum (difference) of two joints: power and energy are those of its own turn."""
    arm = registry.device_from(ARM)
    names = [f"friction_of_{word}:one-two", f"inertia_of_{word}:one-two"]
    bare, full = compile_model(Model(arm)), compile_model(Model(arm, names))
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 20, 3))
    z, u = np.zeros((20, 0)), np.zeros((20, 3))
    p = np.append(bare.prior, [0.3, 0.7, 0.2])  # viscous, Coulomb, inertia
    force = full.required(q, qd, qdd, z, u, p) - bare.required(q, qd, qdd, z, u, bare.prior)
    turn, change = qd[:, 1] + sign * qd[:, 0], qdd[:, 1] + sign * qdd[:, 0]
    drum = 0.3 * turn + 0.7 * np.sign(turn) + 0.2 * change
    np.testing.assert_allclose(force[:, 1], drum, atol=1e-3)
    np.testing.assert_allclose(force[:, 0], sign * drum, atol=1e-3)
    np.testing.assert_allclose(force[:, 2], 0.0, atol=1e-12)


def test_friction_by_pose_takes_every_two_axes_from_the_middle_of_the_other():
    effect = registry.effect("friction_by_pose")
    assert effect.targets(registry.device("bam")) == (
        "yaw-pitch", "yaw-extension", "pitch-yaw", "pitch-extension", "extension-yaw",
        "extension-pitch",
    )  # fmt: skip
    pairs = effect.targets(registry.device_from(ARM))
    assert pairs == ("one-two", "two-one", "two-rail", "rail-two")
    system = compile_model(Model(registry.device("bam"), ["friction_by_pose:yaw-extension"]))
    own = system.model.effects[0].parameters
    assert [p.unit for p in own] == ["N.m/m", "N.m.s/rad/m"]
    values = np.array([x.prior for x in system.parameters])
    values[-2:] = 1.5, 0.7
    q, qd = np.array([[0.1, 0.2, 1.3]]), np.array([[0.5, 0.0, 0.0]])
    at = q, qd, 0 * q, np.zeros((1, 0)), np.zeros((1, len(system.inputs)))
    added = system.contribution(*at, values)
    # The range of the extension is 0.6 to 1.6 m.
    np.testing.assert_allclose(added, [[-(1.5 + 0.7 * 0.5) * 0.2, 0.0, 0.0]], rtol=1e-9)


def test_motor_effects_are_offered_to_motors_only():
    motors = (
        "torque_ripple", "actuator_lag", "actuator_delay", "drive_sag", "flexible_load",
        "loose_load", "loose_drive", "gear_loss", "cable_torque",
    )  # fmt: skip
    for name in motors:
        assert registry.effect(name).targets(registry.device("slider"))
        assert not registry.effect(name).targets(registry.device("bam"))
        assert not registry.effect(name).targets(registry.device("magnetic_damper"))


def _geared_joint(potential: str):
    """A joint of 2 kg.m2 whose drive gives N.m."""
    friction = {"prior": 1.0, "sd": 1.0}
    return registry.device_from(
        {
            "name": "geared_joint",
            "coordinates": {"joint": {"kind": "rotary", "sign_width": 1e-9}},
            "energy": {"kinetic": "inertia*ddt(joint)**2/2", "potential": potential},
            "inputs": {"force": ["torque"], "force_unit": "N.m", "drive": True},
            "applied": {"joint": "torque"},
            "friction": {
                "joint": {
                    "viscous": {"unit": "N.m.s/rad", **friction},
                    "coulomb": {"unit": "N.m", **friction},
                }
            },
            "parameters": {"inertia": {"unit": "kg.m2", "prior": 2.0, "sd": 1.0}},
        }
    )


@pytest.mark.parametrize("stiffness", [0.0, 4.0])
def test_a_gear_loses_of_the_load_behind_it_without_the_rotor(stiffness):
    """Closed form: the drive gives what the motion takes, and the loss by what crosses the gear."""
    names = ["gear_loss:joint", *(["return_spring:joint"] if stiffness else [])]
    system = compile_model(Model(_geared_joint("-9*cos(joint)"), names))
    q, qd, qdd, _, t = smooth_motion(system)
    behind, share, pull = 0.45, 0.12, 9.0 * np.sin(q) + stiffness * q
    load = pull + behind * 2.0 * qdd
    torque = 2.0 * qdd + pull + qd + np.sign(qd) + share * np.abs(load) * np.sign(qd)
    u = np.zeros((len(t), len(system.inputs)))
    u[:, [system.inputs.index("torque")]] = torque
    values = {"gear_loss.joint.share": share, "gear_loss.joint.behind": behind}
    values |= {"return_spring.joint.stiffness": stiffness} if stiffness else {}
    p = with_values(system, values)
    moving = np.abs(qd[:, 0]) > 1e-6
    left = residual(system, p, (q, qd, qdd, u, t))[moving]
    assert np.abs(left).max() < 1e-4 * np.abs(torque).max()


@pytest.mark.parametrize(
    ("potential", "held"), [("-9*cos(joint)", False), ("0", True), ("9", True)]
)
def test_the_rotors_part_is_open_only_where_a_weight_or_a_spring_shows_it(potential, held):
    share, behind = Model(_geared_joint(potential), ["gear_loss:joint"]).effects[0].parameters
    assert (share.fixed, behind.fixed, behind.prior) == (False, held, 1.0)
    beside = Model(_geared_joint(potential), ["gear_loss:joint", "return_spring:joint"]).effects[0]
    assert not beside.parameters[1].fixed
    # The BAM's weight is in terms of definitions.
    assert registry.device("bam").has_weight("pitch")
    assert not registry.device("bam").has_weight("yaw")


def test_hysteresis_takes_all_dry_friction_of_a_device_that_adds_some():
    effect = registry.effect("hysteresis")
    assert effect.targets(registry.device("magnetic_damper")) == ("piston",)
    assert effect.targets(registry.device("slider")) == ()
    device = registry.device("magnetic_damper")
    system = compile_model(Model(device, ["hysteresis:piston"]))
    values = {"coulomb.piston": 40.0, "coulomb_gain": 200.0, "hysteresis.piston.share": 1.0}
    p = with_values(system, values)
    u = np.array([[{"current": 1.5}.get(name, 0.0) for name in system.inputs]])
    one = np.array([[0.1]])
    gone = [system.required(0 * one, one, 0 * one, np.array([[z]]), u, p)[0, 0] for z in (0.0, 1.0)]
    assert gone[1] - gone[0] == pytest.approx(40.0 + 1.5 * 200.0, rel=1e-6)


def test_all_dry_friction_of_an_axis_comes_up_gradually():
    names = [f"{name}:carriage" for name in ("asymmetric_coulomb", "gradual_friction", "stribeck")]
    system = compile_model(Model(registry.device("slider"), names))
    # Coulomb 4 N, 1.5 N more forwards, Stribeck 2 N up to 0.05 m/s; all of it over 0.02 m/s.
    p = np.array([0.0, 4.0, 1.0, 0.0, 1.5, 0.0, 1.0, 0.02, 2.0, 0.05])
    qd = np.linspace(-0.2, 0.2, 40)[:, None]
    empty = np.zeros((40, 0)), np.zeros((40, len(system.inputs)))
    rising = np.tanh(qd / 0.02)
    expected = (4.0 + 2.0 * np.exp(-((qd / 0.05) ** 2))) * rising + 1.5 * np.abs(rising)
    assert system.required(0 * qd, qd, 0 * qd, *empty, p) == pytest.approx(expected, abs=1e-9)


def test_behind_play_the_arm_moves_apart_from_the_drive_that_its_encoder_sees():
    bam = registry.device("bam")
    system, bare = (compile_model(Model(bam, e)) for e in (["backlash:pitch"], []))
    own = {"share": 1.0, "gap": 0.02, "drive_inertia": 0.4, "frequency": 50.0, "damping": 0.8}
    p = with_values(system, {f"backlash.pitch.{name}": value for name, value in own.items()})
    q, qd, rate = np.array([0.3, 0.2, 1.0]), np.array([0.4, 0.5, 0.1]), 0.7

    def derivative(model, x, p):
        dx = np.zeros(len(x))
        u = np.array([8.0 * (name == "force_y") for name in model.inputs])
        model.derivative(x, u, p, np.zeros(len(model.noise)), dx)
        return dx

    for lead in (0.004, 0.013):
        arm = derivative(
            bare, np.array([q[0], q[1] + lead, q[2], qd[0], rate, qd[2]]), p[: len(bare.parameters)]
        )
        behind = bare.mass_matrix(q[None], p)[0, 1, 1] - own["drive_inertia"]
        pressed = behind * (50.0**2 * (lead - 0.01) + 2 * 0.8 * 50.0 * (rate - qd[1]))
        friction = p[system.index("viscous.pitch")] * qd[1] + p[system.index("coulomb.pitch")]
        found = derivative(system, np.concatenate([q, qd, [q[1] + lead, rate, q[1], qd[1]]]), p)
        # Only the contact and its own friction accelerate what the encoder sees.
        carried = [(pressed * (lead > 0.01) - friction) / own["drive_inertia"], rate]
        assert found[[4, 6]] == pytest.approx(carried, rel=1e-2)
        # The extension feels gravity and centrifugal force where the arm is.
        assert found[5] == pytest.approx(arm[5], rel=1e-6)


@pytest.mark.parametrize("late", ["force_delay", "channel_lag:supply"])
def test_wind_up_goes_with_a_force_that_is_late(late):
    """Its offset is differentiated, which neither a state nor a last derivative allows."""
    effects = (late, "transmission_compliance:joint")
    system = compile_model(Model(registry.device("servo_pendulum"), effects))
    q, qd, qdd, u, t = smooth_motion(system)
    p = typical(system, 1.0)
    true = of_mechanism(system, q, qd, qdd, u, p, t)
    z = system.memory(*true, u, p, t)
    assert np.isfinite(system.residual(*true, z, u, p)).all()
    assert np.abs(true[0] - q).max() > 0.0


@pytest.mark.parametrize(
    ("unit", "own", "result"),
    [("input", "A", "A"), ("1/input", "A", "1/A"), ("input/s", "", "1/s"),
     ("1/input", "m/s", "s/m"),
     ("input/s", "N", "N/s"), ("N.m", "A", "N.m"), ("", "A", "")],
)  # fmt: skip
def test_units_follow_the_channel(unit, own, result):
    content = dict(registry.device("slider").declaration)
    content["inputs"] = {**content["inputs"], "force_unit": own}
    device = registry.device_from(content)
    assert unit_of(unit, registry.effect("force_bias"), ("motor",), device) == result


def test_a_flexible_load_is_rigid_below_its_frequency_and_left_behind_above_it():
    device = registry.device("slider")
    system = compile_model(Model(device, ["flexible_load:carriage"]))
    p = {x.name: 0.0 for x in system.parameters} | {"mass": 70.0}
    own = "flexible_load.carriage."
    p |= {own + "inertia": 25.0, own + "frequency": 60.0, own + "damping": 0.05}
    values = np.array([p[x.name] for x in system.parameters])
    t = np.arange(0.0, 20.0, 1e-3)
    for w in (6.0, 30.0, 150.0):
        q, qd, qdd = (1e-3 * w**k * np.sin(w * t + k * np.pi / 2)[:, None] for k in range(3))
        u = np.zeros((t.size, len(system.inputs)))
        z = system.memory(q, qd, qdd, u, values, t)
        assert z[0] == pytest.approx([0.0, qd[0, 0]])  # it starts with what carries it
        needed = system.required(q, qd, qdd, z, u, values)[:, 0]
        settled = t > 10.0
        mass = needed[settled] @ qdd[settled, 0] / (qdd[settled, 0] @ qdd[settled, 0])
        # Of a mass on a spring and dashpot shaken at its foot: x_load / x_foot.
        spring = 60.0**2 + 2j * 0.05 * 60.0 * w
        ratio = spring / (spring - w**2)
        assert mass == pytest.approx(70.0 + 25.0 * ratio.real, rel=2e-3)


GAP, MASS, DRIVE, PUSH = 2e-3, 70.0, 25.0, 50.0


@pytest.mark.parametrize("effect", ["flexible_load", "loose_load", "loose_drive"])
def test_friction_behind_the_encoder_is_part_of_that_of_the_axis(effect):
    """At one steady speed the axis has the same friction wherever it acts."""
    system = compile_model(Model(registry.device("slider"), [f"{effect}:carriage"]))
    own = f"{effect}.carriage."
    behind = {own + "coulomb_behind": 0.4, own + "viscous_behind": 2.0, own + "frequency": 60.0}
    behind |= {own + "share": 1.0, own + "inertia": 25.0, "mass": MASS}
    names = {item.name for item in system.parameters}
    values = with_values(system, {k: v for k, v in behind.items() if k in names})
    t = np.arange(0.0, 3.0, 1e-3)[:, None]
    q, qd, qdd = 0.2 * t, 0.2 + 0.0 * t, 0.0 * t
    u = np.zeros((t.size, len(system.inputs)))
    viscous, coulomb, offset = (
        values[system.index(name)] for name in ("viscous.carriage", "coulomb.carriage", "offset")
    )
    u[:, system.inputs.index("force_motor")] = 0.2 * viscous + coulomb + offset
    z = system.memory(q, qd, qdd, u, values, t[:, 0])
    left = system.residual(q, qd, qdd, z, u, values)[:, 0]
    assert np.abs(left[-1]) < 1e-2


@pytest.mark.parametrize("effect", ["loose_load", "loose_drive"])
def test_what_is_loose_flies_free_for_as_long_as_it_crosses_half_the_gap(effect):
    system = compile_model(Model(registry.device("slider"), [f"{effect}:carriage"]))
    p = dict.fromkeys(("viscous.carriage", "coulomb.carriage", "offset"), 0.0) | {"mass": MASS}
    own = {"share": 1.0, "gap": GAP, "drive_inertia": DRIVE, "damping": 1.0}
    values = with_values(system, p | {f"{effect}.carriage.{n}": v for n, v in own.items()})
    t = np.arange(0.0, 1.0, 1e-3)[:, None]
    # The motor leaves its load behind; or what is held, which its force reaches when it arrives.
    moved = PUSH / DRIVE if effect == "loose_load" else 0.0
    q, qd, qdd = 0.5 * moved * t**2, moved * t, moved + 0.0 * t
    u = np.zeros((t.size, len(system.inputs)))
    u[:, system.inputs.index("force_motor")] = PUSH
    z = system.memory(q, qd, qdd, u, values, t[:, 0])
    left = system.residual(q, qd, qdd, z, u, values)[:, 0]
    arrives = np.sqrt(GAP / (PUSH / DRIVE))
    # Positions are linear between samples, which the simulated side forgets within 20 ms.
    flies = (t[:, 0] > 0.02) & (t[:, 0] < arrives - 1e-3)
    assert flies.sum() > 9
    np.testing.assert_allclose(left[flies], 0.0, atol=1e-3)
    assert abs(left[round(1e3 * arrives) + 1]) > PUSH
    np.testing.assert_allclose(left[-1], PUSH - MASS * moved, rtol=1e-2)


def test_an_arm_leads_the_motor_that_moves_the_axis_through_play():
    # The play of one axis appears in the equations of all, the hand's force in its friction, too.
    for i, name in enumerate(("yaw", "pitch", "extension")):
        effects = [f"backlash:{name}", f"load_dependent_friction:{name}"]
        through = compile_model(Model(registry.device("bam"), effects)).moved_first
        assert through.tolist() == [[6, 7] if k == i else [k, 3 + k] for k in range(3)]
    device = registry.device("slider")
    assert compile_model(Model(device, ["loose_load:carriage"])).moved_first.tolist() == [[0, 1]]
    system = compile_model(Model(device, ["loose_drive:carriage"]))
    own = ["loose_drive.carriage.place", "loose_drive.carriage.rate"]
    assert [system.states[i] for i in system.moved_first[0]] == own
    p, t = typical(system), np.arange(0.0, 3.0, 2e-3)
    wanted, rate = 0.05 * (1.0 - np.cos(2.0 * t)), 0.1 * np.sin(2.0 * t)
    u = np.zeros((t.size, len(system.inputs)))
    start = np.concatenate([[0.0, 0.0], system.initial_memory(np.zeros(1), np.zeros(1), u[0], p)])
    force = [system.inputs.index("force_motor")]
    arm = Arm(wanted[:, None], rate[:, None], force, moved_first=system.moved_first)
    plant = make_plant(p, len(system.noise), system.sign_widths)
    x, _ = simulate(system.derivative, plant, start, u, 2e-3, arm=arm)
    gap = p[system.index("loose_drive.carriage.gap")]
    behind = x[:, 2] - x[:, 0]
    # The motor drags the carriage along from the ends of the gap, pressed as far as friction takes.
    assert np.abs(behind).max() < 0.5 * gap + 1e-3
    assert np.ptp(behind) > 0.9 * gap
    assert np.abs(x[:, 2] - wanted).max() < 0.02


def delivered(current: np.ndarray, lag: float) -> np.ndarray:
    """The coil's current along a log of the command, (T,), of `channel_lag`."""
    system = compile_model(Model(registry.device("magnetic_damper"), ("channel_lag:current",)))
    u = np.zeros((len(current), len(system.inputs)))
    u[:, system.inputs.index("current")] = current
    still = np.zeros((len(current), 1))
    p = with_values(system, {"channel_lag.current.time_constant": lag})
    return system.memory(still, still, still, u, p, np.arange(len(current)) / RATE)[:, 0]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_switched_command_holds_until_the_sample_that_shows_it(noise: float) -> None:
    """Within the interval before it is still the old one; a straight line would be half early."""
    levels = np.repeat([0.5, 2.0, 0.2, 1.1], 100)
    lag, decay = 0.03, np.exp(-1.0 / RATE / 0.03)
    exact, z = [], levels[0]
    for level in levels:
        exact.append(z)
        z = level + (z - level) * decay
    read = levels + noise * np.random.default_rng(1).standard_normal(levels.size)
    # The effect's time constant never quite vanishes: 0.1 % longer than stated here.
    np.testing.assert_allclose(delivered(read, lag), exact, rtol=0.01, atol=1e-3 + 2.0 * noise)
    before = np.flatnonzero(np.diff(levels)) + 1
    np.testing.assert_allclose(
        delivered(read, lag)[before], np.array(exact)[before], atol=3e-3 + 2.0 * noise
    )


def test_a_quantised_or_smooth_command_is_not_switched() -> None:
    """A lagged slow sine is the sine's response, in steps of its converter or without them."""
    t = np.arange(2000) / RATE
    w, lag = 2.0 * np.pi, 0.03
    sine = 1.0 + np.sin(w * t)
    response = 1.0 + (np.sin(w * t) - w * lag * np.cos(w * t)) / (1.0 + (w * lag) ** 2)
    for read in (sine, np.round(sine / 0.01) * 0.01):
        np.testing.assert_allclose(delivered(read, lag)[500:], response[500:], atol=5e-3)


@pytest.mark.parametrize("symmetry", [0.5, 1.0])
@pytest.mark.parametrize("distance", [1e-6, 2e-5, 1e-3])
def test_a_hysteresis_over_next_to_nothing_stays_within_its_bounds(distance, symmetry):
    """It is passed many times between two samples; at its end it is the sign of the velocity."""
    system = compile_model(Model(registry.device("magnetic_damper"), ["hysteresis:piston"]))
    shapes = {"hysteresis.piston.distance": distance, "hysteresis.piston.symmetry": symmetry}
    p = with_values(system, shapes)
    t = np.arange(0.0, 1.0, 1e-3)
    x, v = 1e-2 * np.sin(31.4 * t)[:, None], 0.314 * np.cos(31.4 * t)[:, None]
    u = np.zeros((len(t), len(system.inputs)))
    z = system.memory(x, v, np.gradient(v, t, axis=0), u, p, t)[:, 0]
    assert np.abs(z).max() <= 1.0 + 1e-9
    settled = (np.abs(v[:, 0]) > 0.25) & (t > 0.1)
    tolerance = 0.06 if distance > 1e-4 else 0.01
    np.testing.assert_allclose(z[settled], np.sign(v[settled, 0]), atol=tolerance)


def coarse_beside_fine(
    effect: str, shapes: dict[str, float], hz: float, size: float, step: float, every: int
) -> tuple[np.ndarray, np.ndarray]:
    """The state of an effect along a sine, from every so many samples and from all of them."""
    system = compile_model(Model(registry.device("magnetic_damper"), [effect]))
    prefix = effect.replace(":", ".")
    p = with_values(system, {f"{prefix}.{name}": value for name, value in shapes.items()})
    t, w = np.arange(0.0, 1.0, step), 2.0 * np.pi * hz
    u = np.zeros((len(t), len(system.inputs)))
    motion = size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t)
    columns = [x[:, None] for x in motion]
    some = slice(None, None, every)
    found = system.memory(*(x[some] for x in columns), u[some], p, t[some])
    return found, system.memory(*columns, u, p, t)[some]


@pytest.mark.parametrize("effect", ["hysteresis:piston", "presliding:piston"])
def test_a_state_follows_a_motion_of_eight_samples_a_period(effect):
    """A straight line between two rates takes a twentieth off the distance between them."""
    found, exact = coarse_beside_fine(effect, {"distance": 2e-3}, 62.5, 5e-4, 5e-5, 40)
    np.testing.assert_allclose(found, exact, atol=5e-3 * np.ptp(exact))


@pytest.mark.parametrize("symmetry", [0.5, 0.75])
def test_a_hysteresis_passed_sixty_times_between_two_samples_is_followed(symmetry):
    shapes = {"distance": 1e-5, "symmetry": symmetry}
    found, exact = coarse_beside_fine("hysteresis:piston", shapes, 20.0, 2.4e-3, 1e-5, 200)
    assert np.std(found - exact) < 2e-3
