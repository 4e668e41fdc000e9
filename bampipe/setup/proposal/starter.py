"""A device file to start from: one axis with friction, driven by what was recorded."""

from __future__ import annotations

from dataclasses import dataclass

from bampipe.data.guesses import Driven
from bampipe.data.survey import REFERENCE_WORDS, words
from bampipe.setup.proposal.gravity import Weight
from bampipe.setup.proposal.starter_input import Axis, Drive, Input, input_of

_TAKEN = frozenset(
    [
        *("enc", "encoder", "pos", "position", "angle", "counts", "ticks", "displacement", "disp"),
        *("stroke", "present", "actual", "act", "measured", "meas", "current", "state", "value"),
        *("deg", "degree", "degrees", "rad", "radian", "radians", "vel", "velocity", "speed"),
        *(
            "header",
            "feedback",
            "column",
            "ang",
            "motion",
            "dist",
            "percent",
            "rec",
            "log",
            "data",
            "mot",
            "motor",
        ),
    ]
)
_FROM_A_MOTOR = REFERENCE_WORDS | {"effort", "eff", "torque", "tau"}
_DRIVE = "drive = true                        # from a motor; false: from a force sensor\n"
_PRESCRIBED = "prescribed = true                   # guess: a test bench gives the stroke\n"
_FASTEST_S = 2e-4
"""Time in which viscous friction stops the least mass that a simulation is asked to follow, s."""
_YIELDS = 2e-3


@dataclass(frozen=True)
class Starter:
    """A device file to start from.

    Attributes:
        text: of the file.
        axis: name of its axis.
        input: name of the input that drives the axis.
        placeholders: names of the constants that only its user knows.
    """

    text: str
    axis: str
    input: str
    placeholders: tuple[str, ...]


def starter_device(
    position: str,
    linear: bool,
    drive: Drive,
    found: Driven,
    weight: Weight | None = None,
    sign_width: float = 0.0,
) -> Starter:
    """Write a device file of one axis.

    Args:
        position: column of the position; its name may name the axis.
        linear: whether the axis slides rather than turns.
        drive: what drives it.
        found: sizes by a rough fit, SI, from which the priors are taken.
        weight: gravity on the axis, None where it carries none.
        sign_width: of the sign of the velocity, rad/s or m/s; 0 for the usual one.
    """
    names = [word for word in words(position) if word not in _TAKEN and len(word) > 2]
    axis = Axis(names[0] if names else ("carriage" if linear else "joint"), linear)
    source = input_of(axis, drive)
    sections = [
        _coordinate(axis, drive, sign_width),
        source.constants,
        _energy(axis, weight),
        _torque(axis, drive.coil),
        _inputs(source, drive),
        f'[applied]\n{axis.name} = "{source.applied}"\n',
        _scale(source.placeholders),
        _friction(axis, found),
        _inertia(axis, drive.coil, found),
        _offset(axis, found),
        *_moments(weight),
        *(_coil_parameters(axis, found) if drive.coil else []),
    ]
    text = "\n".join(section for section in sections if section)
    return Starter(text, axis.name, source.name, source.placeholders)


def _coordinate(axis: Axis, drive: Drive, sign_width: float) -> str:
    width = f"sign_width = {sign_width:g}  # guess: the encoder tells speeds as low\n"
    if drive.coil:
        width = f"sign_width = {_YIELDS:g}                  # a fluid yields over some mm/s\n"
    return f"""# Proposed by `bampipe init`: one axis with inertia and friction
schema = "bampipe.device/1"
name = "{axis.name}"
summary = "One {axis.kind} axis driven by a {drive.role}"
source = "fill in"

[coordinates.{axis.name}]
kind = "{axis.kind}"
symbol = "{axis.name[0]}"
{width if drive.coil or sign_width else ""}"""


def _energy(axis: Axis, weight: Weight | None) -> str:
    name = axis.name
    potential = f'"-moment*cos({name}) + moment_across*sin({name})"'
    if weight is not None:
        doubt = weight.doubt or "the motion shows it"
        without = 'of an upright axis "0", and without both tables [parameters.moment...]'
        potential += f"  # guess: gravity; {doubt}; {without}"
    else:
        hint = f'gravity of a link: "-moment*cos({name})", moment in N.m'
        if axis.linear:
            hint = f'gravity where the axis rises: "9.81*inertia*{name}"'
        potential = f'"0"                     # {hint}'
    return f'[energy]\nkinetic = "inertia*ddt({name})**2/2"\npotential = {potential}\n'


