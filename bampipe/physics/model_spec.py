"""A model as plain data."""

import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from bampipe.physics.device import Device
from bampipe.physics.model import Model
from bampipe.physics.registry import device_from, effect_from


@dataclass(frozen=True)
class ModelSpec:
    """A model as plain data, so that a worker process can build it again.

    Attributes:
        device: the device's declaration.
        effects: canonical names.
        extra: declarations of effects that are not built in.
    """

    device: Mapping[str, Any]
    effects: tuple[str, ...]
    extra: tuple[Mapping[str, Any], ...]

    def with_sign_widths(self, factor: float) -> "ModelSpec":
        """Return the model with signs of velocities smoothed over ``factor`` times the width."""
        declaration = deepcopy(dict(self.device))
        for coordinate in device_from(self.device).coordinates:
            declared = declaration.get("coordinates", {}).get(coordinate.name)
            if declared is not None:
                declared["sign_width"] = factor * coordinate.sign_width
        return replace(self, device=declaration)

    def model(self) -> Model:
        """Build the model."""
        device = _device(json.dumps(self.device))
        return Model(device, self.effects, [effect_from(e) for e in self.extra])


@lru_cache(maxsize=16)
def _device(declaration: str) -> Device:
    """The device of a declaration: a diagnosis builds hundreds of models of the same one."""
    return device_from(json.loads(declaration))
