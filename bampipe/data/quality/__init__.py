"""Quality rules on one trial: repair what is safe and say so, refuse what is not.

:func:`clean` takes the raw columns of a trial and returns them in SI units. A trial that cannot
be trusted raises :class:`bampipe.errors.InputError`, whose line is the reason for which the
trial is set aside. Whatever was changed or left out is a sentence in ``repairs``; what was only
noticed is a sentence in ``notes``. Nothing is altered without one.
"""

from __future__ import annotations

from bampipe.data.quality.channels import (
    fill_missing,
    refuse_frozen,
    refuse_other_units,
    to_si,
    to_signed,
)
from bampipe.data.quality.clock import (
    cut_stretch,
    drop_backward_stamps,
    keep_fresh_rows,
    keep_longest_stretch,
    note_clock,
    rate_of,
    refuse_length,
    time_to_seconds,
)
from bampipe.data.quality.encoders import (
    check_velocity,
    integrate,
    interpolate_jumps,
    refuse_fractions,
    unwrap,
)
from bampipe.data.quality.faulty_readings import (
    interpolate_spikes,
    leave_out_rails,
    note_dead_stretches,
)
from bampipe.data.quality.motion import refuse_wrong_brakes, refuse_wrong_motion
from bampipe.data.quality.table import CleaningLimits, CleanTrial, TrialTable
from bampipe.data.quality.thinning import thin, thinning_factor
from bampipe.data.readers import RawTrial
from bampipe.data.session import Session, TrialEntry

__all__ = ["CleanTrial", "CleaningLimits", "clean", "thin", "thinning_factor"]


def clean(raw: RawTrial, session: Session, entry: TrialEntry, limits: CleaningLimits) -> CleanTrial:
    """Check and repair one trial and bring it to SI units.

    The arrays of ``raw`` are used up.

    Args:
        raw: from :func:`bampipe.data.readers.read_trial`.
        session: what its columns mean.
        entry: what kind of trial it is.
        limits: what counts as sound.

    Raises:
        InputError: the trial must be set aside; says why, and where in the file.
    """
    table = TrialTable(raw, session, entry, limits)
    refuse_other_units(table, raw.units)
    keep_fresh_rows(table)
    time_to_seconds(table)
    drop_backward_stamps(table)
    cut_stretch(table)
    keep_longest_stretch(table)
    for encoder in session.encoders:
        refuse_fractions(table, encoder)
        to_signed(table, encoder)
        unwrap(table, encoder)
    for channel in session.channels:
        to_signed(table, channel)
    fill_missing(table)
    interpolate_spikes(table)
    for encoder in session.encoders:
        integrate(table, encoder)
        interpolate_jumps(table, encoder)
    table.t -= table.t[0]
    refuse_length(table)
    note_clock(table)
    for encoder in session.encoders:
        check_velocity(table, encoder)
    if session.force is not None and session.force.volts:
        for column in session.force.columns:
            refuse_frozen(table, column)
    note_dead_stretches(table)
    leave_out_rails(table)
    columns = to_si(table)
    refuse_wrong_motion(table, columns)
    refuse_wrong_brakes(table, columns)
    return CleanTrial(table.t, columns, rate_of(table.t), table.repairs, table.notes, table.dead)
