"""Tests whether a filter's innovations are white, and whether they are independent of the inputs.

If the model is right, neither the past of the innovations nor any input predicts them (Kailath
1968; Mehra 1970). With tens of thousands of samples, a test of significance rejects every real
filter, so each test also reports the predictable fraction of the variance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from bampipe.arrays import Array
from bampipe.estimate.bounded import invert_scaled

_LAGS = 20
"""Lags of the whiteness test."""


@dataclass(frozen=True)
class InnovationTest:
    """Outcome of one test.

    Attributes:
        p_value: probability of a statistic as large by chance: Ljung-Box Q, F of the regression.
        share: predictable fraction of the variance, beyond that expected by chance.
    """

    p_value: float
    share: float


def average_stretches(values: Array, length: int) -> Array:
    """Means of consecutive stretches, (T // length, n); NaN if a value is missing.

    Args:
        values: (T, n); length: in samples.
    """
    count = len(values) // length
    return np.asarray(values[: count * length].reshape(count, length, -1).mean(axis=1))


def check_whiteness(records: Sequence[Array]) -> InnovationTest | None:
    """Ljung-Box test over records with gaps; None if there are too few values.

    Args:
        records: (K,) each, NaN at gaps; products span gaps, but never two records.
    """
    joined = np.concatenate(records)
    size = int(np.isfinite(joined).sum())
    if size < 5 * _LAGS:
        return None
    centre = float(np.nanmean(joined))
    variance = float(np.nanmean((joined - centre) ** 2))
    products, counts = np.zeros(_LAGS), np.zeros(_LAGS)
    for record in records:
        for k in range(1, min(_LAGS, len(record) - 1) + 1):
            product = (record[k:] - centre) * (record[:-k] - centre)
            found = np.isfinite(product)
            products[k - 1] += product[found].sum()
            counts[k - 1] += found.sum()
    if variance == 0.0 or counts.min() == 0.0:
        return None
    correlation = products / counts / variance
    statistic = float((size + 2.0) / size * np.sum(counts * correlation**2))
    share = float(np.sum(correlation**2 - 1.0 / counts))
    return InnovationTest(float(stats.chi2.sf(statistic, _LAGS)), min(max(share, 0.0), 1.0))


def check_independence(
    records: Sequence[Array], inputs: Sequence[Array], lags: Sequence[int]
) -> InnovationTest | None:
    """Regress innovations on present and past inputs; None if there is nothing to regress on.

    Inputs by a hand change slowly, so that a correlation at one lag appears at all lags. A joint
    regression on a few lags counts it once, unlike a table of cross-correlations. The records (K,)
    are NaN at gaps; of the inputs (K, m), constant ones are left out.
    """
    reach = max(lags)

    def tables() -> Iterator[Array]:
        """Yield, by record, the inputs at each lag and the innovation, (K', m + 1)."""
        for record, given in zip(records, inputs, strict=True):
            if len(record) > reach:
                shifted = [given[reach - lag : len(given) - lag] for lag in lags]
                table = np.concatenate([*shifted, record[reach:, None]], axis=1)
                yield table[np.isfinite(record[reach:])]

    # Keep sums instead of samples: the tables of a long session would dominate memory.
    count = sum(len(table) for table in tables())
    if count == 0:
        return None
    mean = sum(table.sum(axis=0) for table in tables()) / count
    products = sum((table - mean).T @ (table - mean) for table in tables())
    total = float(products[-1, -1])
    changing = np.flatnonzero(np.diag(products)[:-1] > 0.0)
    m = changing.size
    if m == 0 or count < 10 * m or total == 0.0:
        return None
    moment = products[changing, -1]
    explained = float(moment @ invert_scaled(products[np.ix_(changing, changing)]) @ moment)
    rest = count - m - 1
    statistic = (explained / m) / max((total - explained) / rest, 1e-300)
    share = explained / total - m / count
    return InnovationTest(float(stats.f.sf(statistic, m, rest)), min(max(share, 0.0), 1.0))
