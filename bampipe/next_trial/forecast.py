"""What the proposed trials are expected to give, as it is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.choice import RankedDesign
from bampipe.next_trial.discrimination import Comparison
from bampipe.next_trial.motion import Rehearsal
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import Primitive, find_beyond
from bampipe.next_trial.sensitivity import Detectability
from bampipe.next_trial.words import describe
from bampipe.results.next import ExpectedSd, Move, Proposal, Purpose


@dataclass(frozen=True)
class Forecast:
    """What is needed to say what a design gives.

    Attributes:
        rehearsal: the fitted model that designs are tried with.
        precision: what is known of its parameters.
        comparison: alternatives to distinguish, if that is the purpose.
        detectability: of the effects of the library, if that is.
    """

    rehearsal: Rehearsal
    precision: Precision
    comparison: Comparison | None = None
    detectability: Detectability | None = None

    @property
    def purpose(self) -> Purpose:
        """What a trial is for."""
        if self.comparison is not None:
            return "decision"
        return "precision" if self.detectability is None else "sensitivity"

    def added_by(self, ranked: RankedDesign) -> list[Array]:
        """The information (m, m) that each usual version of a design adds on the parameters.

        None on a model to which the trial is not fitted.
        """
        if self.is_fitted_to(ranked.design):
            return [self.precision.of_motion(motion) for motion in ranked.expected_motions]
        return [np.zeros_like(self.precision.information)] * len(ranked.expected_motions)

    def is_fitted_to(self, design: Primitive) -> bool:
        """Whether the model is fitted to such a trial: with brakes on, if it has their effects."""
        return self.rehearsal.system.braked or not design.field

    def proposal(self, ranked: RankedDesign) -> Proposal:
        """The record of a design that has been ranked."""
        system, design = self.rehearsal.system, ranked.design
        device = system.model.device
        axes = device.coordinates
        added = self.added_by(ranked)
        moved = set(design.strokes) or set(range(len(axes)))
        held = [i for i in range(len(axes)) if i not in moved]
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
            worth=ranked.utility,
            information_gain=float(np.median([self.precision.gain(one) for one in added])),
            # Of a model that lacks something, uncertainties are not worth a forecast.
            sd=self._sd(added, design.seconds)
            if self.comparison is None and self.is_fitted_to(design)
            else {},
            confusion=self.comparison.expect(ranked.expected_motions) if self.comparison else (),
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


def describe_moves(design: Primitive, rehearsal: Rehearsal) -> dict[str, Move]:
    """The record of the strokes of a design."""
    axes = rehearsal.system.model.device.coordinates
    if design.series is not None:
        extent = zip(axes, *design.series.extent[:3], strict=True)
        return {
            axis.name: Move(low=low, high=high, slow=fast, fast=fast, unit=axis.unit)
            for axis, low, high, fast in extent
        }
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
