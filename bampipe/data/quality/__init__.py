"""Quality rules on one trial: repair what is safe and say so, refuse what is not.

:func:`clean` takes the raw columns of a trial and returns them in SI units. A trial that cannot
be trusted raises :class:`bampipe.errors.InputError`, whose line is the reason for which the
trial is set aside. Whatever was changed or left out is a sentence in ``repairs``; what was only
noticed is a sentence in ``notes``. Nothing is altered without one.
"""

from bampipe.data.quality import channels, clock, encoders, faulty_readings
from bampipe.data.quality.table import CleaningLimits, CleanTrial, TrialTable, thin, thinning_factor
from bampipe.data.readers.trial import RawTrial
from bampipe.data.session import Session, TrialEntry

__all__ = ["CleanTrial", "CleaningLimits", "clean", "thin", "thinning_factor"]


def clean(raw: RawTrial, session: Session, entry: TrialEntry, limits: CleaningLimits) -> CleanTrial:
    """Check and repair one trial and bring it to SI units.

    The arrays of ``raw``, from :func:`bampipe.data.readers.read_trial`, are used up.

    Raises:
        InputError: the trial must be set aside; says why, and where in the file.
    """
    table = TrialTable(raw, session, entry, limits)
    channels.to_declared_units(table, raw.units)
    clock.keep_fresh_rows(table)
    clock.time_to_seconds(table)
    clock.drop_backward_stamps(table)
    clock.cut_stretch(table)
    clock.keep_longest_stretch(table)
    for encoder in session.encoders:
        encoders.refuse_fractions(table, encoder)
        channels.to_signed(table, encoder)
        encoders.unwrap(table, encoder)
    for channel in session.channels:
        channels.to_signed(table, channel)
    channels.fill_missing(table)
    faulty_readings.interpolate_spikes(table)
    for encoder in session.encoders:
        encoders.integrate(table, encoder)
        encoders.interpolate_jumps(table, encoder)
    table.t -= table.t[0]
    clock.refuse_length(table)
    clock.note_clock(table)
    for encoder in session.encoders:
        encoders.check_velocity(table, encoder)
    if session.force is not None and session.force.volts:
        for column in session.force.columns:
            channels.refuse_frozen(table, column)
    faulty_readings.note_dead_stretches(table)
    faulty_readings.leave_out_rails(table)
    faulty_readings.refuse_new_zero(table)
    columns = channels.to_si(table)
    encoders.refuse_wrong_motion(table, columns)
    encoders.refuse_wrong_brakes(table, columns)
    rate = clock.rate_of(table.t)
    return CleanTrial(table.t, columns, rate, table.repairs, table.notes, table.dead, {*raw.units})
