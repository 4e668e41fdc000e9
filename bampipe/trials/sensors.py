"""Noise and resolution of every channel, determined once per session from its own data.

The values that a session file states are checked against the samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

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
"""Smallest ratio of the noise of a thinned record to that of the whole one if it is coloured."""
_FOLLOWS = 0.8
"""A force whose noise, without the part that follows the encoder readings, is smaller than this
fraction is a controller's command. Handles, load cells, motor currents and a measured arm keep 0.98
or more of their white noise; a command by gains on counts and their differences 0.003, or 0.5 to
0.76 if the log keeps every second to tenth sample of the controller."""
_ALIKE = 1.15
"""Largest ratio between two measurements of the same noise in trials of a thousand samples."""
DISAGREEMENT = 2.0
"""Ratio of stated to measured noise, or its inverse, beyond which a warning is given."""


@dataclass(frozen=True)
class RecordNoise:
    """Noise of one channel in one trial.

    Attributes:
        step: step of its counts; 0.0 if its values lie on no grid.
        white_sd: standard deviation of the white noise; slow_sd: of noise correlated over several
            samples, or of an equally fast signal. NaN if the record is too short.
        pulsed: whether a controller causes the noise, which then depends on the motion.
    """

    step: float
    white_sd: float
    slow_sd: float
    pulsed: bool = False

    @classmethod
    def of(cls, record: Array, t: Array | None = None) -> Self:
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
    ) -> dict[str, Self]:
        """Measure inputs by name, each (T,), recorded with ``readings`` of encoders, each (T,).

        The part that a controller derives from the readings acts on the machine, so it is not
        noise. If the log keeps only some of the controller's samples, pulses remain, which stem
        from readings that were not logged.
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
    """Noise and resolution of one channel for the session.

    Attributes:
        noise_sd: standard deviation of the white noise of a sample, including quantisation.
        resolution: step of its counts; for a channel without counts, the step whose rounding
            causes this noise.
        stated, measured: noise or step from the session file and from the data; None if unknown.
        warning: a sentence if the two disagree, else "".
    """

    noise_sd: float
    resolution: float
    stated: float | None
    measured: float | None
    warning: str = ""


def settle_encoder(
    axis: str, unit: str, stated: float | None, records: Sequence[RecordNoise]
) -> ChannelNoise:
    """Determine resolution and noise of an encoder; ``stated`` is its step, rad or m, if known."""
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
    # Rounding alone causes differences of a third to one step; more than that is additional noise.
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
    """Determine the noise of a force channel: the measured one, or as stated if data are short."""
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
    """Noise of a channel, which is the same in every trial, whereas the signal may differ.

    Noise correlated over several samples is used if it clearly exceeds that of neighbouring
    samples, unless the stated noise is closer to the latter: it may be a fast signal.
    The commands of a controller differ by trial, and their mean square is used.
    """
    pulses = [r.white_sd for r in records if r.pulsed]
    if 2 * len(pulses) > len(records):
        return float(np.sqrt(np.mean(np.square(pulses))))
    white = _agreed_noise([record.white_sd for record in records])
    slow = _agreed_noise([record.slow_sd for record in records])
    if white is None or slow is None or slow <= _COLOURED * white:
        return white
    if stated and stated**2 < white * slow:
        return white
    return slow


def _agreed_noise(values: Sequence[float]) -> float | None:
    """Root mean square of what differs from the lower quartile by no more than chance would."""
    finite = np.array([value for value in values if np.isfinite(value)])
    if not finite.size:
        return None
    quartile = float(np.quantile(finite, 0.25))
    alike = (finite <= _ALIKE * quartile) & (_ALIKE * finite >= quartile)
    return float(np.sqrt(np.mean(finite[alike] ** 2))) if alike.any() else quartile


@dataclass(frozen=True)
class Sensors:
    """The sensors between a mechanism and its recording.

    Attributes:
        rate_hz: sampling rate.
        resolution: step of each encoder, (n_q,), rad or m.
        reading_sd: noise of each encoder reading, including rounding, (n_q,), rad or m.
        force_sd: noise of each force channel, (n_f,), in its unit.
    """

    rate_hz: float
    resolution: Array
    reading_sd: Array
    force_sd: Array

    @classmethod
    def from_result(cls, session: IngestResult, axes: Sequence[str], forces: Sequence[str]) -> Self:
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
