"""A device file to start from: one axis with friction, driven by what was recorded."""

from __future__ import annotations

from bampipe.data.guesses import Driven
from bampipe.data.survey import words

_ROTARY = {"unit": "rad", "torque": "N.m", "inertia": "kg.m2", "viscous": "N.m.s/rad"}
_LINEAR = {"unit": "m", "torque": "N", "inertia": "kg", "viscous": "N.s/m"}
_GAIN = {"current": ("A", "torque_per_ampere"), "voltage": ("V", "torque_per_volt")}
_LINE = "  # guess\n"
_TAKEN = frozenset(
    [
        *("enc", "encoder", "pos", "position", "angle", "counts", "ticks", "displacement", "disp"),
        *("stroke", "present", "actual", "act", "measured", "meas", "current", "state", "value"),
        *("deg", "degree", "degrees", "rad", "radian", "radians", "vel", "velocity", "speed"),
        *("header", "feedback", "percent"),
    ]
)
_MOTOR = """[constants]                         # they set the scale of all that is estimated
torque_constant = { value = 1.0, unit = "N.m/A", source = "fill in: at the joint" }  # guess
resistance = { value = 1.0, unit = "Ohm", source = "fill in: data sheet" }  # guess
"""
_YIELDS = 2e-3
_SUPPLY = 'supply = { value = 12.0, unit = "V", source = "fill in: measured" }  # guess\n'


def starter_device(
    position: str,
    linear: bool,
    role: str,
    driver: str,
    coil: bool,
    found: Driven,
    supply: bool = False,
) -> tuple[str, str, list[str]]:
    """Text of a device file, the name of its axis, and the constants that only its user knows.

    Args:
        position: column of the position; its name may name the axis.
        linear: whether the axis slides rather than turns.
        role: what drives it: ``force``, ``current``, ``voltage`` or ``duty`` (cycle of a voltage).
        driver: column of that, for the comment.
        coil: whether the current of a coil that changes the friction is recorded too.
        found: sizes by a rough fit, SI, from which the priors are taken.
        supply: whether the supply voltage that a duty cycle is a share of is recorded too.
    """
    units = _LINEAR if linear else _ROTARY
    names = [word for word in words(position) if word not in _TAKEN and len(word) > 2]
    axis = names[0] if names else ("carriage" if linear else "joint")
    short = axis[0]
    own: list[str] = []
    more = ""
    if role in _GAIN:
        si, gain = _GAIN[role]
        own = [gain]
        channel, applied = f"motor_{role}", f"{gain}*motor_{role}"
        constants = (
            "[constants]                         # sets the scale of all that is estimated\n"
            f'{gain} = {{ value = 1.0, unit = "{units["torque"]}/{si}", '
            f'source = "fill in: data sheet, at the axis, gears included" }}  # guess\n\n'
        )
    elif role == "duty" and not linear:
        own = ["torque_constant", "resistance", *(() if supply else ("supply",))]
        si, channel = "", "duty"
        back = f"torque_constant*qd_{axis}"
        applied = f"torque_constant/resistance*(duty*supply - {back})"
        constants = _MOTOR + ("" if supply else _SUPPLY) + "\n"
        more = 'channels = { supply = "V" }\n' if supply else ""
    elif role == "duty":
        own, si, channel, applied = ["force_at_full"], "", "duty", "force_at_full*duty"
        constants = (
            "[constants]                         # sets the scale of all that is estimated\n"
            'force_at_full = { value = 1.0, unit = "N", source = "fill in: measured" }  # guess\n\n'
        )
    else:
        si, channel, applied, constants = units["torque"], "force_drive", "force_drive", ""
    driven = role in (*_GAIN, "duty") or bool(set(words(driver)) & {"effort", "torque", "tau"})
    if driven:
        more = (
            "drive = true                        # from a motor; false: from a force sensor\n"
            + more
        )
    rubbed = f"friction_per_ampere*sgn(qd_{axis}) + viscous_per_ampere*qd_{axis}"
    coiled = f" - abs(coil_current)*({rubbed})" if coil else ""
    potential, moments = _gravity(axis, found)
    lines = f'''# Proposed by `bampipe init`: one axis with inertia and friction
schema = "bampipe.device/1"
name = "{axis}"
summary = "One {"linear" if linear else "rotary"} axis driven by a {role}"
source = "fill in"

[coordinates.{axis}]
kind = "{"linear" if linear else "rotary"}"
symbol = "{short}"
'''
    lines += (
        f"sign_width = {_YIELDS:g}                  # a fluid yields over some mm/s\n"
        if coil
        else ""
    )
    lines += f'''
{constants}[energy]
kinetic = "inertia*ddt({axis})**2/2"
potential = {potential}

[torque]                            # what is left at standstill
{axis} = "-offset{coiled}"

[inputs]
force = ["{channel}"]{f"             # {driver}" if driver else ""}
force_unit = "{si}"
{more}'''
    lines += 'channels = { coil_current = "A" }\n' if coil else ""
    # A mass near zero under friction is a motion that no simulation can follow.
    least = 0.02 * found.inertia if found.inertia > 0.0 else 0.1 if linear else 1e-5
    least = max(least, 0.3) if coil and linear else least
    lines += f'''
[applied]
{axis} = "{applied}"

[friction.{axis}]
viscous = {{ unit = "{units["viscous"]}", {_prior(found.viscous)}, lower = 0.0 }}  # guess
coulomb = {{ unit = "{units["torque"]}", {_prior(found.coulomb)}, lower = 0.0 }}  # guess

[parameters.inertia]
unit = "{units["inertia"]}"
{_prior(found.inertia).replace(", ", _LINE)}
lower = {_rounded(least):g}
description = "all that moves, reduced to this axis"

[parameters.offset]
unit = "{units["torque"]}"
prior = 0.0
sd = {_rounded(3.0 * abs(found.coulomb) or 20.0):g}
description = "needed to hold the axis where nothing else acts"
{moments}'''
    if not coil:
        return lines, axis, own
    for name, unit, size in (
        ("friction_per_ampere", units["torque"], found.coulomb),
        ("viscous_per_ampere", units["viscous"], found.viscous),
    ):
        lines += f'''
[parameters.{name}]
unit = "{unit}/A"
{_prior(size).replace(", ", _LINE)}
lower = 0.0
description = "what the coil adds, in proportion to its current"
'''
    return lines, axis, own


def _gravity(axis: str, found: Driven) -> tuple[str, str]:
    """Expression of the potential energy, and its parameters; what to do where there is none."""
    if not any(found.gravity):
        return (
            f'"0"                     # gravity of a link: "-moment*cos({axis})", moment in N.m',
            "",
        )
    sine, cosine = found.gravity
    text = ""
    for name, size in (("moment", sine), ("moment_across", cosine)):
        text += f"""
[parameters.{name}]
unit = "N.m"
prior = {_rounded(size):g}  # guess
sd = {_rounded(max(abs(sine), abs(cosine))):g}
description = "mass times gravity times distance of the centre of gravity"
"""
    return f'"-moment*cos({axis}) + moment_across*sin({axis})"', text


def _prior(size: float) -> str:
    """A prior of the size found, five times as wide; a wide one where nothing was found."""
    if size <= 0.0:
        return "prior = 1.0, sd = 100.0"
    return f"prior = {_rounded(size):g}, sd = {_rounded(5.0 * size):g}"


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")
