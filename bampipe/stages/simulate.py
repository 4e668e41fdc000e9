"""A session in the raw-log format, recorded from the model itself, with effects hidden in it.

The plant is the compiled model with the effects of kind torque and energy; the effects of kind
input and measurement act on what its sensors read. The truth goes into a file beside the session
folder, never inside.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from bampipe.data import store
from bampipe.errors import InputError
from bampipe.estimate.simulation import Impedance, simulate_tracking
from bampipe.physics import Model, registry
from bampipe.physics.device import INPUT_ORDERS, Coordinate, Device, derivative
from bampipe.physics.effect import BoundEffect, Effect
from bampipe.physics.system import System, compile_model
from bampipe.stages.base import Progress, silent

NAME = "simulate"
SUMMARY = "Make a session from the model, with known effects hidden in it"

Array = NDArray[np.float64]

ENCODERS = {
    "yaw": ("enc_yaw", 21333.3333, 12000),
    "pitch": ("enc_pitch", 10191.0828, -4000),
    "extension": ("enc_extension", 33333.3333, 3000),
}
"""Column, counts per unit and counts at zero; other axes get 20000 per rad, 33333 per m."""

CALIBRATION = np.array([[12.0, 0.15, -0.1], [0.1, 11.5, 0.2], [-0.05, 0.1, 24.0]])
ZERO_V = np.array([0.021, -0.034, 0.012])
STIFFNESS = {"rotary": 2200.0, "linear": 109e3}
"""Typical transmission stiffness (Table I), N.m/rad and N/m."""

REACH = {"rotary": 0.65, "linear": 0.8}
"""Largest wanted motion as a share of half the range: people use more of a rod than of a turn."""

HASTE = {"rotary": 15.0, "linear": 6.0}
"""Largest wanted acceleration, rad/s2 and m/s2: about 40 N at the handle of the BAM."""

LOCKED_LOAD = {"rotary": 50.0, "linear": 120.0}
"""Peak load of a locked trial, N.m and N."""

LOCKED_BRAKE = 200.0
LOCKED_PERIOD, LOCKED_CYCLES = 4.0, 6
_TOO_HIGH = range(3, len(INPUT_ORDERS))
BAND = (0.1, 2.0)
"""Frequencies of the motion that the hand wants, Hz (Section II-E)."""


@dataclass(frozen=True)
class Config:
    """What to simulate.

    Attributes:
        effects: effects to hide, such as ``stribeck:yaw``; a strength of its own may follow,
            ``stribeck:yaw=0.5``.
        strength: size of the effects that state none. 1 is each effect's typical size: every
            strength parameter is this times its ``typical`` (its ``sd`` where it has none), its
            sign drawn where both make sense.
        seed: of every random draw.
        device: name of a built-in device.
        effect_files: paths of effect files beside the built-in ones.
        trials: number of free trials.
        viscous_trials: number of trials in a viscous field rendered by the brakes.
        locked_trials: whether each axis with a brake is also locked and loaded.
        duration: of a free or viscous trial, s.
        sample_rate: Hz.
        viscous_damping: Cartesian damping of the viscous field, N.s/m.
        amplitude: scale of the motion, 1 for all of what a person uses.
        force_noise: standard deviation of the force sensor, N.
        parameters: values that replace drawn ones, by full name.
        file_format: of the trial files, ``csv`` or ``parquet``.
    """

    effects: tuple[str, ...] = ()
    strength: float = 1.0
    seed: int = 0
    device: str = "bam"
    effect_files: tuple[str, ...] = ()
    trials: int = 5
    viscous_trials: int = 0
    locked_trials: bool = False
    duration: float = 16.0
    sample_rate: float = 500.0
    viscous_damping: float = 40.0
    amplitude: float = 1.0
    force_noise: float = 0.05
    parameters: Mapping[str, float] = field(default_factory=dict)
    file_format: str = "csv"


@dataclass(frozen=True)
class Plant:
    """The mechanism and its sensors as they truly are.

    Attributes:
        device: what is simulated.
        motion: model with the effects that act on the motion.
        force: model with the effects on the force reading, a pure delay left out; None without.
        position: model with the effects on the position reading; None without.
        values: true value of every parameter, by full name.
        delay: by which the force reading is late, s.
        stiffness: of each axis' transmission, N.m/rad or N/m.
    """

    device: Device
    motion: System
    force: System | None
    position: System | None
    values: Mapping[str, float]
    delay: float
    stiffness: Mapping[str, float]

    def p(self, system: System) -> Array:
        """True parameters of ``system``, (n_p,)."""
        return np.array([self.values[p.name] for p in system.parameters])


@dataclass(frozen=True)
class Recording:
    """True course of one trial: t (T,) s; q, qd (T, n_q); force (T, n_f); brake (T, n_b)."""

    t: Array
    q: Array
    qd: Array
    force: Array
    brake: Array


def simulate_session(out: Path, config: Config, progress: Progress = silent) -> dict[str, object]:
    """Write a session folder ``out`` and the truth about it to ``out`` + ``.truth.json``.

    Args:
        out: folder to make; must not exist, or be empty.
        config: what to simulate; equal configurations give equal bytes.
        progress: told after each trial.

    Returns:
        ``session``, ``truth`` (paths), ``effects``, ``trials`` (file names).

    Raises:
        InputError: an effect, parameter or option makes no sense, or ``out`` is not empty.
    """
    _check(config)
    out = Path(out).resolve()
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", out.name):
        raise InputError(
            f"{out.name!r} cannot name a session", remedy="use letters, digits, '.', '_' and '-'"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("exists and is not an empty folder", where=str(out))
    plant, strengths = _plant(config)
    trials = _plan(plant.device, config)
    try:
        (out / "trials").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder: {error.strerror}", where=str(out)) from error
    for number, trial in enumerate(trials):
        rng = np.random.default_rng([config.seed, 1 + number])
        if trial["kind"] == "locked":
            recording = _locked(plant, config, rng, trial["locked_axis"])
        else:
            recording = _moving(plant, config, rng, trial["kind"] == "viscous")
        frame = _read_out(plant, config, rng, recording, trial["kind"] == "locked")
        path = out / trial["file"]
        if config.file_format == "csv":
            store.write_text(path, frame.to_csv(index=False, lineterminator="\n"))
        else:
            store.write_parquet(path, frame)
        progress((number + 1) / len(trials), trial["file"])
    store.write_text(out / "session.toml", _session_toml(out.name, plant.device, config, trials))
    truth = out.with_name(out.name + ".truth.json")
    store.write_json(
        truth,
        {
            "schema": "bampipe.truth/1",
            "device": plant.device.name,
            "effects": strengths,
            "configuration": asdict(config),
            "parameters": dict(plant.values),
            "stiffness": dict(plant.stiffness) if config.locked_trials else {},
        },
    )
    return {
        "session": str(out),
        "truth": str(truth),
        "effects": list(strengths),
        "trials": [trial["file"] for trial in trials],
    }


def _check(config: Config) -> None:
    positive = ("duration", "sample_rate", "amplitude", "viscous_damping")
    for name in positive:
        if not 0 < getattr(config, name) < float("inf"):
            raise InputError(f"{name} must be positive, found {getattr(config, name)!r}")
    for name in ("strength", "force_noise", "trials", "viscous_trials", "seed"):
        if not 0 <= getattr(config, name) < float("inf"):
            raise InputError(f"{name} must not be negative, found {getattr(config, name)!r}")
    if config.amplitude > 1:
        raise InputError(f"amplitude must be at most 1, found {config.amplitude}")
    if config.trials + config.viscous_trials == 0 and not config.locked_trials:
        raise InputError("nothing to simulate", remedy="ask for at least one trial")
    if config.duration * config.sample_rate < 10:
        raise InputError("a trial would have fewer than 10 samples", remedy="make it longer")
    if config.file_format not in ("csv", "parquet"):
        raise InputError(f"file format {config.file_format!r} is neither csv nor parquet")


def _plan(device: Device, config: Config) -> list[dict[str, str]]:
    """The ``[[trials]]`` entries."""
    kinds = [("free", "")] * config.trials + [("viscous", "")] * config.viscous_trials
    if config.locked_trials:
        kinds += [("locked", c.name) for c in device.coordinates if c.name in device.brakes]
    if not device.brakes and (config.viscous_trials or config.locked_trials):
        raise InputError(f"device {device.name!r} has no brakes for locked or viscous trials")
    trials = []
    for number, (kind, axis) in enumerate(kinds, start=1):
        label = f"{kind}_{axis}" if axis else kind
        entry = {"file": f"trials/t{number:02d}_{label}.{config.file_format}", "kind": kind}
        trials.append(entry | ({"locked_axis": axis} if axis else {}))
    return trials


def _plant(config: Config) -> tuple[Plant, dict[str, float]]:
    """Draw the plant; also the strength of each effect by canonical name."""
    device = registry.device(config.device)
    extra = [_own_effect(Path(path)) for path in config.effect_files]
    strengths = dict(_strength(text, config.strength) for text in config.effects)
    if len(strengths) < len(config.effects):
        raise InputError("an effect is named twice")
    whole = Model(device, strengths, extra)
    rng = np.random.default_rng([config.seed, 0])
    values = _base_values(device, rng)
    for item in whole.effects:
        values |= _effect_values(item, strengths[item.name], rng)
    for name, value in config.parameters.items():
        if name not in values:
            known = ", ".join(values)
            raise InputError(f"no parameter {name!r} to set", remedy=f"there are {known}")
        values[name] = float(value)

    def part(*kinds: str) -> System | None:
        chosen = [e.name for e in whole.effects if e.effect.kind in kinds and not _is_delay(e)]
        return compile_model(Model(device, chosen, extra)) if chosen else None

    delay = sum(values[f"{e.prefix}.delay"] for e in whole.effects if _is_delay(e))
    stiffness = {c.name: STIFFNESS[c.kind] * float(rng.uniform(0.95, 1.05)) for c in
                 device.coordinates}  # fmt: skip
    motion = part("torque", "energy") or compile_model(Model(device))
    return (
        Plant(device, motion, part("input"), part("measurement"), values, delay, stiffness),
        strengths,
    )


def _is_delay(item: BoundEffect) -> bool:
    """The one effect whose expression is a series for what the sensor does exactly."""
    return item.effect.name == "force_delay"


def _own_effect(path: Path) -> Effect:
    return registry.effect_from(store.read_toml(path), str(path))


def _strength(text: str, default: float) -> tuple[str, float]:
    name, sign, number = text.partition("=")
    if not sign:
        return name, default
    try:
        value = float(number)
    except ValueError as error:
        raise InputError(f"strength {number!r} of effect {name!r} is not a number") from error
    if not 0 <= value < float("inf"):
        raise InputError(f"strength of effect {name!r} must not be negative, found {number}")
    return name, value


def _base_values(device: Device, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of one specimen of ``device``, around their typical values or priors."""
    spread = {"viscous": 0.15, "coulomb": 0.1}
    values = {}
    for p in device.parameters:
        nominal = p.prior if p.typical is None else p.typical
        factor = 1.0 + spread.get(p.name.partition(".")[0], 0.003) * float(rng.uniform(-1.0, 1.0))
        values[p.name] = p.prior if p.fixed else _between(nominal * factor, p.lower, p.upper)
    return values


