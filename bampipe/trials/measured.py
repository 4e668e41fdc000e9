"""The trials of a session with everything that lies between samples and residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bampipe.data.run_folder import RunFolder
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.identify import InputTiming
from bampipe.trials.folds import Folds
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion
from bampipe.trials.reading import (
    free_trials,
    held_out_trials,
    read_band,
    read_kinematics,
    read_motions,
    read_sensors,
)
from bampipe.trials.sensors import Sensors

SHORTEST_BLOCK_S = 0.8
"""Of a record that is left out in blocks, as it is the only one, s."""
BLOCK_PERIODS = 10.0
"""Or so many periods of the lowest cut-off, where that is longer: blocks must be independent."""
FEWEST_BLOCKS, MOST_BLOCKS = 4, 40


@dataclass(frozen=True)
class MeasuredTrials:
    """What identify, validate and diagnose share: the trials, and how they came to be.

    Attributes:
        motions: the free trials, then those in a viscous field.
        sensors: that read them; kinematics: the filters they went through.
        band: in which residuals are compared.
        folds: which a fit may see, and which are left out together.
        in_blocks: whether the motions are blocks of the only trial.
    """

    motions: Sequence[Motion]
    sensors: Sensors
    kinematics: Kinematics
    band: Band
    folds: Folds
    in_blocks: bool = False


def cut_blocks(motion: Motion, band: Band) -> list[Motion]:
    """Cut a motion into blocks with gaps of one period of the lowest cut-off between them.

    Each carries the margins that its low-pass needs, so that what is kept of the blocks tiles the
    record; the gaps keep what is fitted from reaching into what is judged.

    Returns:
        The blocks; the motion alone where it is too short for `FEWEST_BLOCKS`.
    """
    slowest = min(band.cutoff_hz)
    kept = band.kept(len(motion.t))
    length_s = max(SHORTEST_BLOCK_S, BLOCK_PERIODS / slowest)
    count = min(int(len(kept) * band.step / band.rate_hz / length_s), MOST_BLOCKS)
    if count < FEWEST_BLOCKS:
        return [motion]
    margin, gap = int(band.margin_s * band.rate_hz), int(0.5 * band.rate_hz / slowest)
    edges = np.linspace(kept[0], kept[-1] + 1, count + 1).astype(int)
    blocks = []
    for first, end in pairwise(edges):
        rows = slice(int(first) - margin + gap, int(end) + margin - gap)
        blocks.append(
            Motion(
                f"{motion.trial_id}@{motion.t[first]:.1f}s",
                motion.t[rows], motion.q[rows], motion.qd[rows], motion.qdd[rows],
                motion.qd_sd[rows],
                {name: values[rows] for name, values in motion.channels.items()},
            )
        )  # fmt: skip
    return blocks


def read_measured_trials(
    run: RunFolder, system: System, *, every_input: bool = False, timing: InputTiming | None = None
) -> MeasuredTrials:
    """Read the trials of a run folder for a model.

    What brakes do is no part of a model without an effect of theirs: it is not fitted to trials
    in a viscous field, but judged by them.

    Args:
        run: the run folder; system: the model.
        every_input: as in `read_motion`.
        timing: time by which inputs were sampled after positions, as identified. It is taken off
            where it is known to be less than half a sample, its limit. At the limit it stands for
            a delay or lag that the model lacks, and taking off a part would hide what it is.

    Raises:
        InputError: there is no free trial, or a file or column is missing.
    """
    names = free_trials(run, braked=True)
    band = read_band(run, system)
    late_s = 0.0
    if timing is not None and abs(timing.estimate) + 2.0 * timing.sd < 0.5 / band.rate_hz:
        late_s = timing.estimate
    fitted = free_trials(run, fitted=True, braked=system.braked)
    motions = read_motions(run, system, braked=True, every_input=every_input, late_s=late_s)
    trials = MeasuredTrials(
        motions,
        read_sensors(run, system),
        read_kinematics(run, system),
        band,
        Folds.of_trials(names, held_out_trials(run), fitted),
    )
    if len(names) > 1:
        return trials
    blocks = cut_blocks(motions[0], band)
    if len(blocks) == 1:
        return trials
    names = tuple(block.trial_id for block in blocks)
    return replace(trials, motions=blocks, folds=Folds.of_trials(names, (), names), in_blocks=True)
