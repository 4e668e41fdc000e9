"""A device file to start from: axes with friction, driven by what was recorded."""

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.data.guesses import Driven
from bampipe.data.names import REFERENCE_WORDS, words
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.data.units import unit as unit_named
from bampipe.data.vocabulary import word_set
from bampipe.physics.device import KINDS
from bampipe.physics.expression import FUNCTIONS
from bampipe.results.rounding import rounded
from bampipe.setup.hypotheses import MOST_TRAVEL
from bampipe.setup.proposal.positions import SLIDING, TURNING, in_counts
from bampipe.setup.sentences import sentence

_NAMELESS = word_set("nameless")
_DRIVEN, _SENSED, _TORQUES = map(word_set, ("driven", "sensed", "torques"))
_FASTEST_S = 2e-4
"""Time in which viscous friction stops the least mass that a simulation is asked to follow, s."""
_YIELDS = 2e-3
_UPRIGHT = word_set("upright")
_LEAST_WEIGHT, _USUAL_GEAR = 1e-3, 10.0
"""Spread of a weight of which nothing shows, N.m; turns of a motor whose gear is not known."""


@dataclass(frozen=True)
class Weight:
    """Gravity on an axis, for its device file.

    Attributes:
        moments: guesses of what multiplies sine and cosine of the angle, in the drive's unit.
        sd: of both.
        doubt: what else it may be, a clause; "" if there is no doubt.
    """

    moments: tuple[float, float]
    sd: float
    doubt: str = ""


@dataclass(frozen=True)
class Drive:
    """What drives an axis, as far as a log shows it.

    Attributes:
        role: ``force``, ``current``, ``voltage`` or ``duty`` (cycle of a voltage).
        column: that was recorded of it, "" if none was.
        supply: whether the supply voltage that a duty cycle is a share of is recorded too.
        coil: whether, beside a force, the current of a coil that changes the friction is.
        scaled: whether what is recorded is a force or torque at the axis, no gain or lever missing.
        register: whether it is a register with a sign, as a channel may be.
    """

    role: str
    column: str
    supply: bool = False
    coil: bool = False
    scaled: bool = True
    register: bool = False


def weight_of(
    position: SurveyedColumn, fit: Driven, linear: bool, found: Survey, geared: bool
) -> tuple[Weight | None, str]:
    """Gravity for the device file of an axis, None if it has none, and a sentence on it.

    A joint whose mounting is not known is more likely to carry weight than not, and an axis
    whose model lacks gravity has its weight explained by springs and unbalance. Behind a gear of
    unknown ratio, weight goes with the angle of the motor as a spring's torque does: ``geared``.
    """
    if linear:
        return None, ""
    reading = fit.pose.reading if fit.pose is not None else "nothing"
    if fit.pose is not None and reading == "spring" and not geared:
        return None, sentence("spring")
    if fit.pose is not None and fit.pose.is_gravity:
        doubt = sentence(reading) if reading in ("either", "both") else ""
        said = f"gravity: {doubt}" if doubt else "gravity, since the motion shows it"
        return Weight(fit.pose.moments, max(map(abs, fit.pose.moments)), doubt), said
    if not _may_carry(position, found, geared):
        return None, ""
    moments = fit.pose.moments if fit.pose is not None else (0.0, 0.0)
    size = max(*map(abs, moments), fit.coulomb, _LEAST_WEIGHT) * (_USUAL_GEAR if geared else 1.0)
    doubt = "assumed, as for any joint: the motion does not show it"
    return Weight((0.0, 0.0), size, doubt), f"gravity is {doubt}"


def _may_carry(position: SurveyedColumn, found: Survey, geared: bool) -> bool:
    """Whether an axis whose drive shows no weight is a joint all the same."""
    said, turns = set(words(re.sub(r"[\[\]]", " ", position.name))), position.si == "rad"
    is_angle = turns or said & TURNING or any(c.si == "N.m" for c in found.of("force"))
    if not is_angle or said & _UPRIGHT:
        return False
    travel = float(np.ptp(position.values)) * (position.scale if turns else 1.0)
    return geared or in_counts(position) or travel <= MOST_TRAVEL