def _effect_values(
    item: BoundEffect, strength: float, rng: np.random.Generator
) -> dict[str, float]:
    """Parameters of an effect: strengths scaled and signed, shapes within 20 % of typical."""
    values = {}
    for p in item.parameters:
        draw = float(rng.uniform(-1.0, 1.0))
        if p.fixed:
            values[p.name] = p.prior
        elif p.strength:
            size = p.sd if p.typical is None else p.typical
            sign = -1.0 if p.lower < 0 and draw < 0 else 1.0
            values[p.name] = _between(sign * strength * size, p.lower, p.upper)
        else:
            shape = p.prior if p.typical is None else p.typical
            values[p.name] = _between(shape * (1.0 + 0.2 * draw), p.lower, p.upper)
    return values


def _between(value: float, lower: float, upper: float) -> float:
    return min(max(value, lower), upper)


def _range(device: Device, c: Coordinate) -> tuple[float, float]:
    """Middle and half width of an axis' range."""
    lower, upper = device.limits.get(c.name, (-1.0, 1.0) if c.kind == "rotary" else (-0.2, 0.2))
    return (lower + upper) / 2, (upper - lower) / 2


def _wanted(
    device: Device, config: Config, rng: np.random.Generator, t: Array, share: float
) -> tuple[Array, Array]:
    """Position and rate that the hand wants: band-limited noise in each axis, from rest."""
    q = np.empty((len(t), len(device.coordinates)))
    qd = np.empty_like(q)
    rise = np.clip(t / 1.0, 0.0, 1.0)
    fade, fade_rate = rise**2 * (3 - 2 * rise), 6 * rise * (1 - rise)
    for i, c in enumerate(device.coordinates):
        middle, half = _range(device, c)
        frequency = 2 * np.pi * rng.uniform(*BAND, size=40)
        # A hand reaches far slowly and only a little fast.
        size = rng.normal(size=40) / (1.0 + (frequency / (2 * np.pi * 0.6)) ** 2) ** 2
        phase = np.outer(t, frequency) + rng.uniform(0.0, 2 * np.pi, size=40)
        wave, rate = np.sin(phase) @ size, np.cos(phase) @ (size * frequency)
        reach = half * REACH[c.kind] * config.amplitude * share * rng.uniform(0.7, 1.0)
        bend = np.sin(phase) @ (size * frequency**2)
        scale = min(reach / np.abs(wave).max(), HASTE[c.kind] / np.abs(bend).max())
        q[:, i] = middle + scale * (wave[0] + fade * (wave - wave[0]))
        qd[:, i] = scale * (fade * rate + fade_rate * (wave - wave[0]))
    return q, qd


