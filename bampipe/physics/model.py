"""A model: a device plus its assumed effects."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.generated_code import hash_sources
from bampipe.physics import registry
from bampipe.physics.device import Device
from bampipe.physics.effect import BoundEffect, Effect, bind
from bampipe.physics.parameter import Parameter


@dataclass(frozen=True, init=False)
class Model:
    """A device plus bound effects.

    Attributes:
        device: the mechanism.
        effects: the terms added to it, in order.
    """

    device: Device
    effects: tuple[BoundEffect, ...]

    def __init__(
        self, device: Device, effects: Iterable[str] = (), extra_effects: Iterable[Effect] = ()
    ) -> None:
        """Bind ``effects`` (``"stribeck:yaw"``) to ``device``.

        Args:
            device: the mechanism.
            effects: canonical names; each effect is one of ``extra_effects`` or built in.
            extra_effects: effects of a lab's own.

        Raises:
            InputError: an effect or target is unknown, or an effect is named twice.
        """
        own = {effect.name: effect for effect in extra_effects}
        wanted: list[tuple[Effect, str]] = []
        for text in effects:
            name, _, target = text.partition(":")
            if name not in own and name not in registry.effect_names():
                known = [*own, *registry.effect_names()]
                raise InputError(
                    f"unknown effect {name!r}{did_you_mean(name, known)}",
                    remedy="see them all with: bampipe effects",
                )
            wanted.append((own[name] if name in own else registry.effect(name), target))
        pulled = {target for effect, target in wanted if effect.pulls}
        bound: list[BoundEffect] = []
        for effect, target in wanted:
            item = bind(effect, target, device, pulled)
            if item.name in [b.name for b in bound]:
                raise InputError(f"effect {item.name!r} is already in the model")
            bound.append(item)
        object.__setattr__(self, "device", device)
        object.__setattr__(self, "effects", tuple(bound))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters: the device's, then each effect's, in order."""
        own = [p for effect in self.effects for p in effect.parameters]
        return (*self.device.parameters, *own)

    @property
    def key(self) -> str:
        """Hash of everything that the generated code depends on."""
        content: list[Any] = [self.device.declaration]
        content += [[effect.name, effect.effect.declaration] for effect in self.effects]
        return hash_content(content)


def hash_content(content: list[Any]) -> str:
    """Hash of declarations and of this package's source: no code outlives its generator."""
    content = [hash_sources(Path(__file__).parent), *content]
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]