def starter_device(
    position: str,
    linear: bool,
    drive: Drive,
    found: Driven,
    weight: Weight | None = None,
    sign_width: float = 0.0,
    axis: str = "",
) -> str:
    """Write a device file of one axis, which the column of its position may name.

    Its constants are those that only its user knows.

    Args:
        axis: its name, as one of several, behind which what belongs to it is called.
        found: sizes by a rough fit, SI, from which the priors are taken.
        weight: gravity on the axis, None if it carries none.
        sign_width: of the sign of the velocity, rad/s or m/s; 0 for the usual one.
    """
    taken = {*_NAMELESS, *FUNCTIONS}
    item = re.search(r"\[([A-Za-z]\w*)\]", position)  # of a list, such as position[elbow]
    parts = [item[1]] if item and unit_named(item[1]) is None else []
    names = [w for p in (*parts, position) for w in words(p) if w not in taken and len(w) > 2]
    names = [word for word in names if unit_named(word) is None]
    end = f"_{axis}" if axis else ""
    axis = axis or next(iter(names), "carriage" if linear else "joint")
    kind, qd = ("linear" if linear else "rotary"), f"qd_{axis}"
    torque, mass = KINDS[kind][1], "kg" if linear else "kg.m2"
    rate = "N.s/m" if linear else "N.m.s/rad"
    source, unit, applied, constants = _input_of(axis, linear, torque, drive, end)
    channels = 'channels = { supply = "V" }\n' if drive.supply and not linear else ""
    rubbed, width = "", f"sign_width = {sign_width:g}  # guess: the encoder tells speeds as low\n"
    if drive.coil:
        channels = 'channels = { coil_current = "A" }\n'
        rubbed = f" - abs(coil_current)*(friction_per_ampere*sgn({qd}) + viscous_per_ampere*{qd})"
        width = f"sign_width = {_YIELDS:g}                  # a fluid yields over some mm/s\n"
    # A torque is a motor's unless a coil brakes; most axes whose log names neither are driven.
    drive_words = {*words(drive.column)} - (_TORQUES if drive.coil else set())
    bench = drive.coil or drive_words & _SENSED or SLIDING & {*words(position)}
    motor = drive.role != "force" or drive_words & (_DRIVEN | REFERENCE_WORDS) or not bench
    listed, driven = " and ".join(constants), "driven" if motor else "prescribed"
    wide = 5.0 if drive.scaled else 100.0  # nobody knows yet what one of it is worth
    viscous, coulomb = (", ".join(_prior(size, wide)) for size in (found.viscous, found.coulomb))
    sets = "they set" if len(constants) > 1 else "sets"
    table = "\n".join([sentence("constants_set", sets=sets), *constants.values(), "", ""])
    still = "no_weight_slides" if linear else "no_weight_turns"
    potential = sentence(still, axis=axis, end=end)
    if weight is not None:
        potential = sentence("weight", axis=axis, doubt=weight.doubt or "the motion shows it")
    text = sentence(
        "device", axis=axis, end=end, kind=kind, role=drive.role, symbol=axis[0], source=source,
        sign_width=width if drive.coil or sign_width else "", constants=table if constants else "",
        potential=potential, rubbed=rubbed, unit=unit, applied=applied,
        column=f"             # {drive.column}" if drive.column else "", channels=channels,
        drive=sentence(driven) if motor or drive.coil else "", rate=rate, torque=torque,
        scaled=listed and sentence("scaled", constants=listed), viscous=viscous, coulomb=coulomb,
    )  # fmt: skip
    least, spread = _least_inertia(linear, drive.coil, found, wide), 0.6 * wide * abs(found.coulomb)
    inertia = (*_prior(found.inertia, wide), f"lower = {rounded(least)}")
    offset = ("prior = 0.0", f"sd = {rounded(spread or 20.0)}")
    text += _parameter(f"inertia{end}", mass, inertia, "all that moves, reduced to this axis")
    text += _parameter(f"offset{end}", torque, offset, sentence("offset"))
    if weight is not None:
        meaning = "mass times gravity times distance of the centre of gravity"
        for name, size in zip(("moment", "moment_across"), weight.moments, strict=True):
            guessed = (f"prior = {rounded(size)}", f"sd = {rounded(0.2 * wide * weight.sd)}")
            text += _parameter(name, "N.m", guessed, meaning)
    if drive.coil:
        for name, si, size in (
            ("friction_per_ampere", torque, found.coulomb),
            ("viscous_per_ampere", rate, found.viscous),
        ):
            meaning = "what the coil adds, in proportion to its current"
            text += _parameter(name, f"{si}/A", _prior(size, wide), meaning, "lower = 0.0\n")
    return text


