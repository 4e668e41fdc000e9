"""The log of a simulated machine: encoder counts, volts of the force sensor, brake commands."""

from typing import Any

import numpy as np
import pandas as pd

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.files import toml_text
from bampipe.physics.device import INPUT_ORDERS, Coordinate, Device, derivative
from bampipe.physics.system import System
from bampipe.simulator.specimen import Config, Specimen, find_input_column
from bampipe.simulator.true_trials import TrueTrial

ENCODERS = {
    "yaw": ("enc_yaw", 21333.3333, 12000),
    "pitch": ("enc_pitch", 10191.0828, -4000),
    "extension": ("enc_extension", 33333.3333, 3000),
}
"""Column, counts per unit and counts at zero; other axes get 20000 per rad, 33333 per m."""

CALIBRATION = np.array([[12.0, 0.15, -0.1], [0.1, 11.5, 0.2], [-0.05, 0.1, 24.0]])
ZERO_V = np.array([0.021, -0.034, 0.012])
_TOO_HIGH = range(3, len(INPUT_ORDERS))


def record_trial(
    specimen: Specimen, config: Config, rng: np.random.Generator, true: TrueTrial, locked: bool
) -> pd.DataFrame:
    """Return the columns of the log: whole counts, volts, brake commands."""
    device = specimen.device
    force = _sensed_force(specimen, true) + config.force_noise * rng.normal(size=true.force.shape)
    # A locked trial winds up the transmission itself: the encoder sees the deflection as given.
    q = _sensed_position(specimen, true, np.zeros_like(true.force) if locked else true.force)
    columns: dict[str, Any] = {"time_us": np.round(true.t * 1e6).astype(np.int64)}
    for i, c in enumerate(device.coordinates):
        name, per_unit, zero = _encoder_settings(c)
        columns[name] = np.round(q[:, i] * per_unit + zero).astype(np.int64)
    if device.force_unit == "N":
        calibration, zero_v = _force_calibration(len(device.forces))
        volts = np.linalg.solve(calibration, force.T).T + zero_v
        columns |= {f"{f}_v": np.round(volts[:, j], 6) for j, f in enumerate(device.forces)}
    else:
        columns |= {f: np.round(force[:, j], 6) for j, f in enumerate(device.forces)}
    columns |= {b: np.round(true.brake[:, j], 4) for j, b in enumerate(device.brakes.values())}
    return pd.DataFrame(columns)


def _sensor_inputs(system: System, true: TrueTrial, force: Array) -> Array:
    """Return the inputs of the sensor models, (T, nu)."""
    device, nothing = system.model.device, np.zeros(len(true.t))
    columns = dict(zip(device.forces, force.T, strict=True)) | {"t": true.t}
    columns |= dict(zip(device.brakes.values(), true.brake.T, strict=True))
    return np.column_stack([columns.get(name, nothing) for name in system.inputs])


def _sensed_position(specimen: Specimen, true: TrueTrial, force: Array) -> Array:
    """Solve q_true = q_m + offset(q_m) for the reading q_m by iteration, loaded by ``force``."""
    if specimen.position is None:
        return true.q
    system = specimen.position
    u, p = _sensor_inputs(system, true, force), specimen.p(system)
    q = true.q
    for _ in range(100):
        step = true.q - q - system.offset(q, u, p)
        q = q + step
        if np.abs(step).max() < 1e-12:
            return q
    raise InputError("a position effect is too strong to be simulated", remedy="weaken it")


def _sensed_force(specimen: Specimen, true: TrueTrial) -> Array:
    """Return the reading of the force sensor, without noise.

    The effects state true = T(reading), where T is affine in the reading and its two derivatives.
    Its coefficients at each sample follow from unit inputs; the equation is then solved for the
    reading, sample by sample if it has derivatives (implicit differences, stable for any lag).
    """
    late = np.column_stack(
        [np.interp(true.t - specimen.delay, true.t, column) for column in true.force.T]
    )
    if specimen.force is None:
        return late
    system, nf = specimen.force, late.shape[1]
    if system.memory_names:
        raise InputError("an input effect with internal states cannot be simulated")
    p, no_states = specimen.p(system), np.zeros((len(late), 0))
    still, names = np.zeros_like(true.q), specimen.device.forces

    def correct_reading(u: Array) -> Array:
        applied = system.applied(true.q, true.qd, still, no_states, u, p)
        return system.least_force(true.q, applied)

    zero = _sensor_inputs(system, true, np.zeros_like(late))
    constant = correct_reading(zero)
    if any(find_input_column(system, derivative(f, k)) >= 0 for f in names for k in _TOO_HIGH):
        raise InputError("an input effect with a third derivative cannot be simulated")
    response = np.zeros((3, len(late), nf, nf))
    for order in range(3):
        for j, f in enumerate(names):
            column = find_input_column(system, derivative(f, order))
            if column >= 0:
                u = zero.copy()
                u[:, column] = 1.0
                response[order, :, :, j] = correct_reading(u) - constant
    side = late - constant
    if not response[1:].any():
        reading = np.linalg.solve(response[0], side[:, :, None])[:, :, 0]
        if not np.allclose(correct_reading(_sensor_inputs(system, true, reading)), late, atol=1e-6):
            raise InputError("an input effect is not linear in the force and cannot be simulated")
        return np.asarray(reading)
    h = true.t[1] - true.t[0]
    reading = np.empty_like(late)
    now, before = late[0], late[0]
    for k in range(len(late)):
        a, b, c = response[0, k], response[1, k] / h, response[2, k] / h**2
        known = side[k] + b @ now + c @ (2 * now - before)
        reading[k] = np.linalg.solve(a + b + c, known)
        before, now = now, reading[k]
    return reading


def _encoder_settings(c: Coordinate) -> tuple[str, float, int]:
    return ENCODERS.get(c.name, (f"enc_{c.name}", 20000.0 if c.kind == "rotary" else 33333.0, 0))


def _force_calibration(nf: int) -> tuple[Array, Array]:
    if nf > len(ZERO_V):
        return 12.0 * np.eye(nf), np.zeros(nf)
    return CALIBRATION[:nf, :nf], ZERO_V[:nf]


def format_session_file(
    session_id: str, device: Device, config: Config, trials: list[dict[str, str]]
) -> str:
    """Return the session file over the trials that `record_trial` made."""
    encoders = {}
    for c in device.coordinates:
        name, per_unit, zero = _encoder_settings(c)
        scale = {"counts_per_unit": per_unit, "zero_counts": zero}
        encoders[c.name] = {"column": name, **scale, "unit": c.unit}
    force = {"columns": list(device.forces), "unit": device.force_unit}
    if device.force_unit == "N":
        calibration, zero_v = _force_calibration(len(device.forces))
        force = {"columns": [f"{f}_v" for f in device.forces], "unit": "V", "frame": "handle"}
        force |= {"calibration_n_per_v": calibration.tolist(), "zero_v": zero_v.tolist()}
    units = ", ".join(device.coordinate(axis).torque_unit for axis in device.brakes)
    brakes = {"columns": list(device.brakes.values()), "unit": units}
    viscous = {"viscous_n_s_per_m": config.viscous_damping}
    return toml_text(
        {
            "schema": "bampipe.session/1",
            "session_id": session_id,
            "device": config.device,
            "sample_rate_hz": config.sample_rate,
            "simulated": True,
            "encoders": encoders,
            "force": force | {"noise_sd_n": config.force_noise},
            **({"brakes": brakes} if device.brakes else {}),
            "trials": [one | (viscous if one["kind"] == "viscous" else {}) for one in trials],
        }
    )
