"""Whether a verdict would be another one in another band.

A low-pass may hide what acts above it, and lets in what the sensors do not resolve.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.scorer import Scorer
from bampipe.discover.settings import Settings
from bampipe.estimate.low_pass import Band
from bampipe.estimate.simulation import Runaway
from bampipe.results.diagnose import OtherBand
from bampipe.results.standing import standing
from bampipe.trials.band import LEAST_HZ
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import FLOOR_SEED, NoiseFloor, replay_evidence
from bampipe.trials.replay import StandIn

Array = NDArray[np.float64]


def judge_in_other_band(
    trials: MeasuredTrials, evidence: Evidence, p: Array, settings: Settings
) -> tuple[OtherBand | None, ...]:
    """Hold the final model against its floor in a wider band, else in a narrower one.

    Args:
        trials: the measured trials; evidence: the final model, fitted.
        p: parameters (n_p,) with which it is replayed.
        settings: of the diagnosis.

    Returns:
        By axis; None where neither band lies between the least one and the motion's bandwidth, or
        the model cannot be replayed.
    """
    known, count = trials.band, len(evidence.system.coordinates)
    motion_hz = [trials.kinematics.axes[name].bandwidth_hz for name in evidence.system.coordinates]
    cutoffs, ratio = [], settings.other_band_ratio
    for cutoff, most in zip(known.cutoff_hz, motion_hz, strict=True):
        wider, narrower = ratio * cutoff, cutoff / ratio
        fits = wider <= min(most, 0.2 * known.rate_hz)
        cutoffs.append(wider if fits else narrower if narrower >= LEAST_HZ else cutoff)
    if np.allclose(cutoffs, known.cutoff_hz):
        return (None,) * count
    band = Band(known.rate_hz, tuple(cutoffs), known.margin_s)
    measured = gather_evidence(evidence.system, trials.motions, band, evidence.p, trials.folds)
    error = Scorer(measured).base_error
    stand_in = StandIn(evidence.system, p, trials.motions, trials.sensors.rate_hz)
    try:
        replays = [
            replay_evidence(
                stand_in, evidence.system, measured.p, trials.sensors, trials.kinematics, band,
                trials.folds, (settings.seed, FLOOR_SEED, k),
            )
            for k in range(settings.other_band_replicates)
        ]  # fmt: skip
    except Runaway:
        return (None,) * count
    floor = NoiseFloor.of_errors([Scorer(replay).base_error for replay in replays])
    return tuple(
        None
        if cutoff == was
        else OtherBand(
            cutoff_hz=cutoff,
            rmse=error[i],
            noise_floor=floor.level[i],
            standing=standing(float(error[i]), float(floor.level[i]), float(floor.sd[i])),
        )
        for i, (cutoff, was) in enumerate(zip(cutoffs, known.cutoff_hz, strict=True))
    )