def _input_of(
    axis: str, linear: bool, torque: str, drive: Drive, end: str
) -> tuple[str, str, str, dict[str, str]]:
    """Name and unit of the input, what it does to the axis, and the constants in that."""
    if drive.role in ("current", "voltage"):
        si, per = ("A", "ampere") if drive.role == "current" else ("V", "volt")
        gain = f"{'force' if linear else 'torque'}_per_{per}{end}"
        known = {gain: sentence("gain", called=gain, unit=f"{torque}/{si}")}
        return f"motor_{drive.role}{end}", si, f"{gain}*motor_{drive.role}{end}", known
    if drive.role == "duty":
        names = ["force_at_full"] if linear else ["torque_constant", "resistance"]
        names += [] if linear or drive.supply else ["supply"]
        applied = f"torque_constant/resistance*(duty*supply - torque_constant*qd_{axis})"
        applied = "force_at_full*duty" if linear else applied
        return "duty", "", applied, {name: sentence(name) for name in names}
    source = f"drive{end}" if drive.register else f"force{end or '_drive'}"
    return source, torque, source, {}


def stage_device(of_axes: Sequence[str]) -> str:
    """Write one device file out of those of its axes, which do not act on one another."""
    first, *others = of_axes
    parsed = [tomllib.loads(text) for text in of_axes]
    kinetic = " + ".join(one["energy"]["kinetic"] for one in parsed)
    forces = ", ".join(f'"{name}"' for one in parsed for name in one["inputs"]["force"])
    summary = f"Sliding axes, each {parsed[0]['summary'].partition('axis ')[2]}"
    lines = {"name": '"stage"', "summary": f'"{summary}"', "kinetic": f'"{kinetic}"'}
    for key, line in (lines | {"force": f"[{forces}]"}).items():
        first = re.sub(rf"(?m)^{key} = .*", f"{key} = {line}", first, count=1)
    for title, own in re.findall(r"(?m)^(\[.*\]).*\n((?:[^\[\n].*\n)*)", "\n".join(others)):
        if title in ("[constants]", "[torque]", "[applied]"):
            place = first.index("\n\n", first.index(title)) + 1
            first = first[:place] + own + first[place:]
        elif title not in ("[energy]", "[inputs]"):
            first += f"\n{title}\n{own}"
    return first


def _least_inertia(linear: bool, coil: bool, found: Driven, wide: float) -> float:
    # A mass near zero under friction is a motion that no simulation can follow. Where force is
    # nearly all friction the guess of the mass is not worth much: friction has the last word.
    least = 0.5 / wide**2 * found.inertia if found.inertia > 0.0 else 0.1 if linear else 1e-5
    least = min(least, _FASTEST_S * found.viscous) if found.viscous > 0.0 else least
    heavy = 0.3 * min(found.inertia, 1.0) if found.inertia > 0.0 else 0.3
    return max(least, heavy) if coil and linear else least


def _parameter(name: str, unit: str, guessed: tuple[str, ...], meaning: str, more: str = "") -> str:
    """A table of a parameter: lines that are ``guessed``, and what ``more`` is known."""
    marked = "".join(f"{line}  # guess\n" for line in guessed)
    return f'\n[parameters.{name}]\nunit = "{unit}"\n{marked}description = "{meaning}"\n{more}'


def _prior(size: float, wide: float) -> tuple[str, str]:
    """A prior of the size found and its spread, ``wide`` times that; 100 of 1 of nothing found."""
    if size <= 0.0:
        return "prior = 1.0", "sd = 100.0"
    return f"prior = {rounded(size)}", f"sd = {rounded(wide * size)}"
