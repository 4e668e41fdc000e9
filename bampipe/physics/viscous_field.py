"""A Cartesian viscous field rendered by the brakes, as an effect: K_d = J^T K J (section IV)."""

import ast
import re

from bampipe.errors import InputError
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect, effect_from

NAME = "viscous_field"


def viscous_field(device: Device) -> Effect:
    """The damping of the handle, one parameter for each component of the handle's force.

    The force f at the handle does work at the rate f . v, and so do the generalised forces B f
    that it is mapped to: the handle's velocity in the frame of the force is v = B^T q'. A field
    f = -K v with diagonal K is then the generalised force -B K B^T q'.

    Raises:
        InputError: the device has no brakes or no handle force in N.
    """
    if not device.brakes or device.force_unit != "N":
        raise InputError(
            f"device {device.name!r} has no brakes that could render a field at a handle"
        )

    def put_unit(text: str, chosen: str) -> str:
        """Put one for a force and nought for the others."""
        forces = device.forces
        return re.sub(
            r"\w+", lambda m: str(float(m[0] == chosen)) if m[0] in forces else m[0], text
        )

    gain = {
        (axis, force): put_unit(ast.unparse(tree), force)
        for axis, tree in device.applied.items()
        for force in device.forces
    }
    speed = {
        force: " + ".join(f"({gain[axis, force]})*qd_{axis}" for axis in device.applied)
        for force in device.forces
    }
    components = [*zip(device.forces, device.components, strict=True)]
    torque = {}
    for axis in device.applied:
        terms = (f"damping_{c}*({gain[axis, force]})*({speed[force]})" for force, c in components)
        torque[axis] = f"-({' + '.join(terms)})"
    return effect_from(
        {
            "name": NAME,
            "summary": "The brakes resist the handle's motion in proportion to its speed",
            "scope": "device",
            "kind": "torque",
            "looks_like": "residual in proportion to the handle's velocity",
            "source": "Dellon and Matsuoka 2009, IEEE Transactions on Robotics 25(3), section IV",
            "torque": torque,
            "parameters": {
                f"damping_{component}": {
                    "unit": "N.s/m",
                    "prior": 0.0,
                    "sd": 100.0,
                    "strength": True,
                    "description": f"resistance to motion along {component}",
                }
                for component in device.components
            },
        },
        NAME,
    )
