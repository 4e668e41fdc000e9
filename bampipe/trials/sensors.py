"""Noise and resolution of every channel, settled once a session from its own data.

What a session file states is a claim; the samples themselves say how noisy they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.white_noise import (
    counting_step,
    slow_noise_sd,
    white_noise_sd,
    without_feedback,
)
from bampipe.results.ingest import IngestResult

_COLOURED = 2.0
"""Factor from which on the noise of a thinned record is more than that of the whole one."""
_FOLLOWS = 0.8
"""Share of its noise that is left of a force without what follows the encoders' readings, below
which a controller makes the rest. Of the white noise of handles, load cells, motor currents and a
measured arm 0.98 or more is left, of a command by gains on counts and their differences 0.003;
where the log keeps every second to tenth sample of the controller, 0.5 to 0.76."""
DISAGREEMENT = 2.0
"""Factor between stated and measured noise beyond which a warning is given."""


@dataclass(frozen=True)
class RecordNoise:
    """What one trial says of the noise of one channel.

    Attributes:
        step: of its counts, 0.0 where its values lie on no grid.
        white_sd: standard deviation of its white noise; slow_sd: of noise that reaches over several
            samples, or of a signal that is as fast. NaN where the record is too short.
        pulsed: whether the noise is a controller's, which depends on the motion.
    """

    step: float
    white_sd: float
    slow_sd: float
    pulsed: bool = False

    @classmethod
    def of(cls, record: Array, t: Array | None = None) -> RecordNoise:
        """Measure a record (T,) with time stamps ``t`` (T,); see `white_noise_sd`."""
        sound = np.isfinite(record)
        stamps = None if t is None else t[sound]
        record = record[sound]
        step = counting_step(record)
        slow = float("nan") if stamps is None else slow_noise_sd(record, stamps, step)
        return cls(step, white_noise_sd(record, stamps, step), slow)

    @classmethod
    def of_inputs(
        cls, records: Mapping[str, Array], readings: Sequence[Array], t: Array
    ) -> dict[str, RecordNoise]:
        """Measure inputs by name, each (T,), recorded beside ``readings`` of encoders, each (T,).

        What a controller makes of the readings acts on the machine, and is no noise. Of a log that
        keeps some of its samples only, the rest is left: pulses from readings that are not logged.
        """
        found = {name: cls.of(record, t) for name, record in records.items()}
        if not records or not readings:
            return found
        rest = without_feedback(np.column_stack([*records.values()]), np.column_stack(readings))
        for (name, whole), column in zip(found.items(), rest.T, strict=True):
            left, all_of_it = (
                white_noise_sd(x[np.isfinite(x)], pulsed=True) for x in (column, records[name])
            )
            if left < _FOLLOWS * all_of_it:
                found[name] = replace(whole, white_sd=left, pulsed=True)
        return found


@dataclass(frozen=True)
class ChannelNoise:
    """What was settled for one channel.

    Attributes:
        noise_sd: standard deviation of the white noise of a sample, quantisation included.
        resolution: step of its counts; for a channel without one, the step whose rounding has
            this noise.
        stated, measured: the noise, or the step, as the session file states it and as the data
            have it; None where unknown.
        warning: a sentence where the two disagree, else "".
    """

    noise_sd: float
    resolution: float
    stated: float | None
    measured: float | None
    warning: str = ""


def settle_encoder(
    axis: str, unit: str, stated: float | None, records: Sequence[RecordNoise]
) -> ChannelNoise:
    """Settle resolution and noise of an encoder; its step may be ``stated``, rad or m."""
    step = _typical_step(records)
    stated = stated or None
    warning = ""
    if stated and step > DISAGREEMENT * stated:
        warning = (
            f"encoder {axis}: the readings move in steps of {step:.3g} {unit}, the session file"
            f" states {stated:.3g} {unit}; the measured step is used"
        )
    elif stated:
        step = stated
    rounding = step / np.sqrt(12.0)
    white = _typical_noise(records, rounding) or 0.0
    # Rounding alone leaves differences of a third to one step; more than that is noise beside it.
    noise = white if white > DISAGREEMENT * rounding else rounding
    if stated and not warning and noise > rounding:
        warning = (
            f"encoder {axis}: the readings scatter by {noise:.3g} {unit}, a step of {stated:.3g}"
            f" {unit} explains {rounding:.2g}; the measured scatter is used"
        )
    resolution = step if step > 0.0 else float(np.sqrt(12.0)) * noise
    return ChannelNoise(noise, resolution, stated, step or None, warning)


def settle_force(
    name: str, unit: str, stated: float | None, records: Sequence[RecordNoise]
) -> ChannelNoise:
    """Settle the noise of a force channel: as measured; as stated where too little is recorded."""
    stated = stated if stated is not None and stated > 0.0 else None
    measured = _typical_noise(records, stated)
    warning = ""
    if stated is not None and measured is not None:
        ratio = measured / stated
        if not 1.0 / DISAGREEMENT <= ratio <= DISAGREEMENT:
            warning = (
                f"{name}: the samples scatter by {measured:.3g} {unit}, the session file states"
                f" {stated:.3g} {unit}; the measured noise is used"
            )
    noise = measured if measured is not None else (stated or 0.0)
    step = _typical_step(records)
    noise = max(noise, step / float(np.sqrt(12.0)))
    return ChannelNoise(noise, step, stated, measured, warning)


def _typical_step(records: Sequence[RecordNoise]) -> float:
    steps = [record.step for record in records if record.step > 0.0]
    return float(np.median(steps)) if 2 * len(steps) > len(records) else 0.0


def _typical_noise(records: Sequence[RecordNoise], stated: float | None) -> float | None:
    """Noise of a channel, the same in every trial, however much its signal adds in some.

    Noise over several samples counts where it is clearly more than that of neighbouring ones, and
    what is stated does not speak for the latter: nothing else distinguishes a fast signal from it.
    What a controller makes of counts differs from trial to trial, and its mean square counts.
    """
    pulses = [r.white_sd for r in records if r.pulsed]
    if 2 * len(pulses) > len(records):
        return float(np.sqrt(np.mean(np.square(pulses))))
    white = _lower_quartile([record.white_sd for record in records])
    slow = _lower_quartile([record.slow_sd for record in records])
    if white is None or slow is None or slow <= _COLOURED * white:
        return white
    if stated and stated**2 < white * slow:
        return white
    return slow


def _lower_quartile(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.quantile(finite, 0.25)) if finite else None


@dataclass(frozen=True)
class Sensors:
    """What lies between a mechanism and its recording.

    Attributes:
        rate_hz: sampling rate.
        resolution: step of each encoder, (n_q,), rad or m.
        reading_sd: noise of each encoder reading, its rounding included, (n_q,), rad or m.
        force_sd: noise of each force channel, (n_f,), in its unit.
    """

    rate_hz: float
    resolution: Array
    reading_sd: Array
    force_sd: Array

    @classmethod
    def from_result(
        cls, session: IngestResult, axes: Sequence[str], forces: Sequence[str]
    ) -> Sensors:
        """The sensors that ``ingest/session.json`` describes, in the order of a model."""
        return cls(
            session.sample_rate_hz,
            np.array([session.axes[axis].resolution for axis in axes]),
            np.array([session.axes[axis].noise_sd for axis in axes]),
            np.array([session.force.noise_sd[name] for name in forces]),
        )

    @property
    def scatter_sd(self) -> Array:
        """Noise of the readings before they are rounded to counts, (n_q,)."""
        total, rounding = self.reading_sd**2, self.resolution**2 / 12.0
        scatter = np.sqrt(np.maximum(total - rounding, 0.0))
        return np.where(total > (1.0 + 1e-6) * rounding, scatter, 0.0)
