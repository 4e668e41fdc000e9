"""What FIGAROH's regressor leaves of the Stäubli TX40, on the splits of `robots.py`.

    pip install figaroh pandas scipy
    python benchmarks/beside_figaroh.py FOLDER

FOLDER is that of `robots.py`. FIGAROH builds the regressor of the URDF (bodies, viscous and Coulomb
friction, inertia of the drives, offsets) and finds the base parameters; the wrist's coupling is put
in by hand, as columns of friction and inertia of the motor that turns with joints 5 and 6. Torque
and columns are low-passed at 40 Hz; least squares weigh each joint by what it leaves. Printed is
the error of each joint in per cent of its torque, in-sample, and held out in five folds of blocks
of 0.8 s. Needs nothing of bampipe, so that it runs in an environment of its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pinocchio
from figaroh.tools.qrdecomposition import build_baseRegressor, get_baseIndex
from figaroh.tools.regressor import build_regressor_basic, eliminate_non_dynaffect
from robots import tx40_joints
from scipy.signal import butter, sosfiltfilt

RATE, BAND, STEP = 5000.0, 40.0, 25
"""Hz, Hz, and samples between those that are compared."""
BLOCK_S, FOLDS = 0.8, 5
OPTIONS = {
    "has_friction": True,
    "has_actuator_inertia": True,
    "has_joint_offset": True,
    "is_joint_torques": True,
}


def low_pass(x: np.ndarray, hz: float) -> np.ndarray:
    """Without delay, along the first axis."""
    return np.asarray(sosfiltfilt(butter(4, hz, fs=RATE, output="sos"), x, axis=0))


def regressors_of(q: np.ndarray, urdf: Path) -> dict[str, np.ndarray]:
    """Columns of the base parameters without the coupling and with it, low-passed, (K, 6, P)."""
    robot = pinocchio.RobotWrapper(pinocchio.buildModelFromUrdf(str(urdf)))
    v = np.gradient(q, 1.0 / RATE, axis=0)
    a = np.gradient(v, 1.0 / RATE, axis=0)
    kept = slice(None, None, 5)  # 1 kHz is enough for 40 Hz
    q, v, a = q[kept], v[kept], a[kept]
    alone = build_regressor_basic(robot, q, v, a, OPTIONS | {"act_idxv": list(range(6))})
    both, on_both = v[:, 4] + v[:, 5], np.zeros((6, len(q), 3))
    on_both[4:] = np.column_stack([both, np.sign(both), a[:, 4] + a[:, 5]])
    coupled = np.hstack([alone, on_both.reshape(-1, 3)])
    sos, found = butter(4, BAND, fs=RATE / 5, output="sos"), {}
    for what, every in (("without", alone), ("with the coupling", coupled)):
        w, names = eliminate_non_dynaffect(every, {f"p{k}": 0.0 for k in range(every.shape[1])})
        w = build_baseRegressor(w, get_baseIndex(w, names))
        by_joint = w.reshape(6, len(q), -1).transpose(1, 0, 2)
        found[what] = sosfiltfilt(sos, by_joint, axis=0)[:: STEP // 5]
    return found


def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares, each joint weighed by what it leaves: (P,) of (K, 6, P) and (K, 6)."""
    weight = 1.0 / y.std(axis=0)
    for _ in range(5):
        stacked = (x * weight[:, None]).reshape(-1, x.shape[2])
        p = np.linalg.lstsq(stacked, (y * weight).ravel(), rcond=1e-10)[0]
        weight = 1.0 / (y - x @ p).std(axis=0)
    return np.asarray(p)


def main() -> None:
    """Print the errors without and with the coupling."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    source = parser.parse_args().folder / "staubli_tx40"
    q, torque = tx40_joints(source)
    y = low_pass(torque, BAND)[::STEP]
    block = (np.arange(len(y)) * STEP / RATE // BLOCK_S).astype(int) % FOLDS
    regressors = regressors_of(low_pass(q, 100.0), next(source.glob("*.urdf")))
    for what, x in regressors.items():
        inside, held = y - x @ fit(x, y), np.empty_like(y)
        for fold in range(FOLDS):
            out = block == fold
            held[out] = y[out] - x[out] @ fit(x[~out], y[~out])
        for name, left in (("in-sample", inside), ("held out", held)):
            share = 100.0 * np.sqrt(np.mean(left**2, axis=0) / np.mean(y**2, axis=0))
            print(f"{what}, {name}: " + " ".join(f"{value:.1f}" for value in share) + " %")


if __name__ == "__main__":
    main()
