"""The trials of a session, with the sensors, filters, band and folds behind their residuals."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bampipe.data.run_folder import RunFolder
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.identify import InputTiming
from bampipe.trials.folds import HELD_OUT, Folds
from bampipe.trials.kept import MOST_OF_TRIALS, KeptItems
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
"""Shortest block of a record that is the only one and is left out in blocks, s."""
BLOCK_PERIODS = 10.0
"""Shortest block in periods of the lowest cut-off, if longer: blocks must be independent."""
FEWEST_BLOCKS, MOST_BLOCKS = 4, 40


@dataclass(frozen=True)
class MeasuredTrials:
    """The trials that identify, validate and diagnose share, with their sensors and filters.

    Attributes:
        motions: the free trials, then those in a viscous field.
        sensors: the sensors that read them; kinematics: the filters that they passed.
        folds: which trials a fit may see, and which are left out together.
        blocks: number of motions that are blocks of the only trial that is not held out.
        late_s: input delay that has been compensated; limit_s: its largest size, zero if it is
            not estimated.
        timed: whether each model fits a delay of its own.
    """

    motions: Sequence[Motion]
    sensors: Sensors
    kinematics: Kinematics
    band: Band
    folds: Folds
    blocks: int = 0
    late_s: float = 0.0
    limit_s: float = 0.0
    timed: bool = False

    @property
    def timing(self) -> tuple[float, float]:
        """Smallest and largest change of the input delay from the compensated one, s."""
        if not self.timed:
            return (0.0, 0.0)
        return (-self.limit_s - self.late_s, self.limit_s - self.late_s)

    def with_input_timing(self, late_s: float) -> "MeasuredTrials":
        """The same trials, compensated by ``late_s`` instead of `late_s`."""
        if late_s == self.late_s:
            return self
        moved = (m.with_input_timing(late_s - self.late_s) for m in self.motions)
        return replace(self, motions=KeptItems(moved, MOST_OF_TRIALS), late_s=late_s)

    def subset(self, chosen: Sequence[int]) -> "MeasuredTrials":
        """Some of the trials, given by number."""
        if len(chosen) == len(self.motions):
            return self
        motions = KeptItems((self.motions[k] for k in chosen), MOST_OF_TRIALS)
        return replace(self, motions=motions, folds=self.folds.subset(chosen))

    @property
    def weighed(self) -> list[Motion]:
        """All trials by which effects are weighed: braked ones too, but none held out."""
        groups = self.folds.groups
        return [m for m, group in zip(self.motions, groups, strict=True) if group != HELD_OUT]


def trial_of_block(name: str) -> str:
    """Name of the trial from which a block was cut; ``name`` itself if it is not a block."""
    return re.sub(r"@\d+\.\ds$", "", name)


def cut_blocks(motion: Motion, band: Band) -> list[Motion]:
    """Cut a motion into blocks with gaps of one period of the lowest cut-off between them.

    Each block has the margins of its low-pass, so that the kept samples tile the record; the gaps
    separate fitted samples from judged ones.

    Returns:
        The blocks; the motion alone if it is too short for `FEWEST_BLOCKS`.
    """
    slowest = min(band.cutoff_hz)
    kept = band.thinned_rows(len(motion.t))
    length_s = max(SHORTEST_BLOCK_S, BLOCK_PERIODS / slowest)
    count = min(int(len(kept) * band.step / band.rate_hz / length_s), MOST_BLOCKS)
    if count < FEWEST_BLOCKS:
        return [motion]
    margin, gap = int(band.margin_s * band.rate_hz), int(0.5 * band.rate_hz / slowest)
    edges = np.linspace(kept[0], kept[-1] + 1, count + 1).astype(int)
    blocks = []
    for first, end in pairwise(edges):
        part = motion.rows(slice(int(first) - margin + gap, int(end) + margin - gap))
        blocks.append(replace(part, trial_id=f"{motion.trial_id}@{motion.t[first]:.1f}s"))
    return blocks


def read_measured_trials(
    run: RunFolder, system: System, *, every_input: bool = False, timing: InputTiming | None = None
) -> MeasuredTrials:
    """Read the trials of a run folder for a model.

    A model without effects of the brakes is not fitted to trials in a viscous field, but judged by
    them. ``every_input`` is as in `read_motion`. Of the input delay ``timing``, the part that
    minimises the residual is compensated.

    Raises:
        InputError: there is no free trial, or a file or column is missing.
    """
    names = free_trials(run, braked=True)
    band = read_band(run, system)
    late_s = timing.of_residual if timing is not None else 0.0
    fitted, held_out = free_trials(run, fitted=True, braked=system.braked), held_out_trials(run)
    motions = read_motions(run, system, braked=True, every_input=every_input, late_s=late_s)
    trials = MeasuredTrials(
        motions,
        read_sensors(run, system),
        read_kinematics(run, system),
        band,
        Folds.of_trials(names, held_out, fitted),
        late_s=late_s,
        limit_s=timing.limit if timing is not None else 0.0,
        timed=timing is not None and timing.limit > 0.0,
    )
    alone = [k for k, name in enumerate(names) if name not in held_out]
    blocks = cut_blocks(motions[alone[0]], band) if len(alone) == 1 else []
    if len(blocks) < 2:
        return trials
    parted = [*motions]
    parted[alone[0] : alone[0] + 1] = blocks
    may_fit = [block.trial_id for block in blocks] if trials.folds.fitted[alone[0]] else []
    folds = Folds.of_trials([motion.trial_id for motion in parted], held_out, may_fit)
    return replace(trials, motions=parted, folds=folds, blocks=len(blocks))