def _moving(plant: Plant, config: Config, rng: np.random.Generator, viscous: bool) -> Recording:
    """A free trial, or one in a viscous field."""
    system, device = plant.motion, plant.device
    dt = 1.0 / config.sample_rate
    t = np.arange(round(config.duration * config.sample_rate), dtype=np.float64) * np.float64(dt)
    q_ref, qd_ref = _wanted(device, config, rng, t, 0.6 if viscous else 1.0)
    arm = Impedance(natural_frequency=rng.uniform(7.0, 10.0), damping_ratio=1.0, bandwidth=50.0)
    u = np.zeros((len(t), len(system.inputs)))
    if "t" in system.inputs:
        u[:, system.inputs.index("t")] = t
    force = [system.inputs.index(f) for f in device.forces]
    slopes = [[_column(system, derivative(f, k)) for f in device.forces] for k in (1, 2)]
    n = len(device.coordinates)
    brakes = [system.inputs.index(device.brakes[c.name]) for c in device.coordinates] if (
        viscous or set(device.brakes) == {c.name for c in device.coordinates}
    ) else []  # fmt: skip
    p = plant.p(system)
    x0 = np.concatenate([q_ref[0], np.zeros(n), system.initial_memory(q_ref[0], u[0], p)])
    pose = q_ref
    # The field J^T K J needs the pose; its own motion settles after a few rounds.
    for _ in range(4 if viscous else 1):
        gain = config.viscous_damping * (system.input_map(pose) ** 2).sum(axis=2)
        x, total = simulate_tracking(
            system.derivative, x0, u, p, dt, q_ref, qd_ref,
            width=np.array([c.sign_width for c in device.coordinates]),
            n_noise=len(system.noise), force=force, rate=slopes[0], curvature=slopes[1],
            impedance=arm, brake=brakes, brake_gain=gain if viscous else None,
        )  # fmt: skip
        pose = x[:, :n]
    brake = [system.inputs.index(b) for b in device.brakes.values()]
    return Recording(t, x[:, :n], x[:, n : 2 * n], total[:, force], total[:, brake])


