"""Odds of effects by their scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bampipe.discover.settings import Settings


def odds_by_score(
    scores: Mapping[str, float],
    s: Settings,
    widening: float = 1.0,
    log_prior: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Odds by log likelihood, tempered by what the scores are good for: no replay is perfect.

    Args:
        scores: by effect, in log likelihood.
        s: how far scores err.
        widening: of that error, where replays say that it is larger.
        log_prior: by effect, what is known of it beside the trials; 0 where left out.
    """
    top, known = max(scores.values()), log_prior or {}
    scale = widening * np.hypot(s.score_sd, s.score_error * top)
    weights = {
        name: float(np.exp((score - top) / scale + known.get(name, 0.0)))
        for name, score in scores.items()
    }
    total = sum(weights.values())
    return {name: weight / total for name, weight in weights.items()}
