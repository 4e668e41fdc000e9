"""Noise, mains hum and readings in raw counts of each channel, collected trial by trial."""

from collections import defaultdict

import numpy as np

from bampipe.arrays import Array
from bampipe.data.quality import CleanTrial
from bampipe.data.session import Session
from bampipe.estimate.spectral_lines import remove_mains
from bampipe.physics.device import Device
from bampipe.results.ingest import MainsHum
from bampipe.trials.sensors import ChannelNoise, RecordNoise, settle_encoder, settle_force

_COUNTS_SPAN = 16.0
"""Smallest range of counts: readings rounded to tens span fewer distinct values than that."""
_MIDDLES = (2.0**9, 2.0**11, 2.0**13, 2.0**15)
"""Readings of converters of 10 to 16 bits at mid-scale, where an unloaded bipolar sensor stands."""
_NEAR_MIDDLE = 0.05
"""Largest relative deviation of an unloaded sensor from mid-scale, by offset and preload."""


class ChannelRecords:
    """Noise, mains hum and integer readings of each channel, collected over a session's trials."""

    def __init__(self, session: Session, device: Device) -> None:
        self._session, self._device = session, device
        # One raw unit in SI, for forces whose unit is so large that they are no whole numbers.
        units: dict[str, float] = {}
        if session.force and not session.force.volts:
            gains = np.diag(np.array(session.force.calibration))
            units |= dict(zip(session.force.names, gains, strict=True))
        units |= {each.name: each.scale for each in session.channels if each.offset == 0.0}
        whole = {name: unit for name, unit in units.items() if unit >= 1.0}
        self._units = {name: unit for name, unit in whole.items() if name in device.forces}
        self._noise: dict[str, list[RecordNoise]] = defaultdict(list)
        self._hum: dict[str, list[dict[float, float]]] = defaultdict(list)
        self._counts: dict[str, list[tuple[float, float] | None]] = defaultdict(list)

    def note_trial(self, trial: CleanTrial) -> None:
        """Record a trial's integer readings, and remove mains hum from its inputs in place."""
        for name, unit in self._units.items():
            self._counts[name].append(_counts(trial.columns[name] / unit))
        moving = [column for name, column in trial.columns.items() if name.startswith("q_")]
        for name, values in trial.columns.items():
            if not name.startswith(("q_", "brake_")) and np.isfinite(values).all():
                trial.columns[name], found = remove_mains(values, trial.t, moving)
                self._hum[name].append(found)

    def measure_noise(self, trial: CleanTrial) -> None:
        """Measure the noise of a trial's encoders (``q_<axis>``) and inputs, unless they rest."""
        columns = {
            name: np.asarray(values, dtype=float)
            for name, values in trial.columns.items()
            if not name.startswith("brake_") and np.any(values != values[0])
        }
        readings = {name: x for name, x in columns.items() if name.startswith("q_")}
        inputs = {name: x for name, x in columns.items() if name not in readings}
        found = {name: RecordNoise.of(x, trial.t) for name, x in readings.items()}
        found |= RecordNoise.of_inputs(inputs, [*readings.values()], trial.t)
        for name, one in found.items():
            self._noise[name].append(one)

    def encoders(self) -> dict[str, ChannelNoise]:
        """Resolution and noise of the encoders, by axis."""
        return {
            e.name: settle_encoder(e.name, e.unit, e.resolution, self._noise.get(f"q_{e.name}", []))
            for e in self._session.encoders
        }

    def forces(self) -> dict[str, ChannelNoise]:
        """Noise of the force channels, by name."""
        stated = self._session.force.noise_sd if self._session.force else None
        return {
            name: settle_force(name, self._device.force_unit, stated, self._noise.get(name, []))
            for name in self._device.forces
        }

    def mains_hum(self) -> tuple[MainsHum, ...]:
        """The hum removed from each channel: the median amplitude of the trials that had it."""
        return tuple(
            MainsHum(
                channel=name,
                unit=self._device.channels.get(name, self._device.force_unit),
                hz=hz,
                amplitude=float(np.median([trial[hz] for trial in trials if hz in trial])),
                trials=sum(hz in trial for trial in trials),
            )
            for name, trials in sorted(self._hum.items())
            for hz in sorted({hz for trial in trials for hz in trial})
        )

    def count_warnings(self) -> dict[str, str]:
        """A warning for each channel that seems to hold converter counts in most of its trials."""
        said, force, device = {}, self._session.force, self._device
        for name, ranges in self._counts.items():
            found = [each for each in ranges if each is not None]
            if 2 * len(found) <= len(ranges):
                continue
            low, high = min(each[0] for each in found), max(each[1] for each in found)
            in_force = force is not None and name in force.names
            said[name] = (
                f"{name}: whole numbers from {low:.0f} to {high:.0f} look like counts of a"
                f" converter, not like {device.channels.get(name, device.force_unit)}; if so, "
                + (
                    'give [force] unit = "V", calibration_n_per_v with the force of one count, and'
                    " zero_v with the reading without load"
                    if in_force
                    else f"give scale and offset under channels.{name}"
                )
            )
        return said


def _counts(readings: Array) -> tuple[float, float] | None:
    """Return the range of force readings (T,) if they look like converter counts, else None.

    Counts are non-negative whole numbers that either stay farther from zero than they span, or
    stand about a converter's mid-scale. A force in SI units passes through zero in fractions.
    """
    known = readings[np.isfinite(readings)]
    if not known.size or np.mean(np.abs(known - np.rint(known)) < 1e-6) < 0.95:
        return None
    low, middle, high = float(known.min()), float(np.median(known)), float(known.max())
    if low < 0.0 or high - low < _COUNTS_SPAN:
        return None
    about = any(abs(middle / m - 1.0) < _NEAR_MIDDLE and high < 2.0 * m for m in _MIDDLES)
    return (low, high) if about or middle > high - low else None
