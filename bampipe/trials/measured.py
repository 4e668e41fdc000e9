"""The trials of a session with everything that lies between samples and residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class MeasuredTrials:
    """What identify, validate and diagnose share: the trials, and how they came to be.

    Attributes:
        motions: the free trials, then those in a viscous field.
        sensors: that read them; kinematics: the filters they went through.
        band: in which residuals are compared.
        folds: which a fit may see, and which are left out together.
    """

    motions: Sequence[Motion]
    sensors: Sensors
    kinematics: Kinematics
    band: Band
    folds: Folds


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
    return MeasuredTrials(
        read_motions(run, system, braked=True, every_input=every_input, late_s=late_s),
        read_sensors(run, system),
        read_kinematics(run, system),
        band,
        Folds.of_trials(names, held_out_trials(run), fitted),
    )
