"""A model as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bampipe.physics.model import Model
from bampipe.physics.registry import device_from, effect_from


@dataclass(frozen=True)
class Recipe:
    """A model as plain data, so that a worker process can build it again.

    Attributes:
        device: the device's declaration.
        effects: canonical names.
        extra: declarations of effects that are not built in.
    """

    device: Mapping[str, Any]
    effects: tuple[str, ...]
    extra: tuple[Mapping[str, Any], ...]

    def model(self) -> Model:
        """Build the model."""
        return Model(device_from(self.device), self.effects, [effect_from(e) for e in self.extra])
