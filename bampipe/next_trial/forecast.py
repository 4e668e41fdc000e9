"""The expected gain of a proposed trial, as it is stored."""

from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.design_sentence import describe_design
from bampipe.next_trial.discrimination import Comparison
from bampipe.next_trial.precision import Expected, Precision
from bampipe.next_trial.primitives import Primitive, find_beyond
from bampipe.next_trial.ranking import RankedDesign
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.next_trial.sensitivity import Detectability
from bampipe.results.next import ExpectedSd, Move, Proposal, Purpose


@dataclass(frozen=True)
class Forecast:
    """The models from which the gain of a design is forecast.

    There are alternatives to distinguish, or effects of the library to detect, if that is the
    purpose.
    """

    rehearsal: Rehearsal
    precision: Precision
    comparison: Comparison | None = None
    detectability: Detectability | None = None

    @property
    def purpose(self) -> Purpose:
        """The purpose of the trial."""
        if self.comparison is not None:
            return "decision"
        return "precision" if self.detectability is None else "sensitivity"

    def added_by(self, ranked: RankedDesign) -> list[Array]:
        """Return the information (m, m) on the parameters from each usual version of a design.

        It is zero if the model is not fitted to such a trial.
        """
        nothing, is_fitted = self.precision.information * 0.0, self.is_fitted_to(ranked.design)
        motions = ranked.expected_motions
        return [self.precision.of_motion(one) if is_fitted else nothing for one in motions]

    def is_fitted_to(self, design: Primitive) -> bool:
        """Return whether the model is fitted to such a trial; with brakes on, if it has brakes."""
        return self.rehearsal.system.braked or not design.field

    def proposal(self, ranked: RankedDesign) -> Proposal:
        """Return the record of a design that has been ranked."""
        device, seen = self.rehearsal.system.model.device, self.rehearsal.seen
        design = ranked.design
        names, added = [axis.name for axis in device.coordinates], self.added_by(ranked)
        moved = set(design.strokes) or range(len(names))
        farther, faster = (tuple(names[i] for i in some) for some in find_beyond(design, seen))
        # If the model lacks something, uncertainties cannot be forecast.
        has_forecast = self.comparison is None and self.is_fitted_to(design)
        return Proposal(
            sentence=describe_design(design, seen, device),
            seconds=design.seconds,
            moves=describe_moves(design, self.rehearsal),
            pose={n: float(design.pose[i]) for i, n in enumerate(names) if i not in moved},
            like=design.example.trial if design.example else "",
            parts=design.parts,
            brakes=design.field,
            levels=dict(design.levels or {}),
            worth=ranked.utility,
            information_gain=float(np.median([self.precision.gain(one) for one in added])),
            sd=self.tabulate_sd(
                *(self.precision.expect(one, design.seconds) for one in added if has_forecast)
            ),
            confusion=self.comparison.expect(ranked.expected_motions) if self.comparison else (),
            farther=farther,
            faster=faster,
        )

    def tabulate_sd(self, *every: Expected) -> dict[str, ExpectedSd]:
        """Return the record of standard deviations expected of versions of a trial, if any."""
        if not every:
            return {}
        units = {q.name: q.unit for q in self.rehearsal.system.parameters}
        low = np.min([one.low for one in every], axis=0)
        medians = np.median([one.median for one in every], axis=0)
        high = np.max([one.high for one in every], axis=0)
        columns = (self.precision.names, self.precision.sd, low, medians, high)
        return {
            name: ExpectedSd(before=now, after=median, low=low, high=high, unit=units[name])
            for name, now, low, median, high in zip(*columns, strict=True)
        }


def describe_moves(design: Primitive, rehearsal: Rehearsal) -> dict[str, Move]:
    """Return the record of the strokes of a design."""
    axes = rehearsal.system.model.device.coordinates
    return {axes[i].name: Move.of(one, unit=axes[i].unit) for i, one in design.moves.items()}
