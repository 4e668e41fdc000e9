"""Candidate effects: which there are, and the model in which each is compiled."""

from collections.abc import Sequence
from dataclasses import dataclass

from bampipe.physics import Model, System, compile_model
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.physics.parameter import Parameter
from bampipe.physics.registry import effect as built_in
from bampipe.physics.registry import effect_names
from bampipe.physics.signals import follows


@dataclass(frozen=True)
class Candidate:
    """One effect at one target.

    Attributes:
        name: canonical, ``stribeck:yaw``.
        system: the device with this effect alone; with the other effects of the model before it
            where it acts on what they leave.
        is_joint: whether it is with them.
        linear_indices: places among the effect's parameters of strengths in which the residual is
            linear; searched_indices: of those that are searched.
    """

    name: str
    system: System
    is_joint: bool
    parameters: tuple[Parameter, ...]
    linear_indices: tuple[int, ...]
    searched_indices: tuple[int, ...]

    @property
    def replaces_motion(self) -> bool:
        """Whether all that it does is that the model sees another motion than was measured."""
        return self.system.model.effects[-1].effect.kind == "measurement"


def list_candidates(
    device: Device, present: Sequence[str], extra: Sequence[Effect] = (), on_request: bool = False
) -> tuple[str, ...]:
    """Return the names of effects that could be added to ``device`` and are not ``present``.

    Effects that are weighed on request only are left out unless ``on_request`` is set.
    """
    known = {name: built_in(name) for name in effect_names()} | {e.name: e for e in extra}
    names = [
        f"{name}:{target}" if target else name
        for name, effect in sorted(known.items())
        for target in effect.targets(device)
        if on_request or not effect.on_request
    ]
    return tuple(name for name in names if name not in present)


def build_candidate_model(
    device: Device, name: str, extra: Sequence[Effect] = (), present: Sequence[str] = ()
) -> Model:
    """Return the model in which an effect is a candidate for one that has the effects ``present``.

    That is ``device`` with the effect alone, last with those present where they act on each other.

    Raises:
        InputError: there is no such effect or target.
    """
    full = Model(device, (*present, name), extra)
    *earlier, item = full.effects
    if any(follows(item, one, device) or follows(one, item, device) for one in earlier):
        return full
    return Model(device, (name,), extra)


def compile_candidate(model: Model) -> Candidate:
    """Compile the candidate that is the last effect of ``model``; see `build_candidate_model`."""
    system, item = compile_model(model), model.effects[-1]
    is_joint = len(model.effects) > 1
    judged = system
    if is_joint and item.effect.pulls:
        # A load that a spring is part of takes a tenth or so of what it adds: as good as linear.
        judged = compile_model(Model(model.device, (item.name,), (item.effect,)))
    parameters = system.parameters[len(system.parameters) - len(item.parameters) :]
    is_linear = judged.linear[len(judged.linear) - len(parameters) :]
    free = [i for i, parameter in enumerate(parameters) if not parameter.fixed]
    strengths = () if system.moves_sensors else (i for i in free if parameters[i].strength)
    linear = tuple(i for i in strengths if is_linear[i])
    searched = tuple(i for i in free if i not in linear)
    return Candidate(item.name, system, is_joint, parameters, linear, searched)
