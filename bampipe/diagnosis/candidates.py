"""Candidate effects of a device, and the model in which each is compiled."""

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
        name: ``effect:target``, such as ``stribeck:yaw``.
        system: the device with this effect, the last of the model.
        is_joint: whether ``system`` also has the other effects of the model, because they interact.
        parameters: the parameters of the effect.
        linear_indices: indices of the strengths in which the residual is linear.
        searched_indices: indices of the other free parameters whose values are searched.
    """

    name: str
    system: System
    is_joint: bool
    parameters: tuple[Parameter, ...]
    linear_indices: tuple[int, ...]
    searched_indices: tuple[int, ...]

    @property
    def takes_timing(self) -> bool:
        """Whether the effect delays every measured force."""
        return self.name in self.system.timing_effects

    @property
    def combines(self) -> int:
        """Number of effects that it stands for."""
        return self.system.model.effects[-1].effect.combines

    @property
    def replaces_motion(self) -> bool:
        """Whether the effect changes the motion that the model sees, and nothing else."""
        return self.system.model.effects[-1].effect.kind == "measurement"


def list_candidates(
    device: Device, present: Sequence[str], extra: Sequence[Effect] = (), on_request: bool = False
) -> tuple[str, ...]:
    """Return the names of the effects that ``device`` could have, except those ``present``.

    With ``on_request``, they include the effects that are weighed only on request.
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
    """Return ``device`` with a candidate, which follows the effects ``present`` if they interact.

    Raises:
        InputError: there is no such effect or target.
    """
    full = Model(device, (*present, name), extra)
    *earlier, item = full.effects
    if any(follows(item, one, device) or follows(one, item, device) for one in earlier):
        return full
    return Model(device, (name,), extra)


def compile_candidate(model: Model) -> Candidate:
    """Compile the last effect of ``model`` as a candidate; see `build_candidate_model`."""
    system, item = compile_model(model), model.effects[-1]
    is_joint = len(model.effects) > 1
    judged = system
    if is_joint and item.effect.pulls:
        # A load-dependent loss takes only about a tenth of a spring's force, so that the residual
        # is nearly linear in the spring.
        judged = compile_model(Model(model.device, (item.name,), (item.effect,)))
    parameters = system.parameters[len(system.parameters) - len(item.parameters) :]
    is_linear = judged.linear[len(judged.linear) - len(parameters) :]
    free = [i for i, parameter in enumerate(parameters) if not parameter.fixed]
    strengths = () if system.moves_sensors else (i for i in free if parameters[i].strength)
    linear = tuple(i for i in strengths if is_linear[i])
    searched = tuple(i for i in free if i not in linear and parameters[i].searched)
    return Candidate(item.name, system, is_joint, parameters, linear, searched)
