"""A device file to start from: one axis with friction, driven by what was recorded."""

from __future__ import annotations

from bampipe.data.guesses import Driven
from bampipe.data.survey import words

_ROTARY = {"unit": "rad", "torque": "N.m", "inertia": "kg.m2", "viscous": "N.m.s/rad"}
_LINEAR = {"unit": "m", "torque": "N", "inertia": "kg", "viscous": "N.s/m"}
_GAIN = {"current": ("A", "torque_per_ampere"), "voltage": ("V", "torque_per_volt")}
_LINE = "  # guess\n"
_TAKEN = frozenset(
    ["enc", "encoder", "pos", "position", "angle", "counts", "displacement", "disp", "stroke"]
)


def starter_device(
    position: str, linear: bool, role: str, driver: str, coil: bool, found: Driven
) -> tuple[str, str]:
    """Text of a device file, and the name of its axis.

    Args:
        position: column of the position; its name may name the axis.
        linear: whether the axis slides rather than turns.
        role: what drives it: ``force``, ``current`` or ``voltage``.
        driver: column of that, for the comment.
        coil: whether the current of a coil that changes the friction is recorded too.
        found: sizes by a rough fit, SI, from which the priors are taken.
    """
    units = _LINEAR if linear else _ROTARY
    names = [word for word in words(position) if word not in _TAKEN and len(word) > 2]
    axis = names[0] if names else ("carriage" if linear else "joint")
    short = axis[0]
    if role in _GAIN:
        si, gain = _GAIN[role]
        channel, applied = f"motor_{role}", f"{gain}*motor_{role}"
        constants = (
            "[constants]                         # sets the scale of all that is estimated\n"
            f'{gain} = {{ value = 1.0, unit = "{units["torque"]}/{si}", '
            f'source = "fill in: data sheet" }}  # guess\n\n'
        )
    else:
        si, channel, applied, constants = units["torque"], "force_drive", "force_drive", ""
    lines = f'''# Proposed by `bampipe init`: one axis with inertia and friction
schema = "bampipe.device/1"
name = "{axis}"
summary = "One {"linear" if linear else "rotary"} axis driven by a {role}"
source = "fill in"

[coordinates.{axis}]
kind = "{"linear" if linear else "rotary"}"
symbol = "{short}"

{constants}[energy]
kinetic = "inertia*ddt({axis})**2/2"
potential = "0"                     # gravity of a link: "-moment*cos({axis})", moment in J

[torque]                            # what is left at standstill
{axis} = "-offset"

[inputs]
force = ["{channel}"]{f"             # {driver}" if driver else ""}
force_unit = "{si}"
'''
    if coil:
        lines += 'channels = { coil_current = "A" }\n'
    lines += f'''
[applied]
{axis} = "{applied}"

[friction.{axis}]
viscous = {{ unit = "{units["viscous"]}", {_prior(found.viscous)}, lower = 0.0 }}  # guess
coulomb = {{ unit = "{units["torque"]}", {_prior(found.coulomb)}, lower = 0.0 }}  # guess

[parameters.inertia]
unit = "{units["inertia"]}"
{_prior(found.inertia).replace(", ", _LINE)}
lower = 0.0
description = "all that moves, reduced to this axis"

[parameters.offset]
unit = "{units["torque"]}"
prior = 0.0
sd = {_rounded(3.0 * abs(found.coulomb) or 20.0):g}
description = "needed to hold the axis where nothing else acts"
'''
    if not coil:
        return lines, axis
    lines = lines.replace(
        f'{axis} = "-offset"',
        f'{axis} = "-offset - friction_per_ampere*coil_current*sgn(qd_{axis})"',
    )
    lines += f'''
[parameters.friction_per_ampere]
unit = "{units["torque"]}/A"
prior = 0.0                         # guess
sd = 1000.0
lower = 0.0
description = "friction that the coil adds, in proportion to its current"
'''
    return lines, axis


def _prior(size: float) -> str:
    """A prior of the size found, five times as wide; a wide one where nothing was found."""
    if size <= 0.0:
        return "prior = 1.0, sd = 100.0"
    return f"prior = {_rounded(size):g}, sd = {_rounded(5.0 * size):g}"


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")