def _column(system: System, name: str) -> int:
    return system.inputs.index(name) if name in system.inputs else -1


def _locked(plant: Plant, config: Config, rng: np.random.Generator, axis: str) -> Recording:
    """An axis held by its brake while the handle is loaded: the transmission winds up.

    The load is stiffness times deflection plus friction that builds up over a tenth of the
    deflection (Dahl), which gives the loop of Fig. 3.
    """
    device = plant.device
    names = [c.name for c in device.coordinates]
    i = names.index(axis)
    kind = device.coordinates[i].kind
    stiffness = plant.stiffness[axis]
    t = np.arange(round(LOCKED_PERIOD * LOCKED_CYCLES * config.sample_rate)) / config.sample_rate
    peak = LOCKED_LOAD[kind] / stiffness
    deflection = peak * (1 - 0.03 * rng.uniform()) * np.sin(2 * np.pi * t / LOCKED_PERIOD)
    friction = 1.5 * plant.values.get(f"coulomb.{axis}", 0.02 * LOCKED_LOAD[kind])
    share = np.empty(len(t))
    share[0] = 0.0
    for k, step in enumerate(np.diff(deflection)):
        aim = np.sign(step)
        share[k + 1] = aim + (share[k] - aim) * np.exp(-abs(step) / (0.1 * peak))
    middle = [_range(device, c) for c in device.coordinates]
    pose = np.array([m + 0.05 * half for m, half in middle])
    q = np.tile(pose, (len(t), 1))
    q[:, i] += deflection
    load = np.zeros((len(t), len(names)))
    load[:, i] = stiffness * deflection + friction * share
    force = _forces(plant.motion.input_map(q), load)
    wander = rng.uniform(0.0, 2 * np.pi, size=force.shape[1])
    others = np.abs(force).max(axis=0) < 0.05 * np.abs(force).max()
    force += np.where(others, 1.2 * np.sin(2 * np.pi * 0.17 * t[:, None] + wander), 0.0)
    brake = np.zeros((len(t), len(device.brakes)))
    brake[:, list(device.brakes).index(axis)] = LOCKED_BRAKE
    return Recording(t, q, np.zeros_like(q), force, brake)


