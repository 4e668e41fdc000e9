"""What drives the axis of a new device file: the input, its constants, what stands beside it."""

from __future__ import annotations

from dataclasses import dataclass

from bampipe.physics.device import KINDS

_GAIN = {"current": ("A", "ampere"), "voltage": ("V", "volt")}
_SCALE = "[constants]                         # sets the scale of all that is estimated\n"
_MOTOR = """[constants]                         # they set the scale of all that is estimated
torque_constant = { value = 1.0, unit = "N.m/A", source = "fill in: at the joint" }  # guess
resistance = { value = 1.0, unit = "Ohm", source = "fill in: data sheet" }  # guess
"""
_SUPPLY = 'supply = { value = 12.0, unit = "V", source = "fill in: measured" }  # guess\n'


@dataclass(frozen=True)
class Drive:
    """What drives an axis, as far as a log shows it.

    Attributes:
        role: ``force``, ``current``, ``voltage`` or ``duty`` (cycle of a voltage).
        column: that was recorded of it, "" where none was.
        supply: whether the supply voltage that a duty cycle is a share of is recorded too.
        coil: whether, beside a force, the current of a coil that changes the friction is.
    """

    role: str
    column: str
    supply: bool = False
    coil: bool = False


@dataclass(frozen=True)
class Axis:
    """Name and kind of the axis, and the SI units that go with the kind.

    Attributes:
        name: as used in expressions.
        linear: whether it slides rather than turns.
    """

    name: str
    linear: bool

    @property
    def kind(self) -> str:
        return "linear" if self.linear else "rotary"

    @property
    def torque(self) -> str:
        return KINDS[self.kind][1]

    @property
    def inertia(self) -> str:
        return "kg" if self.linear else "kg.m2"

    @property
    def viscous(self) -> str:
        return "N.s/m" if self.linear else "N.m.s/rad"


@dataclass(frozen=True)
class Input:
    """How the file declares what drives the axis.

    Attributes:
        name: of the input.
        si: its unit.
        applied: expression of what it does to the axis.
        constants: the table of the constants in that expression, "" where there are none.
        placeholders: names of those that only the user knows.
        beside: a channel that is needed too, "" where none is.
    """

    name: str
    si: str
    applied: str
    constants: str = ""
    placeholders: tuple[str, ...] = ()
    beside: str = ""


def input_of(axis: Axis, drive: Drive) -> Input:
    """The input that goes with what drives the axis, with constants of 1 where none is known."""
    if drive.role in _GAIN:
        si, per = _GAIN[drive.role]
        gain = f"{'force' if axis.linear else 'torque'}_per_{per}"
        constants = (
            f'{_SCALE}{gain} = {{ value = 1.0, unit = "{axis.torque}/{si}", '
            'source = "fill in: data sheet, at the axis, gears included" }  # guess\n'
        )
        name = f"motor_{drive.role}"
        return Input(name, si, f"{gain}*{name}", constants, (gain,))
    if drive.role == "duty" and axis.linear:
        constants = (
            f'{_SCALE}force_at_full = {{ value = 1.0, unit = "N", source = "fill in: measured" }}'
            "  # guess\n"
        )
        return Input("duty", "", "force_at_full*duty", constants, ("force_at_full",))
    if drive.role == "duty":
        applied = f"torque_constant/resistance*(duty*supply - torque_constant*qd_{axis.name})"
        motor = ("torque_constant", "resistance")
        if drive.supply:
            return Input("duty", "", applied, _MOTOR, motor, 'supply = "V"')
        return Input("duty", "", applied, _MOTOR + _SUPPLY, (*motor, "supply"))
    coil = 'coil_current = "A"' if drive.coil else ""
    return Input("force_drive", axis.torque, "force_drive", beside=coil)
