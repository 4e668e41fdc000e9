"""A trial while it is being cleaned, the limits of a sound one, and the thinning of it."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import find_runs
from bampipe.data.readers.trial import RawTrial
from bampipe.data.refusals import refusal
from bampipe.data.session import Session, TrialEntry
from bampipe.errors import InputError
from bampipe.results.ingest import DeadStretch
from bampipe.schema import STRICT, Count, NotNegative

_HELD = 0.5
"""Share of readings that repeat the one before from which on a channel is a set-point that is held:
a low-pass would make a ramp of its steps."""
_HALF_LENGTH = 10
"""Samples that are kept on either side of the low-pass."""
_HALF_POWER, _KAISER = 1.04, 5.0
"""Cut-off over half the new rate at which half of the power passes there, of a Kaiser window: what
folds makes up for what is taken off, and white noise stays white, as sensors are taken to be."""


@checked_dataclass(frozen=True, config=STRICT)
class CleaningLimits:
    """Limits within which a trial counts as sound.

    Attributes:
        shortest_s: a trial shorter than this, s, is set aside.
        gap_s: longest gap in the time stamps that is left to resampling, s.
        sound_share: least share of the trial that the longest stretch between gaps must hold.
        dropped_share: largest share of rows that may be dropped for their time stamps.
        nan_run: longest run of missing samples that is interpolated.
        nan_share: largest share of missing samples in a channel.
        saturated_share: largest share of samples of a locked trial at the rail of a force channel;
            of others, what is read at a rail is left out.
        frozen_share: largest share of the trial that a force channel may stand still.
        held_axes: an axis may stand still while others move, as motors can hold it.
        still_rad, still_m: a free trial moves more than this, rad or m, on some axis.
        locked_rad, locked_m: a locked axis moves less than this, rad or m.
        locked_steps: a locked axis deflects by at least this many encoder steps.
        brake_on: a brake command above this, N.m or N, makes a trial not free.
    """

    shortest_s: NotNegative = 1.0
    gap_s: NotNegative = 0.25
    sound_share: NotNegative = 0.6
    dropped_share: NotNegative = 0.01
    nan_run: Count = 5
    nan_share: NotNegative = 0.01
    saturated_share: NotNegative = 0.01
    frozen_share: NotNegative = 0.2
    held_axes: bool = False
    still_rad: NotNegative = 0.005
    still_m: NotNegative = 0.0005
    locked_rad: NotNegative = 0.2
    locked_m: NotNegative = 0.02
    locked_steps: Count = 5
    brake_on: NotNegative = 0.5


@dataclass
class CleanTrial:
    """A sound trial.

    Attributes:
        t: (T,) s, strictly increasing from 0.
        columns: (T,) a column in SI units: q_<axis>, force_<component>, brake_<axis>, channels.
        sample_rate: Hz, by its mean step.
        repairs: what was changed or left out.
        notes: what was noticed and left as it is.
        dead: stretches over which a sensor was dead, that are left out of everything.
        stated: columns of the file that it gives a unit.
    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    sample_rate: float
    repairs: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    dead: list[DeadStretch] = field(default_factory=list)
    stated: Collection[str] = ()


class TrialTable:
    """The columns of a trial while they are being cleaned, each row with its number in the file."""

    def __init__(
        self, raw: RawTrial, session: Session, entry: TrialEntry, limits: CleaningLimits
    ) -> None:
        self.columns = raw.columns
        self.session = session
        self.entry = entry
        self.limits = limits
        self.clock = session.clock.column
        self.rows = raw.rows
        self.repairs = list(raw.notes)
        self.notes = list(raw.remarks)
        self.dead: list[DeadStretch] = []

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def t(self) -> np.ndarray:
        """Time stamps (T,), s once :func:`time_to_seconds` has run."""
        return self.columns[self.clock]

    @t.setter
    def t(self, seconds: np.ndarray) -> None:
        self.columns[self.clock] = seconds

    @property
    def inputs(self) -> list[str]:
        """Columns of the force and of other channels, each once."""
        force = self.session.force.columns if self.session.force is not None else ()
        return list(dict.fromkeys([*force, *(c.column for c in self.session.channels)]))

    def keep(self, which: np.ndarray | slice) -> None:
        """Keep only some rows; one column at a time, to hold little twice."""
        self.rows = self.rows[which].copy()
        for name in self.columns:
            self.columns[name] = self.columns[name][which].copy()

    def fault(
        self, name: str, column: str = "", at: int | None = None, /, **known: object
    ) -> InputError:
        """The error called ``name`` in ``refusals.toml``, with file, row and column."""
        row = "" if at is None else f", row {self.rows[at]}"
        where = f"{self.entry.file}{row}" + (f", column '{column}'" if column else "")
        return refusal(name, where, **known)

    def refuse(
        self, name: str, column: str, values: np.ndarray, wrong: np.ndarray, /, **known: object
    ) -> None:
        """Raise `fault` at the first of ``values``, (T,), that is ``wrong``, (T,), if any is."""
        if wrong.any():
            at = int(np.argmax(wrong))
            raise self.fault(name, column, at, value=values[at], **known)


def longest_run(which: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest run of True in a (T,) mask, (0, 0) where there is none."""
    starts, stops = find_runs(which)
    if len(starts) == 0:
        return 0, 0
    longest = int(np.argmax(stops - starts))
    return int(starts[longest]), int(stops[longest] - starts[longest])


def in_times(count: int) -> str:
    """``3 times``, ``once``."""
    return "once" if count == 1 else f"{count} times"


def thinning_factor(announced_hz: float, fastest_hz: float) -> int:
    """Every how many samples are kept of a log at ``announced_hz``; ``fastest_hz`` 0 keeps all.

    By the rate that the session announces, so that all of its trials are alike.
    """
    return max(1, int(announced_hz / fastest_hz + 1e-9)) if fastest_hz > 0.0 else 1


def thin(trial: CleanTrial, every: int, sampled: Collection[str]) -> CleanTrial:
    """Keep one sample of every few, by `thinning_factor`.

    Inputs go through a zero-phase low-pass at half the new rate first: noise from above it must not
    fold into what is kept. Positions, brake commands, set-points and columns that are ``sampled``
    do not: counts stay counts, and steps steps.
    """
    if every == 1:
        return trial
    from scipy.signal import firwin, resample_poly  # slow to import, and for fast logs alone

    length = 2 * _HALF_LENGTH * every + 1
    low_pass = firwin(length, _HALF_POWER / every, window=("kaiser", _KAISER))
    columns = {
        name: values[::every].copy()
        if name.startswith(("q_", "brake_"))
        or name in sampled
        or not np.isfinite(values).all()
        or np.mean(np.diff(values) == 0.0) > _HELD
        else resample_poly(values, 1, every, window=low_pass, padtype="edge")
        for name, values in trial.columns.items()
    }
    return replace(
        trial, t=trial.t[::every].copy(), columns=columns, sample_rate=trial.sample_rate / every
    )