def _forces(input_map: Array, load: Array) -> Array:
    """Handle forces (T, n_f) that give the generalised forces ``load`` (T, n_q)."""
    inverse = np.linalg.pinv(input_map)
    return np.asarray(np.einsum("tfq,tq->tf", inverse, load), dtype=np.float64)


def _read_out(
    plant: Plant, config: Config, rng: np.random.Generator, true: Recording, locked: bool
) -> pd.DataFrame:
    """What the logger writes: whole counts, volts, brake commands."""
    device = plant.device
    force = _sensed_force(plant, true) + config.force_noise * rng.normal(size=true.force.shape)
    # A locked trial winds up the transmission itself: the encoder sees the deflection as given.
    q = _sensed_position(plant, true, np.zeros_like(true.force) if locked else true.force)
    columns: dict[str, Any] = {"time_us": np.round(true.t * 1e6).astype(np.int64)}
    for i, c in enumerate(device.coordinates):
        name, per_unit, zero = _encoder(c)
        columns[name] = np.round(q[:, i] * per_unit + zero).astype(np.int64)
    if device.force_unit == "N":
        calibration, zero_v = _calibration(len(device.forces))
        volts = np.linalg.solve(calibration, force.T).T + zero_v
        columns |= {f"{f}_v": np.round(volts[:, j], 6) for j, f in enumerate(device.forces)}
    else:
        columns |= {f: np.round(force[:, j], 6) for j, f in enumerate(device.forces)}
    columns |= {b: np.round(true.brake[:, j], 4) for j, b in enumerate(device.brakes.values())}
    return pd.DataFrame(columns)


def _inputs(system: System, true: Recording, force: Array) -> Array:
    """Columns of u for the sensor models."""
    u = np.zeros((len(true.t), len(system.inputs)))
    for j, f in enumerate(system.model.device.forces):
        u[:, system.inputs.index(f)] = force[:, j]
    for j, b in enumerate(system.model.device.brakes.values()):
        if b in system.inputs:
            u[:, system.inputs.index(b)] = true.brake[:, j]
    if "t" in system.inputs:
        u[:, system.inputs.index("t")] = true.t
    return u


def _sensed_position(plant: Plant, true: Recording, force: Array) -> Array:
    """The reading q_m that solves q_true = q_m + offset(q_m), by iteration; ``force`` loads it."""
    if plant.position is None:
        return true.q
    system = plant.position
    u, p = _inputs(system, true, force), plant.p(system)
    q = true.q
    for _ in range(100):
        step = true.q - system.true_motion(q, true.qd, np.zeros_like(q), u, p)[0]
        q = q + step
        if np.abs(step).max() < 1e-12:
            return q
    raise InputError("a position effect is too strong to be simulated", remedy="weaken it")


