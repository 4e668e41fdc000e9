"""The compiled control law of a device: the command from measured motion, references and gains."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from bampipe import generated_code
from bampipe.errors import InputError
from bampipe.physics import expression
from bampipe.physics.device import Device
from bampipe.physics.model import hash_content


@dataclass(frozen=True)
class ControlLaw:
    """Generated code of one control law. Made by `compile_law`.

    Attributes:
        inputs: names of the columns of r: the controller's channels, the device's other
            channels, time.
        forces: force channels in the order of the commands.
        rate_hz: how often the controller acts; 0 if unknown.
        limits: (n_s, 2) of the controller's states.
        command: c(y, r, s, out), numba-compiled: y are measured positions then rates (2 n_q,),
            s (n_s,) the states, out (n_f + n_s,) receives the commands in the units of the
            channels and the rates of the states.
    """

    inputs: tuple[str, ...]
    forces: tuple[str, ...]
    rate_hz: float
    limits: tuple[tuple[float, float], ...]
    command: Callable[..., None]


def compile_law(device: Device) -> ControlLaw | None:
    """Return the control law of ``device``, compiled once and kept on disk; None if it has none.

    Raises:
        InputError: an expression uses a name that a controller cannot know.
    """
    controller = device.controller
    if controller is None:
        return None
    inputs = (*controller.channels, *device.channels, "t")
    key = hash_content(["law", device.declaration])
    code = generated_code.load(key, lambda: ({}, {"law": _print_law(device, inputs)}))
    command = code.module("law").command
    limits = tuple((state.lower, state.upper) for state in controller.states.values())
    return ControlLaw(inputs, device.forces, controller.rate_hz, limits, command)


def _print_law(device: Device, inputs: tuple[str, ...]) -> str:
    """Source of the law, printed from its expressions."""
    import sympy as sp

    from bampipe.physics.codegen import SCALAR_HEADER, filling_function

    assert device.controller is not None
    axes, states = [c.name for c in device.coordinates], device.controller.states
    names = {"y": [*axes, *(f"qd_{a}" for a in axes)], "r": inputs, "s": [*states]}
    groups = {
        letter: [sp.Symbol(f"{letter}{i}", real=True) for i in range(len(group))]
        for letter, group in names.items()
    }
    symbols = dict(zip(chain(*names.values()), chain(*groups.values()), strict=True))
    symbols |= {name: sp.Float(c.value) for name, c in device.constants.items()}

    def no_rate(_: object) -> object:
        raise InputError(
            "a control law has no ddt()",
            where=f"device {device.name!r}: controller.command",
            remedy=f"write qd_<axis> for a measured rate, such as qd_{axes[0]}",
        )

    parts = [(f"command.{force}", device.controller.command[force]) for force in device.forces]
    parts += [(f"states.{name}.rate", state.rate) for name, state in states.items()]
    where, special = f"device {device.name!r}: controller", {"sgn": sp.sign, "ddt": no_rate}
    law = [expression.build(tree, symbols, f"{where}.{place}", special) for place, tree in parts]
    return SCALAR_HEADER + filling_function("command", groups, {"out": law})
