"""How carefully the diagnosis looks, and what it takes for a finding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How carefully to look.

    Attributes:
        replicates: replays of the model for the chance level.
        rival_replicates: replays of each rival when candidates come close.
        most_effects: the most effects tried, those dropped again among them.
        significance: chance of a false alarm in a session that is accepted.
        worth: least drop of log error beyond chance, on one axis, that is worth an effect.
        worth_at_floor: the same on an axis whose error is already at its noise floor: no replay
            is perfect, and changes of direction blurred by sampling invite
            spurious effects, up to a tenth of the error on a linear axis.
        predictable: least share of the residual of an axis above its floor that a flexible
            regressor must predict, beyond chance, for it to lack something.
        surely: error over floor beyond which it lacks something, predictable or not.
        explained: least share of the excess mean square that the effects found must remove, else
            the axis is reported as unknown.
        far: error over floor with the effects found beyond which they must remove more.
        explained_far: that share: an effect that only resembles the missing one, such as a spring
            in place of a stop, removes much and leaves many times the floor.
        jobs: worker processes.
        seed: of all noise.
    """

    replicates: int = 10
    rival_replicates: int = 4
    most_effects: int = 4
    significance: float = 0.01
    worth: float = 0.03
    worth_at_floor: float = 0.16
    predictable: float = 0.05
    surely: float = 2.0
    explained: float = 0.6
    far: float = 5.0
    explained_far: float = 0.75
    jobs: int = 2
    seed: int = 0