def _sensed_force(plant: Plant, true: Recording) -> Array:
    """The reading of the force sensor, without noise.

    The effects say true = T(reading). T is affine in the reading and its two derivatives, so its
    coefficients at each sample follow from probing it; the reading then solves the equation,
    sample by sample where derivatives take part (implicit differences, stable for any lag).
    """
    late = np.column_stack(
        [np.interp(true.t - plant.delay, true.t, column) for column in true.force.T]
    )
    if plant.force is None:
        return late
    system, nf = plant.force, late.shape[1]
    if system.memory_names:
        raise InputError("an input effect with internal states cannot be simulated")
    p, no_states = plant.p(system), np.zeros((len(late), 0))
    still, names = np.zeros_like(true.q), plant.device.forces
    inverse = np.linalg.pinv(system.input_map(true.q))

    def corrected(u: Array) -> Array:
        applied = system.applied(true.q, true.qd, still, no_states, u, p)
        return np.asarray(np.einsum("tfq,tq->tf", inverse, applied), dtype=np.float64)

    zero = _inputs(system, true, np.zeros_like(late))
    constant = corrected(zero)
    if any(_column(system, derivative(f, k)) >= 0 for f in names for k in _TOO_HIGH):
        raise InputError("an input effect with a third derivative cannot be simulated")
    response = np.zeros((3, len(late), nf, nf))
    for order in range(3):
        for j, f in enumerate(names):
            column = _column(system, derivative(f, order))
            if column >= 0:
                u = zero.copy()
                u[:, column] = 1.0
                response[order, :, :, j] = corrected(u) - constant
    side = late - constant
    if not response[1:].any():
        reading = np.linalg.solve(response[0], side[:, :, None])[:, :, 0]
        if not np.allclose(corrected(_inputs(system, true, reading)), late, atol=1e-6):
            raise InputError("an input effect is not linear in the force: cannot be simulated")
        return np.asarray(reading)
    h = true.t[1] - true.t[0]
    reading = np.empty_like(late)
    now, before = late[0], late[0]
    for k in range(len(late)):
        a, b, c = response[0, k], response[1, k] / h, response[2, k] / h**2
        known = side[k] + b @ now + c @ (2 * now - before)
        reading[k] = np.linalg.solve(a + b + c, known)
        before, now = now, reading[k]
    return reading


def _encoder(c: Coordinate) -> tuple[str, float, int]:
    return ENCODERS.get(c.name, (f"enc_{c.name}", 20000.0 if c.kind == "rotary" else 33333.0, 0))


def _calibration(nf: int) -> tuple[Array, Array]:
    if nf > len(ZERO_V):
        return 12.0 * np.eye(nf), np.zeros(nf)
    return CALIBRATION[:nf, :nf], ZERO_V[:nf]


def _session_toml(
    session_id: str, device: Device, config: Config, trials: list[dict[str, str]]
) -> str:
    lines = [
        'schema = "bampipe.session/1"',
        f"session_id = {json.dumps(session_id)}",
        f"device = {json.dumps(config.device)}",
        f"sample_rate_hz = {config.sample_rate!r}",
        "",
        "[encoders]",
    ]
    for c in device.coordinates:
        name, per_unit, zero = _encoder(c)
        entry = f'column = "{name}", counts_per_unit = {per_unit!r}, zero_counts = {zero}'
        lines.append(f'{c.name} = {{ {entry}, unit = "{c.unit}" }}')
    lines += ["", "[force]"]
    if device.force_unit == "N":
        calibration, zero_v = _calibration(len(device.forces))
        lines += [
            f"columns = {json.dumps([f'{f}_v' for f in device.forces])}",
            'unit = "V"',
            'frame = "handle"',
            f"calibration_n_per_v = {json.dumps(calibration.tolist())}",
            f"zero_v = {json.dumps(zero_v.tolist())}",
        ]
    else:
        lines += [f"columns = {json.dumps(list(device.forces))}", f'unit = "{device.force_unit}"']
    lines.append(f"noise_sd_n = {config.force_noise!r}")
    if device.brakes:
        units = ", ".join(device.coordinate(axis).torque_unit for axis in device.brakes)
        names = json.dumps(list(device.brakes.values()))
        lines += ["", "[brakes]", f"columns = {names}", f'unit = "{units}"']
    for trial in trials:
        lines += ["", "[[trials]]", *(f'{key} = "{value}"' for key, value in trial.items())]
        if trial["kind"] == "viscous":
            lines.append(f"viscous_n_s_per_m = {config.viscous_damping!r}")
    return "\n".join(lines) + "\n"
