"""The specimen of a device, with hidden effects, that a simulated session records."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from bampipe.arrays import Array
from bampipe.errors import InputError, did_you_mean
from bampipe.files import read_toml
from bampipe.physics import Model, registry
from bampipe.physics.device import Device
from bampipe.physics.effect import BoundEffect
from bampipe.physics.system import System, compile_model
from bampipe.schema import Count, Declaration, NotNegative, Number, Positive, Several, read

STIFFNESS = {"rotary": 2200.0, "linear": 109e3}
"""Typical transmission stiffness (Table I), N.m/rad and N/m."""


class Config(Declaration):
    """Settings of a simulation.

    Attributes:
        effects: effects to hide, such as ``stribeck:yaw``, or with a strength,
            ``stribeck:yaw=0.5``.
        strength: strength of the other effects, as a multiple of the ``typical`` value of each
            strength parameter (of its ``sd`` if it has none); its sign is random if both are valid.
        seed: of all random numbers.
        device: name of a built-in device.
        effect_files: paths of effect files beside the built-in ones.
        trials: number of free trials.
        viscous_trials: number of trials in a viscous field rendered by the brakes.
        locked_trials: whether each axis with a brake is also locked and loaded.
        duration: of a free or viscous trial, s.
        sample_rate: Hz.
        viscous_damping: Cartesian damping of the viscous field, N.s/m.
        amplitude: scale of the motion; 1 is the range that a person uses.
        force_noise: standard deviation of the force sensor, N.
        parameters: values that replace drawn ones, by full name.
        file_format: of the trial files, ``csv`` or ``parquet``.
    """

    effects: Several[str] = ()
    strength: NotNegative = 1.0
    seed: Count = 0
    device: str = "bam"
    effect_files: Several[str] = ()
    trials: Count = 5
    viscous_trials: Count = 0
    locked_trials: bool = False
    duration: Positive = 16.0
    sample_rate: Positive = 500.0
    viscous_damping: Positive = 40.0
    amplitude: Annotated[Positive, Field(le=1)] = 1.0
    force_noise: NotNegative = 0.05
    parameters: dict[str, Number] = Field(default={})
    file_format: Literal["csv", "parquet"] = "csv"

    @classmethod
    def read(cls, given: Mapping[str, object]) -> Self:
        """Return the settings ``given``; `InputError` names each that is wrong."""
        return read(cls, given, "")

    def cross_faults(self) -> Iterator[InputError]:
        if self.trials + self.viscous_trials == 0 and not self.locked_trials:
            yield InputError("nothing to simulate", remedy="ask for at least one trial")
        if self.duration * self.sample_rate < 10:
            yield InputError("a trial would have fewer than 10 samples", remedy="make it longer")


@dataclass(frozen=True)
class Specimen:
    """The true mechanism and its sensors.

    Attributes:
        device: what is simulated.
        motion: model with the effects that act on the motion.
        force: model with the effects on the force reading except a delay; None without any.
        position: model with the effects on the position reading; None without.
        values: true value of every parameter, by full name.
        delay: of the force reading, s.
        stiffness: of the transmission of each axis, N.m/rad or N/m.
    """

    device: Device
    motion: System
    force: System | None
    position: System | None
    values: Mapping[str, float]
    delay: float
    stiffness: Mapping[str, float]

    def p(self, system: System) -> Array:
        """Return the true parameters of ``system``, (n_p,)."""
        return np.array([self.values[p.name] for p in system.parameters])


def _find_device(name: str) -> Device:
    """Return a built-in device.

    Raises:
        InputError: there is no such device, or it has inputs other than forces.
    """
    known = registry.device_names()
    if name not in known:
        raise InputError(
            f"no built-in device {name!r}{did_you_mean(name, known)}",
            remedy=f"these are built in: {', '.join(known)}",
        )
    device = registry.device(name)
    no_forces = () if device.force_unit in ("N", "N.m") else device.forces
    others = (*no_forces, *device.channels)
    if others:
        raise InputError(
            f"device {name!r} cannot be simulated: it takes {' and '.join(others)}, and only forces"
            " are simulated"
        )
    return device


def find_input_column(system: System, name: str) -> int:
    """Return the column of an input in u, -1 if the model does not use it."""
    return system.inputs.index(name) if name in system.inputs else -1


def draw_specimen(config: Config) -> tuple[Specimen, dict[str, float]]:
    """Draw the specimen; return it with the strength of each effect."""
    device = _find_device(config.device)
    extra = [
        registry.effect_from(read_toml(path), str(path)) for path in map(Path, config.effect_files)
    ]
    strengths = dict(_read_strength(text, config.strength) for text in config.effects)
    if len(strengths) < len(config.effects):
        raise InputError("an effect is named twice")
    full = Model(device, strengths, extra)
    rng = np.random.default_rng([config.seed, 0])
    # The parameters of the device lie around their typical values or priors.
    spread = {"viscous": 0.15, "coulomb": 0.1}
    values = {}
    for p in device.parameters:
        nominal = p.prior if p.typical is None else p.typical
        factor = 1.0 + spread.get(p.name.partition(".")[0], 0.003) * float(rng.uniform(-1.0, 1.0))
        values[p.name] = p.prior if p.fixed else float(np.clip(nominal * factor, p.lower, p.upper))
    for item in full.effects:
        values |= _draw_effect_values(item, strengths[item.name], rng)
    for name, value in config.parameters.items():
        if name not in values:
            known = ", ".join(values)
            raise InputError(f"no parameter {name!r} to set", remedy=f"there are {known}")
        values[name] = float(value)

    def part(*kinds: str) -> System | None:
        chosen = [e.name for e in full.effects if e.effect.kind in kinds and not _is_delay(e)]
        return compile_model(Model(device, chosen, extra)) if chosen else None

    delay = sum(values[f"{e.prefix}.delay"] for e in full.effects if _is_delay(e))
    stiffness = {c.name: STIFFNESS[c.kind] * float(rng.uniform(0.95, 1.05)) for c in
                 device.coordinates}  # fmt: skip
    motion = part("torque", "energy") or compile_model(Model(device))
    forces, positions = part("input"), part("measurement")
    return Specimen(device, motion, forces, positions, values, delay, stiffness), strengths


def _is_delay(item: BoundEffect) -> bool:
    """Whether this is the delay, which the sensor model applies exactly, not as a series."""
    return item.effect.name == "force_delay"


def _read_strength(text: str, default: float) -> tuple[str, float]:
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


def _draw_effect_values(
    item: BoundEffect, strength: float, rng: np.random.Generator
) -> dict[str, float]:
    """Draw the parameters of an effect: strengths as asked, shapes within 20 % of typical."""
    values = {}
    for p in item.parameters:
        draw = float(rng.uniform(-1.0, 1.0))
        usual = (p.sd if p.strength else p.prior) if p.typical is None else p.typical
        if p.strength:
            sign = -1.0 if p.lower < 0 and draw < 0 else 1.0
            wanted = sign * strength * usual
        else:
            wanted = usual * (1.0 + 0.2 * draw)
        values[p.name] = p.prior if p.fixed else float(np.clip(wanted, p.lower, p.upper))
    return values
