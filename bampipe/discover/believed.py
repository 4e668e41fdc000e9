"""What speaks for one of two effects that fit alike: fewer numbers, and likelier ones."""

from __future__ import annotations

import numpy as np

from bampipe.discover.candidates import Candidate
from bampipe.discover.columns import added_columns
from bampipe.discover.scorer import Score
from bampipe.trials.evidence import Evidence

_ROUNDING = 1e-6
"""Of what a strength adds, as a root mean square, that parameters of the model may miss of it."""


def count_new_constants(evidence: Evidence, item: Candidate, score: Score) -> int:
    """How many numbers an effect adds that are not in the model already.

    The offset of a spring is none where the model has one, however the two are called.

    Args:
        evidence: the model without it, fitted; item: the effect; score: of it against that.
    """
    columns, _ = added_columns(evidence, item, score.values[list(item.searched_indices)])
    count = len(item.linear_indices)
    if not count:
        return item.n_constants
    added = np.concatenate([c.reshape(-1, count) for c in columns])
    known = np.concatenate([x.reshape(-1, x.shape[-1]) for x in evidence.jacobian])
    added, known = (x / np.maximum(np.linalg.norm(x, axis=0), 1e-300) for x in (added, known))
    left = added - known @ np.linalg.lstsq(known, added, rcond=None)[0]
    new = int(np.linalg.matrix_rank(left, tol=_ROUNDING))
    return len(item.searched_indices) + new


def log_prior(item: Candidate, score: Score) -> float:
    """How far the strengths of an effect are from what its file expects, as a log density, up to 0.

    Pure numbers alone: that the counts of an encoder are a tenth wrong is hard to believe of any
    machine, but how strong a spring is goes with its size. Within one standard deviation nothing
    speaks against an effect.
    """
    pure = [i for i, q in enumerate(item.parameters) if q.strength and not q.unit and q.sd > 0.0]
    z = [(score.values[i] - item.parameters[i].prior) / item.parameters[i].sd for i in pure]
    return -0.5 * float(sum(max(value**2 - 1.0, 0.0) for value in z))
