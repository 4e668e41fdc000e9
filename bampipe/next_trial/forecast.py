"""What the proposed trials are expected to give, as it is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.next_trial.choice import Tried
from bampipe.next_trial.discrimination import Contest
from bampipe.next_trial.motion import Rehearsal
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import Primitive, find_beyond
from bampipe.next_trial.words import describe
from bampipe.results.next import ExpectedConfusion, ExpectedSd, Move, Proposal
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Forecast:
    """What is needed to say what a design gives.

    Attributes:
        rehearsal: the fitted model that designs are tried with.
        precision: what is known of its parameters.
        contest: effects to distinguish, if there are any.
    """

    rehearsal: Rehearsal
    precision: Precision
    contest: Contest | None = None

    def confusion_with(self, motion: Motion) -> float:
        """Chance of confusing the rivals once ``motion`` has been recorded, over all pairs."""
        contest = self.contest
        assert contest is not None
        return contest.confusion(contest.contrasts(contest.at_hand + contest.sums([motion])))

    def added_by(self, tried: Tried) -> list[Array]:
        """The information (m, m) that each usual version of a design adds on the parameters.

        None on a model to which the trial is not fitted.
        """
        if self.is_fitted_to(tried.design):
            return [self.precision.of_motion(motion) for motion in tried.usual]
        return [np.zeros_like(self.precision.information)] * len(tried.usual)

    def is_fitted_to(self, design: Primitive) -> bool:
        """Whether the model is fitted to such a trial: with brakes on, if it has their effects."""
        return self.rehearsal.system.braked or not design.field

    def proposal(self, tried: Tried) -> Proposal:
        """The record of a design that has been tried."""
        system, design = self.rehearsal.system, tried.design
        device = system.model.device
        axes = device.coordinates
        added = self.added_by(tried)
        held = [i for i in range(len(axes)) if i not in design.strokes and not design.example]
        farther, faster = (
            tuple(axes[i].name for i in found) for found in find_beyond(design, self.rehearsal.seen)
        )
        return Proposal(
            sentence=describe(design, self.rehearsal.seen, device),
            seconds=design.seconds,
            moves=describe_moves(design, self.rehearsal),
            pose={axes[i].name: float(design.pose[i]) for i in held},
            like=design.example.trial if design.example else "",
            parts=design.parts,
            brakes=design.field,
            levels=dict(design.levels or {}),
            worth=tried.worth,
            information_gain=float(np.median([self.precision.gain(one) for one in added])),
            # Of a model that lacks something, uncertainties are not worth a forecast.
            sd=self._sd(added, design.seconds)
            if self.contest is None and self.is_fitted_to(design)
            else {},
            confusion=self._confusion(tried.usual),
            farther=farther,
            faster=faster,
        )

    def _sd(self, added: Sequence[Array], seconds: float) -> dict[str, ExpectedSd]:
        system, found = self.rehearsal.system, self.precision
        expected = [found.expect(one, seconds) for one in added]
        low = np.min([one.low for one in expected], axis=0)
        median = np.median([one.median for one in expected], axis=0)
        high = np.max([one.high for one in expected], axis=0)
        units = {q.name: q.unit for q in system.parameters}
        return {
            name: ExpectedSd(
                before=found.sd[k], after=median[k], low=low[k], high=high[k], unit=units[name]
            )
            for k, name in enumerate(found.names)
        }

    def _confusion(self, motions: Sequence[Motion]) -> tuple[ExpectedConfusion, ...]:
        if self.contest is None:
            return ()
        contest, axes = self.contest, self.rehearsal.system.coordinates
        sums = [contest.sums([motion]) for motion in motions]
        then = [contest.contrasts(contest.at_hand + new, new) for new in sums]
        weights, confusion = contest.weights(), contest.confusions(contest.now)
        chances = [contest.confusions(found) for found in then]
        return tuple(
            ExpectedConfusion(
                between=tuple(contest.rivals[i].name for i in pair),
                weight=weights[pair],
                before=confusion[pair],
                after=float(np.median([found[pair] for found in chances])),
                distance_before=before.distance,
                distance_after=float(np.median([found[pair].distance for found in then])),
                left={
                    axis: float(np.median([found[pair].left[k] for found in then]))
                    for k, axis in enumerate(axes)
                },
            )
            for pair, before in contest.now.items()
        )


def describe_moves(design: Primitive, rehearsal: Rehearsal) -> dict[str, Move]:
    """The record of the strokes of a design."""
    axes = rehearsal.system.model.device.coordinates
    return {
        axes[i].name: Move(
            low=stroke.low,
            high=stroke.high,
            slow=stroke.slow,
            fast=stroke.fast,
            rest_s=stroke.rest_s,
            unit=axes[i].unit,
        )
        for i, stroke in design.strokes.items()
    }
