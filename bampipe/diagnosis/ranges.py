"""Search ranges of shapes and nonlinear strengths, within the bounds of their effects.

Relevant lengths, speeds and times differ by a factor of a thousand between machines, so that the
ranges follow the travel, speeds, loads and sampling of the trials.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.physics.effect import BoundEffect
from bampipe.physics.parameter import Parameter
from bampipe.trials.linearisation import Linearisation

_TRAVEL = (1e-4, 0.1)
"""Lengths, as shares of the travel; a shorter one is crossed within a sample or two."""
_SPEED = (2e-3, 0.5)
"""Speeds, as shares of the highest speed."""
_WAVES = (2.0, 30.0)
"""Wavenumbers, in waves on the travel."""
_WAVES_APART = 0.6
"""Distance of two wavenumbers on a grid, in waves on the travel; at a distance of one they are
uncorrelated."""
_GIVE = (1e-4, 0.1)
"""Deflections at the highest load, as shares of the travel; a smaller one cannot be distinguished
from a reversal of friction between two samples."""
_LOSS = (1e-2, 3.0)
"""Losses at the highest load, as shares of that load."""
_GAP = (1e-3, 0.05)
"""Play, as shares of the travel."""
_DRIVE = (0.15, 0.85)
"""Inertia of a drive, as shares of that of its axis."""
_LIGHTEST = 6.0
"""Inertia of an axis over that of its lightest relevant part."""
_TIME = (2.0, 3.0)
"""Settling times, from samples to durations of a trial."""
_PARTS = {"travel": (0.02, 0.98), "upper part": (0.25, 0.98), "lower part": (0.02, 0.75)}
_PLACES_APART = 0.08
"""Positions, and the distance of two on a grid, as shares of the travel."""
_BEYOND = (0.52, 5.0)
"""Distances of positions beyond the travel from its middle, as shares of the travel. A force that
rises towards a more distant position is a straight line on the travel."""
_RESONANCE = 3.0
"""Highest resonance, over the highest frequency of the band. Above, only a tenth of its force lies
in the band, as much as a late sample or a filter leaves."""
_DELAY, _DELAY_OF_DRIVES = 0.2, 0.5
"""Shortest delays, in samples; both sides of the equation are filtered alike, so that less than a
sample shows. With several drives, friction that stops a joint looks up to half a sample late, and a
delay that most drives share is the input delay."""


@dataclass(frozen=True)
class SearchRange:
    """The range of one searched parameter.

    Attributes:
        low, high: its ends.
        by_ratio: whether grid values have equal ratios.
        travel_middle: middle of the travel, for a position beyond it; ``low`` and ``high`` are then
            reciprocals of the distance from there, negative on the lower side.
        largest_distance: largest such distance.
        largest_spacing: largest distance of two grid values, which are then evenly spaced.
        count: number of grid values, if it is fixed.
    """

    low: float
    high: float
    by_ratio: bool
    travel_middle: float | None = None
    largest_distance: float = np.inf
    largest_spacing: float = np.inf
    count: int = 0

    @property
    def grid_size(self) -> int:
        """Smallest number of values of a grid."""
        return 1 + int(np.ceil((self.high - self.low) / self.largest_spacing))

    @property
    def extent(self) -> float:
        """Logarithm of the ratio of the ends; a linear range counts as a ratio of 20."""
        return float(np.log(self.high / self.low if self.by_ratio else 20.0))

    def value_at(self, searched: float) -> float:
        """Return the value of the parameter for a number between ``low`` and ``high``."""
        if self.travel_middle is None:
            return searched
        distance = min(1.0 / max(abs(searched), 1e-300), self.largest_distance)
        return self.travel_middle + float(np.copysign(distance, searched))

    def value_like(self, value: float) -> float:
        """Return ``value`` if it is in the range, else a value in its middle or upper part."""
        if self.travel_middle is not None:
            distance = abs(value - self.travel_middle)
            holds = 1.0 / self.high <= distance <= self.largest_distance
            return value if holds else self.value_at(self.interpolate(0.75))
        return value if self.low <= value <= self.high else self.interpolate(0.5)

    def interpolate(self, share: float) -> float:
        """Return the number a share of the way between the ends, by ratios if both are positive."""
        if self.low > 0.0 and self.high > 0.0 and not np.isfinite(self.largest_spacing):
            return float(self.low ** (1.0 - share) * self.high**share)
        return float(self.low + share * (self.high - self.low))


@dataclass(frozen=True)
class MachineScale:
    """The range of motion and load in the trials of a session, by coordinate.

    Attributes:
        lowest, highest: ends of the travel, (n_q,), rad or m.
        speed: highest speed, (n_q,), rad/s or m/s.
        load: largest applied generalised force, (n_q,), N.m or N.
        inertia: diagonal of the model's mass matrix in mid-travel, (n_q,), kg.m2 or kg.
        coordinates: units of each coordinate and its force, by name.
        interval, duration: time between samples, and of the longest trial, s.
        band_hz: highest frequency of the residual, (n_q,), Hz.
    """

    lowest: Array
    highest: Array
    speed: Array
    load: Array
    inertia: Array
    coordinates: dict[str, tuple[str, str]]
    interval: float
    duration: float
    band_hz: tuple[float, ...]

    @classmethod
    def of_trials(cls, linearisation: Linearisation) -> Self:
        """Return the scale of the trials of ``linearisation``."""
        system, q, qd, load = linearisation.system, [], [], []
        for trial, motion in enumerate(linearisation.motions):
            applied = linearisation.fitted[trial].applied
            q += [motion.q.min(axis=0), motion.q.max(axis=0)]
            qd.append(np.abs(motion.qd).max(axis=0))
            load.append(np.abs(applied).max(axis=0))
        times = [motion.t for motion in linearisation.motions]
        middle = 0.5 * (np.min(q, axis=0) + np.max(q, axis=0))[None, :]
        inertia = np.diagonal(system.mass_matrix(middle, linearisation.p)[0])
        return cls(
            np.min(q, axis=0), np.max(q, axis=0), np.max(qd, axis=0), np.max(load, axis=0),
            inertia,
            {c.name: (c.unit, c.torque_unit) for c in system.model.device.coordinates},
            float(np.median(np.diff(times[0]))), max(float(np.ptp(t)) for t in times),
            linearisation.band.cutoff_hz,
        )  # fmt: skip

    def range_of(self, item: BoundEffect, parameter: Parameter) -> SearchRange:
        """Return the search range of a parameter in which the residual is not linear."""
        reach = 4.0 * (abs(parameter.typical) if parameter.typical else parameter.sd)
        lower, upper = parameter.lower, parameter.upper
        if parameter.strength and lower < 0.0:
            return SearchRange(max(lower, -reach), min(upper, reach), False)
        if parameter.within and item.axes:
            i = list(self.coordinates).index(item.axes[0])
            low, high = float(self.lowest[i]), float(self.highest[i])
            if parameter.within == "beyond":
                nearest, farthest = (share * (high - low) for share in _BEYOND)
                steepest, around = 1.0 / nearest, 0.5 * (low + high)
                return SearchRange(-steepest, steepest, False, around, farthest)
            start, end = (low + share * (high - low) for share in _PARTS[parameter.within])
            return SearchRange(start, end, False, largest_spacing=_PLACES_APART * (high - low))
        if parameter.shape and lower <= 0.0:
            low = lower if np.isfinite(lower) else parameter.prior - reach
            return SearchRange(low, upper if np.isfinite(upper) else parameter.prior + reach, False)
        low, high = self._sizes(item, parameter).get(parameter.unit, (0.0, np.inf))
        if parameter.strength:
            low, high = low or 0.02 * reach, min(high, reach) if np.isinf(high) else high
        low, high = max(low, lower), min(high, upper)
        if not low < high:
            low, high = lower or 0.02 * reach, min(upper, reach)
        high = high if np.isfinite(high) else parameter.prior + reach
        if item.axes and parameter.unit == f"1/{self.coordinates[item.axes[0]][0]}":
            i = list(self.coordinates).index(item.axes[0])
            travel = max(float(self.highest[i] - self.lowest[i]), 1e-300)
            return SearchRange(low, high, True, largest_spacing=2.0 * np.pi * _WAVES_APART / travel)
        return SearchRange(low, high, True, count=parameter.values)

    def _sizes(self, item: BoundEffect, parameter: Parameter) -> dict[str, tuple[float, float]]:
        """Return the range of sizes at the target of an effect, by unit."""
        found = {"s": (_TIME[0] * self.interval, _TIME[1] * self.duration)}
        if parameter.strength:
            of_drives = item.effect.scope == "force_component" or item.effect.drive
            several = len(self.coordinates) > 1
            least = _DELAY_OF_DRIVES if of_drives and several else _DELAY
            found["s"] = (least * self.interval if item.effect.kind == "input" else 0.0, np.inf)
        if not item.axes:
            return found
        i = list(self.coordinates).index(item.axes[0])
        unit, force = self.coordinates[item.axes[0]]
        travel = float(self.highest[i] - self.lowest[i])
        speed, load = float(self.speed[i]), float(self.load[i])
        if not travel > 0.0 or not load > 0.0:
            return found
        inertia = float(self.inertia[i])
        lightness = 1.0 / max(inertia, 1e-300)
        highest = 2.0 * np.pi * _RESONANCE * self.band_hz[i]
        per_force = force.replace(".", "/")
        length = _GAP if item.effect.has_play else _TRAVEL
        return found | {
            unit: (length[0] * travel, length[1] * travel),
            "kg.m2" if unit == "rad" else "kg": (_DRIVE[0] * inertia, _DRIVE[1] * inertia),
            "1/s": (0.0, highest),
            f"{unit}/s": (_SPEED[0] * speed, _SPEED[1] * speed),
            f"1/{unit}": (2 * np.pi * _WAVES[0] / travel, 2 * np.pi * _WAVES[1] / travel),
            f"{unit}/{per_force}": (_GIVE[0] * travel / load, _GIVE[1] * travel / load),
            f"1/{per_force}": (_LOSS[0] / load, _LOSS[1] / load),
            "1/kg/m2" if unit == "rad" else "1/kg": (lightness, _LIGHTEST * lightness),
        }
