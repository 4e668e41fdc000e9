"""The frequency band in which residuals are compared, chosen from the motion and the force."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import welch

from bampipe.arrays import Array
from bampipe.physics import System
from bampipe.results.filter import ResidualBand
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial
from bampipe.trials.sensors import Sensors

LEAST_HZ = 8.0
"""Lower limit of the band: a reversal, which shows the friction, is as wide as this."""
_COVERED = 0.95
"""Share of the power of the applied force, above its noise, that the band covers."""
_SEGMENT_S = 4.0


def find_band(
    system: System,
    motions: Sequence[Motion],
    sensors: Sensors,
    kinematics: Kinematics,
    chosen_hz: float = 0.0,
) -> dict[str, ResidualBand]:
    """Find the band of each axis in which motion and force carry signal above noise.

    The band covers 95 % of the power of the applied force above its noise. It exceeds neither the
    bandwidth of the filtered motion nor a fifth of the sampling rate, and is at least `LEAST_HZ`.

    Args:
        system: the bare device; its prior maps force channels to axes.
        chosen_hz: the user's cut-off for all axes, Hz; 0 to choose it from the data.
    """
    rate = sensors.rate_hz
    covered = np.median([_covered_hz(system, motion, sensors) for motion in motions], axis=0)
    found = {}
    for i, axis in enumerate(system.coordinates):
        motion_hz = float(kinematics.axes[axis].bandwidth_hz)
        force_hz = float(covered[i])
        most = min(motion_hz, 0.2 * rate)
        least = min(LEAST_HZ, 0.1 * rate)
        if chosen_hz:
            cutoff, reason = min(chosen_hz, 0.2 * rate), "set by the user"
        elif force_hz <= least:
            cutoff, reason = (
                least,
                f"the applied force has 95 % of its power below {force_hz:.2g} Hz",
            )
        elif force_hz <= most:
            cutoff, reason = force_hz, "95 % of the power of the applied force above its noise"
        else:
            cutoff = max(most, least)
            reason = f"the force extends to {force_hz:.3g} Hz, but the motion is known up to here"
        found[axis] = ResidualBand(
            cutoff_hz=cutoff, reason=reason, force_hz=force_hz, motion_hz=motion_hz
        )
    return found


def _covered_hz(system: System, motion: Motion, sensors: Sensors) -> Array:
    """Frequency below which 95 % of the power of each axis' applied force lies, Hz, (n_q,)."""
    rate, p = sensors.rate_hz, system.prior
    device = ModelOnTrial(system, p, [motion])
    applied, gain = device.applied, system.input_map(motion.q, device.inputs, p)
    noise = np.sqrt(np.mean(np.square(gain) @ np.square(sensors.force_sd), axis=0))
    size = min(len(applied), max(32, int(_SEGMENT_S * rate)))
    frequency, density = welch(applied, fs=rate, nperseg=size, axis=0, detrend="constant")
    signal = np.maximum(density - 2.0 * np.square(noise) / rate, 0.0)
    # The estimate of the spectrum scatters: only power above twice the noise counts as signal.
    signal[density < 4.0 * np.square(noise) / rate] = 0.0
    signal[0] = 0.0
    power = np.cumsum(signal, axis=0)
    out = np.zeros(applied.shape[1])
    for i in range(out.size):
        if power[-1, i] > 0.0:
            out[i] = frequency[int(np.searchsorted(power[:, i], _COVERED * power[-1, i]))]
    return out