def _torque(axis: Axis, coil: bool) -> str:
    qd = f"qd_{axis.name}"
    rubbed = f"friction_per_ampere*sgn({qd}) + viscous_per_ampere*{qd}"
    coiled = f" - abs(coil_current)*({rubbed})" if coil else ""
    return (
        "[torque]                            # what is left at standstill\n"
        f'{axis.name} = "-offset{coiled}"\n'
    )


def _inputs(source: Input, drive: Drive) -> str:
    comment = f"             # {drive.column}" if drive.column else ""
    motor = drive.role != "force" or not _FROM_A_MOTOR.isdisjoint(words(drive.column))
    channels = f"channels = {{ {source.beside} }}\n" if source.beside else ""
    return f"""[inputs]
force = ["{source.name}"]{comment}
force_unit = "{source.si}"
{_DRIVE if motor else _PRESCRIBED if drive.coil else ""}{channels}"""


def _scale(placeholders: tuple[str, ...]) -> str:
    """What the sizes below are of, where they hang on constants that are not known."""
    if not placeholders:
        return ""
    guessed = f"# Guessed with {' and '.join(placeholders)} as above"
    return f"{guessed}: scale what follows with what you put in."


def _friction(axis: Axis, found: Driven) -> str:
    viscous, coulomb = (", ".join(_prior(size)) for size in (found.viscous, found.coulomb))
    return f"""[friction.{axis.name}]
viscous = {{ unit = "{axis.viscous}", {viscous}, lower = 0.0 }}  # guess
coulomb = {{ unit = "{axis.torque}", {coulomb}, lower = 0.0 }}  # guess
"""


def _inertia(axis: Axis, coil: bool, found: Driven) -> str:
    # A mass near zero under friction is a motion that no simulation can follow. Where force is
    # nearly all friction the guess of the mass is not worth much: friction has the last word.
    least = 0.02 * found.inertia if found.inertia > 0.0 else 0.1 if axis.linear else 1e-5
    least = min(least, _FASTEST_S * found.viscous) if found.viscous > 0.0 else least
    least = max(least, 0.3) if coil and axis.linear else least
    prior, sd = _prior(found.inertia)
    values = (prior, sd, f"lower = {_rounded(least):g}")
    return _parameter("inertia", axis.inertia, values, "all that moves, reduced to this axis")


def _offset(axis: Axis, found: Driven) -> str:
    values = ("prior = 0.0", f"sd = {_rounded(3.0 * abs(found.coulomb) or 20.0):g}")
    meaning = "needed to hold the axis where nothing else acts"
    return _parameter("offset", axis.torque, values, meaning)


def _moments(weight: Weight | None) -> list[str]:
    """The parameters of gravity; none where there is none."""
    if weight is None:
        return []
    sd = f"sd = {_rounded(weight.sd):g}"
    meaning = "mass times gravity times distance of the centre of gravity"
    return [
        _parameter(name, "N.m", (f"prior = {_rounded(size):g}", sd), meaning)
        for name, size in zip(("moment", "moment_across"), weight.moments, strict=True)
    ]


def _coil_parameters(axis: Axis, found: Driven) -> list[str]:
    texts = []
    for name, unit, size in (
        ("friction_per_ampere", axis.torque, found.coulomb),
        ("viscous_per_ampere", axis.viscous, found.viscous),
    ):
        meaning = "what the coil adds, in proportion to its current"
        texts.append(_parameter(name, f"{unit}/A", _prior(size), meaning, "lower = 0.0"))
    return texts


def _parameter(
    name: str, unit: str, guessed: tuple[str, ...], meaning: str, known: str = ""
) -> str:
    """A table of a parameter: lines that are ``guessed``, and one that follows from its meaning."""
    marked = [f"{line}  # guess" for line in guessed]
    lines = [f"[parameters.{name}]", f'unit = "{unit}"', *marked, f'description = "{meaning}"']
    return "\n".join([*lines, known] if known else lines) + "\n"


def _prior(size: float) -> tuple[str, str]:
    """A prior of the size found and its spread, five times that; wide where nothing was found."""
    if size <= 0.0:
        return "prior = 1.0", "sd = 100.0"
    return f"prior = {_rounded(size):g}", f"sd = {_rounded(5.0 * size):g}"


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")
