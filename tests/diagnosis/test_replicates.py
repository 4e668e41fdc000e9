"""Replicates of a fitted model: what they need, what they share, and the bias that they show."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from independent_runs import record_trials

from bampipe.diagnosis.session import system_of
from bampipe.physics import Model, compile_model
from bampipe.trials import replicates
from bampipe.trials.kept import KeptItems
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.replicates import SimulatedTrials, make_replicate
from bampipe.trials.residuals import ModelOnTrial, problem_of


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[MeasuredTrials, Linearisation]:
    root = tmp_path_factory.mktemp("joint")
    trials, spec, _ = record_trials(root, "joint", 21, trials=12, seconds=5.0)
    # Every other trial: those between are moves with rests, whose errors are larger.
    trials = trials.subset(range(0, 12, 2))
    system = system_of(spec)
    return trials, linearise_fit(system, trials.motions, trials.band, system.prior, trials.folds)


def test_a_replicate_for_one_model_has_the_same_inputs(fitted) -> None:
    trials, linearisation = fitted
    system = linearisation.system
    logged = {name: trials.motions[0].channels[name] for name in system.inputs}
    motion = replace(trials.motions[0], channels=logged)
    simulated = SimulatedTrials(system, linearisation.p, [motion], trials.sensors.rate_hz)
    rngs, course = [np.random.default_rng(3) for _ in range(2)], simulated.courses[0]
    own = make_replicate(simulated, 0, trials.sensors, trials.kinematics, rngs[0])
    recording = replicates.read_by_sensors(system, motion, *course, trials.sensors, rngs[1])
    every = trials.kinematics.observe(recording, system.model.device.forces)
    np.testing.assert_array_equal(every.inputs(system.inputs), own.inputs(system.inputs))
    np.testing.assert_array_equal(
        *(m.with_input_timing(1e-3).inputs(system.inputs) for m in (every, own))
    )
    assert len(own.channels) < len(every.channels)


def test_replicates_differ_by_noise_alone_and_share_what_was_simulated(
    fitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials, linearisation = fitted
    simulated: list[str] = []

    def counted(system: Any, p: Any, motion: Any, rate_hz: float) -> replicates.Course:
        simulated.append(motion.trial_id)
        return follow(system, p, motion, rate_hz)

    follow = replicates.follow_motion
    monkeypatch.setattr(replicates, "follow_motion", counted)
    rate_hz, motions = trials.sensors.rate_hz, trials.motions

    def replicate(simulated: SimulatedTrials, number: int) -> Any:
        rngs = (np.random.default_rng([7, number, k]) for k in range(len(motions)))
        filters = trials.sensors, trials.kinematics
        return [make_replicate(simulated, k, *filters, rng) for k, rng in enumerate(rngs)]

    one = SimulatedTrials(linearisation.system, linearisation.p, motions, rate_hz)
    shared = [replicate(one, number) for number in range(2)]
    assert simulated == [motion.trial_id for motion in motions]
    for number in range(2):
        anew = replicate(
            SimulatedTrials(linearisation.system, linearisation.p, motions, rate_hz), number
        )
        for known, again in zip(shared[number], anew, strict=True):
            np.testing.assert_array_equal(known.q, again.q)
            np.testing.assert_array_equal(
                known.inputs(linearisation.system.inputs), again.inputs(linearisation.system.inputs)
            )
    assert not np.array_equal(shared[0][0].q, shared[1][0].q)


def test_a_replicate_leaves_out_the_moments_at_which_the_machine_stands_still(fitted) -> None:
    trials, linearisation = fitted
    motion = trials.motions[0]
    rest = np.zeros(motion.q.shape, dtype=bool)
    rest[200:240] = True
    simulated = SimulatedTrials(
        linearisation.system,
        linearisation.p,
        [replace(motion, left_out=rest)],
        trials.sensors.rate_hz,
    )
    replicate = make_replicate(
        simulated, 0, trials.sensors, trials.kinematics, np.random.default_rng(1)
    )
    still = problem_of(linearisation.system, [replicate], trials.band).standstill[0]
    assert still[rest].all() and 0.0 < still.mean() < 0.5
    stored, _ = KeptItems([replicate, motion], most=1)
    np.testing.assert_array_equal(stored.left_out, replicate.left_out)


@pytest.mark.parametrize("late", [0, 1.6, 3, -1.6, -3])
def test_the_jumps_of_a_drive_that_acts_or_is_read_late_are_seen(late: float) -> None:
    """A joint that turns round under a controller that gives its motion, logged at another time."""
    rate = 200.0
    t = np.arange(0.0, 10.0, 1.0 / rate)
    q, qd, qdd = (np.sin(3.0 * t), 3.0 * np.cos(3.0 * t), -9.0 * np.sin(3.0 * t))
    soon = t + late / rate
    given = -0.9 * np.sin(3.0 * soon) + 2.0 * np.sign(np.cos(3.0 * soon))
    needed = 0.1 * qdd + 2.0 * np.sign(qd)
    system = SimpleNamespace(
        inputs=("drive",), input_map=lambda q, u, p: np.ones((len(q), 1, 1)),
        model=SimpleNamespace(device=SimpleNamespace(forces=("drive",))),
    )  # fmt: skip
    motion = SimpleNamespace(q=q[:, None], qd=qd[:, None])

    def jumps(force) -> bool:
        return replicates._jumps(
            SimpleNamespace(
                system=system, motion=motion, p=np.zeros(1), inputs=force[:, None],
                residual=(force - needed)[:, None],
            )
        )  # fmt: skip

    assert jumps(given)
    assert not jumps(np.convolve(given, np.ones(10) / 10.0, mode="same"))


@pytest.mark.parametrize("machine", [pytest.param("axis", marks=pytest.mark.long), "joint"])
def test_a_replicate_of_a_late_motor_leaves_what_the_measurement_leaves(machine, tmp_path) -> None:
    """By another simulator; moved by time derivatives within the band, it was up to 27 % off."""
    trials, spec, _ = record_trials(tmp_path, machine, 31, "actuator_delay", trials=2, seconds=5.0)
    late = replace(spec, effects=("actuator_delay",))
    system = system_of(late)
    start = system.prior.copy()
    start[-1] = 0.005
    p = linearise_fit(system, trials.motions, trials.band, start, trials.folds).p
    simulated = SimulatedTrials(system, p, trials.motions, trials.sensors.rate_hz)
    for number, measured in enumerate(trials.motions):
        rng = np.random.default_rng(1)
        replicate = make_replicate(simulated, number, trials.sensors, trials.kinematics, rng)
        there, here = (
            np.sqrt(np.mean(trials.band.thin(ModelOnTrial(system, p, [m]).residual) ** 2))
            for m in (measured, replicate)
        )
        assert 0.85 < here / there < 1.1


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("force_gain:current", {"error": 0.5}),
        ("drive_sag:joint", {"sag": 0.01}),
        ("load_dependent_friction:joint", {"coefficient": 0.4, "side_coefficient": 0.0}),
        ("actuator_lag:current", {"time_constant": 0.004}),
    ],
)
def test_the_force_that_a_motion_needs_leaves_no_residual(fitted, effect, values) -> None:
    """Whatever part of the force an effect takes: else the bias of replicates holds the misfit."""
    trials, linearisation = fitted
    system = compile_model(Model(linearisation.system.model.device, [effect]))
    head = effect.replace(":", ".")
    own = [
        values[q.name.removeprefix(f"{head}.")] for q in system.parameters[len(linearisation.p) :]
    ]
    p = np.append(linearisation.p, own)
    motion = trials.motions[0].with_channels({"stamp_offset": np.zeros(trials.motions[0].t.size)})
    measured = ModelOnTrial(system, p, [motion])
    force = replicates._required_force(measured, trials.sensors.rate_hz)
    named = dict(zip(system.model.device.forces, force.T, strict=True))
    needed = ModelOnTrial(system, p, [motion.with_channels(named)])
    before, after = (
        np.sqrt(np.mean(trials.band.thin(on_trial.residual) ** 2))
        for on_trial in (measured, needed)
    )
    assert after < 0.01 * before


def test_a_force_that_does_not_act_makes_no_replicate_out_of_the_measurement(fitted) -> None:
    """It would lack all that the measurement lacks, which would then be taken for bias."""
    trials, linearisation = fitted
    system = compile_model(Model(linearisation.system.model.device, ["force_gain:current"]))
    p = np.append(linearisation.p, 1.0)
    with pytest.raises(replicates.Runaway, match="no force was found"):
        replicates._required_force(ModelOnTrial(system, p, trials.motions), 500.0)


@pytest.mark.parametrize(
    ("effect", "late"),
    [("force_delay", -0.006), ("actuator_delay", 0.006), ("actuator_lag:current", 0.0)],
)
def test_how_late_a_force_acts_is_read_off_the_model(fitted, effect, late) -> None:
    trials, linearisation = fitted
    system = compile_model(Model(linearisation.system.model.device, [effect]))
    p = np.append(linearisation.p, 0.006)
    motion = trials.motions[0]
    derivatives = {name: np.zeros(motion.t.size) for name in system.inputs}
    motion = motion.with_channels(derivatives | dict(motion.channels))
    found = replicates._lateness(ModelOnTrial(system, p, [motion]))
    np.testing.assert_allclose(found, [late], atol=1e-9)
