"""Noise and resolution of every channel, settled once a session from its own data.

What a session file states is a claim; the samples themselves say how noisy they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.white_noise import counting_step, white_noise_sd
from bampipe.results.ingest import IngestResult

Array = NDArray[np.float64]

DISAGREEMENT = 2.0
"""Factor between stated and measured noise beyond which a warning is given."""


@dataclass(frozen=True)
class RecordNoise:
    """What one trial says of the noise of one channel.

    Attributes:
        step: of its counts, 0.0 where its values lie on no grid.
        white_sd: standard deviation of its white noise, NaN where the record is too short.
    """

    step: float
    white_sd: float

    @classmethod
    def of(cls, record: Array, t: Array | None = None) -> RecordNoise:
        """Measure a record (T,) with time stamps ``t`` (T,); see `white_noise_sd`."""
        sound = np.isfinite(record)
        stamps = None if t is None else t[sound]
        return cls(counting_step(record[sound]), white_noise_sd(record[sound], stamps))


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
    """Settle resolution and noise of an encoder.

    Args:
        axis, unit: for messages; stated: step by the session file, rad or m, or None.
        records: of its readings, by trial.
    """
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
    white = _typical_white(records) or 0.0
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
    """Settle the noise of a force channel: as measured, or as stated where too little is recorded.

    Args:
        name, unit: for messages; stated: by the session file, or None.
        records: of its samples, by trial.
    """
    measured = _typical_white(records)
    stated = stated if stated is not None and stated > 0.0 else None
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


def _typical_white(records: Sequence[RecordNoise]) -> float | None:
    whites = [record.white_sd for record in records if np.isfinite(record.white_sd)]
    return float(np.median(whites)) if whites else None


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
