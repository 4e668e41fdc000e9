"""What hangs on one second or one trial: candidates scored again without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import Candidate
from bampipe.discover.scorer import Score, Scorer
from bampipe.results.diagnose import Stretch
from bampipe.trials.evidence import Evidence
from bampipe.trials.measured import trial_of_block

Array = NDArray[np.float64]

SECOND_S = 1.0


@dataclass(frozen=True)
class SampleRange:
    """Samples of one trial that belong together.

    Attributes:
        trial: its number.
        first, last: rows of the thinned residual, the last one excluded.
        stretch: the same in words: name of the trial, and from when to when.
    """

    trial: int
    first: int
    last: int
    stretch: Stretch


def largest_second(evidence: Evidence, by_sample: Sequence[Array]) -> SampleRange:
    """The second in which ``by_sample``, by trial, each (K,), adds up to most."""
    length = max(1, round(SECOND_S * evidence.band.rate_hz / evidence.band.step))
    best, at = -np.inf, (0, 0)
    for trial, values in enumerate(by_sample):
        if not len(values):
            continue
        sums = np.convolve(values, np.ones(min(length, len(values))), mode="valid")
        row = int(np.argmax(sums))
        if sums[row] > best:
            best, at = float(sums[row]), (trial, row)
    trial, row = at
    last = min(row + length, len(by_sample[trial]))
    return _range_of(evidence, trial, row, last)


def largest_trial(evidence: Evidence, by_sample: Sequence[Array]) -> SampleRange:
    """The trial in which ``by_sample``, by trial, each (K,), adds up to most."""
    trial = int(np.argmax([values.sum() for values in by_sample]))
    return _range_of(evidence, trial, 0, len(by_sample[trial]))


def _range_of(evidence: Evidence, trial: int, first: int, last: int) -> SampleRange:
    motion = evidence.motions[trial]
    t = motion.t[evidence.band.thinned_rows(len(motion.t))]
    stretch = Stretch(trial_id=trial_of_block(motion.trial_id), t_start=t[first], t_end=t[last - 1])
    return SampleRange(trial, first, last, stretch)


def leave_out(evidence: Evidence, samples: SampleRange) -> Evidence:
    """The evidence as if ``samples`` had not been recorded; the fit stays."""

    def cleared(parts: Sequence[NDArray[Any]]) -> tuple[NDArray[Any], ...]:
        emptied = parts[samples.trial].copy()
        emptied[samples.first : samples.last] = 0
        return (*parts[: samples.trial], emptied, *parts[samples.trial + 1 :])

    return replace(
        evidence,
        residual=cleared(evidence.residual),
        jacobian=cleared(evidence.jacobian),
        used=cleared(evidence.used),
        by_timing=cleared(evidence.by_timing) if evidence.by_timing else (),
    )


def error_without_second(evidence: Evidence, axis: int) -> tuple[SampleRange, float]:
    """The second with the largest held-out residual of an axis, and the error but for it."""
    judged = [k for k, counts in enumerate(evidence.folds.judged) if counts]
    squares = [
        np.square(evidence.held_out_residual(k)[:, axis])
        if k in judged
        else np.zeros(len(evidence.residual[k]))
        for k in range(len(evidence.motions))
    ]
    worst = largest_second(evidence, squares)
    rows = slice(worst.first, worst.last)
    left = sum(float(x.sum()) for x in squares) - float(squares[worst.trial][rows].sum())
    count = evidence.sums.count[judged, axis].sum() - evidence.used[worst.trial][rows, axis].sum()
    return worst, float(np.sqrt(max(left, 0.0) / max(count, 1.0)))


def score_without(
    evidence: Evidence, items: Sequence[Candidate], scores: Sequence[Score], samples: SampleRange
) -> dict[str, Score]:
    """Score candidates as if ``samples`` had not been recorded, their shapes held.

    Args:
        evidence: of the model without any of them.
        items: candidates; scores: theirs, in the same order.
        samples: what is left out.
    """
    scorer = Scorer(leave_out(evidence, samples))
    found = {
        item.name: scorer.score_at(item, score.values)
        for item, score in zip(items, scores, strict=True)
    }
    return {name: score for name, score in found.items() if score is not None}
