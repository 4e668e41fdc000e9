"""The filters that turn readings into motion, the same for measured trials and replicates.

Positions are differentiated by axis as ``filter/filter.json`` states. The inputs themselves are not
filtered; their time derivatives are band-limited.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate import butterworth, kalman_smoother
from bampipe.estimate.differentiation import Derivatives
from bampipe.physics.device import LAST_ORDER
from bampipe.results.filter import FilterResult
from bampipe.trials.motion import TIMING_ORDERS, Motion, Recording, input_derivatives


@dataclass(frozen=True)
class AxisFilter:
    """The filter that differentiates the positions of one axis.

    Attributes:
        bandwidth_hz: half-power frequency, Hz.
        noise_sd: standard deviation of the white noise of a reading, rad or m.
        order: of the integrated white noise of the Kalman smoother; 0 for a Butterworth filter.
    """

    bandwidth_hz: float
    noise_sd: float
    order: int = 0


@dataclass(frozen=True)
class Kinematics:
    """The filters of a session.

    Attributes:
        method: ``kalman`` or ``butterworth``.
        rate_hz: sampling rate.
        axes: by coordinate, in order.
        input_cutoff_hz: half-amplitude frequency of the time derivatives of inputs, Hz.
    """

    method: str
    rate_hz: float
    axes: Mapping[str, AxisFilter]
    input_cutoff_hz: float

    @classmethod
    def from_result(cls, found: FilterResult, coordinates: Sequence[str]) -> Self:
        """The filters that ``filter/filter.json`` describes, in the order of a model's axes."""
        axes = {}
        for name in coordinates:
            axis = found.axes[name]
            axes[name] = AxisFilter(axis.bandwidth_hz, axis.measurement_noise_sd, axis.order or 0)
        return cls(found.method, found.sample_rate_hz, axes, found.force.derivative_cutoff_hz)

    def differentiate(self, axis: str, position: Array, seen: Flags | None = None) -> Derivatives:
        """Return the motion behind the readings (T,) of one axis.

        ``seen`` (T,) is false where a reading is a guess across a gap; the Kalman smoother alone
        leaves those out.
        """
        if self.method == "kalman":
            return kalman_smoother.smooth(position, self._motion_model(axis), seen)
        chosen = self.axes[axis]
        return butterworth.smooth(position, self.rate_hz, chosen.bandwidth_hz, chosen.noise_sd)

    def derivatives_of(self, axis: int, signal: Array) -> tuple[Array, Array, Array]:
        """Motion that a signal (T,) adds if it is added to the readings; see `differentiate`."""
        name = list(self.axes)[axis]
        if self.method == "kalman":
            found = self.differentiate(name, signal)
            return found.position, found.velocity, found.acceleration
        return butterworth.zero_phase(signal, self.rate_hz, self.axes[name].bandwidth_hz)

    def _motion_model(self, axis: str) -> kalman_smoother.MotionModel:
        chosen = self.axes[axis]
        ratio = kalman_smoother.ratio_for(chosen.bandwidth_hz, chosen.order, self.rate_hz)
        return kalman_smoother.MotionModel(chosen.order, chosen.noise_sd, ratio, self.rate_hz)

    def input_rates(self, values: Array, count: int = LAST_ORDER) -> list[Array]:
        """Return the first ``count`` time derivatives (T,) of an input (T,), lowest order first."""
        return butterworth.rates(values, self.rate_hz, self.input_cutoff_hz, count)

    def observe(
        self,
        recording: Recording,
        smooth_inputs: Sequence[str],
        wanted: Collection[str] | None = None,
    ) -> Motion:
        """Filter a recording, measured or simulated.

        Args:
            smooth_inputs: channels that have time derivatives.
            wanted: inputs of the only model that will see the motion. Only their derivatives are
                computed, and those needed to shift them in time; by default all are.
        """
        moved = [self.differentiate(axis, recording.q[:, i]) for i, axis in enumerate(self.axes)]
        channels = dict(recording.channels)
        for name in smooth_inputs:
            names = input_derivatives(name)
            if wanted is not None:
                taken = [k for k, rate in enumerate(names, start=1) if rate in wanted]
                names = names[: max(taken, default=0) + TIMING_ORDERS]
            rates = self.input_rates(recording.channels[name], len(names))
            channels |= dict(zip(names, rates, strict=True))
        parts = ("position", "velocity", "acceleration", "velocity_sd")
        q, qd, qdd, qd_sd = (np.column_stack([getattr(m, x) for m in moved]) for x in parts)
        t = np.arange(len(recording.q)) / self.rate_hz
        return Motion(recording.trial_id, t, q, qd, qdd, qd_sd, channels, filters=self)
