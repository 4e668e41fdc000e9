"""Rivals that are the effect found and something more, of which the trials ask for nothing.

Friction that differs by direction is an offset of the drive and a part that grows with speed: it
never fits worse than the offset. Where it fits no better either, the offset is what is missing.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.candidates import Candidate
from bampipe.discover.chance import candidates_of
from bampipe.discover.columns import added_columns
from bampipe.discover.polish import FittedSet, reduce_set
from bampipe.discover.scorer import Score
from bampipe.trials.evidence import Evidence

Array = NDArray[np.float64]

_ROUNDING = 1e-6
"""Of what an effect adds, as a root mean square, that another one which contains it may miss."""


def idle_extensions(
    bench: Bench, found: FittedSet, name: str, axis: int, rivals: Collection[str]
) -> frozenset[str]:
    """Those of ``rivals`` that contain an effect and gain no more than replays are good for.

    Nor than their further constants would by chance.

    Args:
        bench: the session.
        found: the set with the effect, fitted; name: the effect; axis: where it helps most.
        rivals: effects that might be there in its place.
    """
    if not rivals:
        return frozenset()
    s, fewer = bench.settings, reduce_set(found, name)
    scores = bench.scores(fewer.recipe, fewer.evidence.p, [name, *rivals])
    if name not in scores:
        return frozenset()
    items = {c.name: c for c in candidates_of(fewer.recipe, list(scores))}
    added, _ = _parts(fewer.evidence, items[name], scores[name])
    samples = float(fewer.scorer.independent_samples[axis])

    def is_idle(rival: str) -> bool:
        more = items[rival].n_constants - items[name].n_constants
        gain = scores[rival].total - scores[name].total
        # Schwarz 1978, Annals of Statistics 6: so much each further constant must gain.
        asked = 0.5 * more * float(np.log(max(samples, 1.0)))
        return (
            more > 0
            and gain <= max(s.score_sd, s.replay_error * samples, asked)
            and _contains(_parts(fewer.evidence, items[rival], scores[rival])[1], added)
        )

    return frozenset(rival for rival in scores if rival != name and is_idle(rival))


def _parts(evidence: Evidence, item: Candidate, score: Score) -> tuple[Array, Array]:
    """What an effect adds to the residual, (N,), and that by each linear strength, (N, m)."""
    columns, changes = added_columns(evidence, item, score.values[list(item.searched_indices)])
    change = np.concatenate(changes).ravel()
    # Without linear strengths there are no columns to count the samples by.
    parts = np.concatenate(columns).reshape(change.size, len(item.linear_indices))
    return change + parts @ score.values[list(item.linear_indices)], parts


def _contains(parts: Array, added: Array) -> bool:
    """Whether some strengths of ``parts`` (N, m) make up ``added`` (N,)."""
    left = added - parts @ np.linalg.lstsq(parts, added, rcond=None)[0]
    return bool(np.linalg.norm(left) <= _ROUNDING * np.linalg.norm(added))
