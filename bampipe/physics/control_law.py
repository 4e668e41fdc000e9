"""The compiled control law of a device: the command from measured motion, references and gains."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass

from bampipe.errors import InputError
from bampipe.physics import expression, generated
from bampipe.physics.device import Device
from bampipe.physics.model import code_version


@dataclass(frozen=True)
class ControlLaw:
    """Generated code of one control law. Made by `compile_law`.

    Attributes:
        inputs: names of the columns of r: the controller's channels, the device's other
            channels, time.
        forces: force channels in the order of the commands.
        rate_hz: how often the controller acts; 0 where that is not known.
        command: c(y, r, none, out), numba-compiled: y are measured positions then rates (2 n_q,),
            none is not used, out (n_f,) receives the commands in the units of the channels.
    """

    inputs: tuple[str, ...]
    forces: tuple[str, ...]
    rate_hz: float
    command: Callable[..., None]


def compile_law(device: Device) -> ControlLaw | None:
    """The control law of ``device``, compiled once and kept on disk; None where it has none.

    Raises:
        InputError: an expression uses a name that a controller cannot know.
    """
    controller = device.controller
    if controller is None:
        return None
    inputs = (*controller.channels, *device.channels, "t")
    content = json.dumps(["law", code_version(), device.declaration], sort_keys=True, default=str)
    key = hashlib.sha256(content.encode()).hexdigest()[:24]
    folder = generated.folder_of_user()
    code = generated.read(folder, key)
    if code is None:
        code = generated.Generated(key, folder, {}, {"law": _source(device, inputs)})
        code.write()
    command = code.module("law").command
    return ControlLaw(inputs, device.forces, controller.rate_hz, command)


def _source(device: Device, inputs: tuple[str, ...]) -> str:
    """Source of the law, printed from its expressions."""
    import sympy as sp

    from bampipe.physics.codegen import law_source

    axes = [c.name for c in device.coordinates]
    motion = [sp.Symbol(f"y{i}", real=True) for i in range(2 * len(axes))]
    given = [sp.Symbol(f"r{i}", real=True) for i in range(len(inputs))]
    symbols = dict(zip([*axes, *(f"qd_{a}" for a in axes)], motion, strict=True))
    symbols |= dict(zip(inputs, given, strict=True))
    symbols |= {name: sp.Float(c.value) for name, c in device.constants.items()}

    def no_rate(_: object) -> object:
        raise InputError(
            "a control law has no ddt()",
            where=f"device {device.name!r}: controller.command",
            remedy=f"write qd_<axis> for a measured rate, such as qd_{axes[0]}",
        )

    assert device.controller is not None
    law = [
        expression.build(
            device.controller.command[force],
            symbols,
            f"device {device.name!r}: controller.command.{force}",
            {"sgn": sp.sign, "ddt": no_rate},
        )
        for force in device.forces
    ]
    return law_source(motion, given, law)
