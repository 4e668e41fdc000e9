"""Gravity in a proposed device file: where the motion shows it, where not, and how sure it is."""

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from other_labs import write_table

from bampipe.data import guesses
from bampipe.physics import registry
from bampipe.physics.units import check_device
from bampipe.setup.proposal import propose

Torque = Callable[[np.ndarray], np.ndarray]
RATE = 200.0


def weight(q: np.ndarray) -> np.ndarray:
    return 1.8 * np.sin(q - 0.3)


TORQUES: dict[str, Torque] = {
    "nothing": lambda q: 0.0 * q,
    "weight": weight,
    "spring": lambda q: 1.5 * q,
    "weight and cable": lambda q: weight(q) + 3.0 * q**3,
    "weight and ripple": lambda q: weight(q) + 0.35 * np.sin(8.0 * q),
}


def joint(torque: str, travel: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, angle and drive of a joint with friction and a torque over its angle, (T,) each."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / RATE)
    w, phase = 2.0 * np.pi * rng.uniform(0.1, 1.0, (4, 1)), rng.uniform(0.0, 6.28, (4, 1))
    size = travel * rng.uniform(0.5, 1.0, (4, 1)) / w
    size *= travel / np.abs((size * np.sin(w * t + phase)).sum(axis=0)).max()
    q, qd, qdd = (
        (size * factor * wave(w * t + phase)).sum(axis=0)
        for factor, wave in ((1.0, np.sin), (w, np.cos), (-(w**2), np.sin))
    )
    friction = 0.5 * np.sign(qd) + 0.35 * qd
    drive = 0.12 * qdd + friction + TORQUES[torque](q) + rng.normal(0.0, 0.02, len(t))
    return t, np.round(q / 4e-4) * 4e-4, drive


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2))])
@pytest.mark.parametrize(
    ("torque", "travel", "reading"),
    [
        ("nothing", 1.2, "nothing"), ("weight", 1.2, "gravity"), ("weight", 0.2, "either"),
        ("spring", 1.2, "spring"), ("spring", 0.2, "either"), ("weight and cable", 1.0, "both"),
        ("weight and ripple", 0.6, "both"),
    ],
)  # fmt: skip
def test_what_follows_the_angle_is_read_by_what_explains_it(
    torque: str, travel: float, reading: str, seed: int
) -> None:
    found = guesses.driven(*joint(torque, travel, seed), angle=True).pose
    assert found is not None and found.reading == reading


def test_a_drive_that_wanders_does_not_tell_weight_from_a_spring() -> None:
    """Neighbouring samples err alike; taken for independent they would tell."""
    for seed in range(10):
        t, q, drive = joint("weight", 0.2, seed)
        steps = np.random.default_rng(100 + seed).normal(size=len(t))
        drive = drive + 0.05 * np.cumsum(steps) / np.sqrt(RATE)
        found = guesses.driven(t, q, drive, angle=True).pose
        assert found is not None and found.reading in ("either", "nothing"), seed


@pytest.mark.parametrize(
    ("torque", "name", "has_weight", "said"),
    [
        ("weight", "angle [rad]", True, "gravity, since the motion shows it"),
        ("weight and cable", "angle [rad]", True, "neither weight nor a spring alone explains it"),
        ("nothing", "angle [rad]", True, "assumed, as for any joint"),
        ("nothing", "yaw [rad]", False, ""),
        ("nothing", "position[shoulder_pan_joint]", False, ""),
        ("spring", "motor [rev]", True, "assumed, as for any joint"),
        ("spring", "angle [rad]", False, "no gravity: a torque follows the position as that of a"),
    ],
)
def test_the_device_file_says_how_sure_gravity_is(
    tmp_path: Path, torque: str, name: str, has_weight: bool, said: str
) -> None:
    table = dict(zip(("time [s]", name, "torque [N.m]"), joint(torque, 1.2), strict=True))
    write_table(tmp_path / "a.csv", table, "%.6f")
    proposal = propose(tmp_path)
    content = tomllib.loads(proposal.device)
    assert check_device(registry.device_from(content)) == []
    assert ("moment" in content["parameters"]) == has_weight
    assert ("gear_ratio of joint" in str(proposal.fill_in)) == ("motor" in name)
    lines = [line for line in proposal.check if "gravity" in line]
    assert (len(lines) == 1 and said in lines[0]) if said else lines == []
    (potential,) = (line for line in proposal.device.splitlines() if "potential =" in line)
    assert ("of an upright axis" in potential) == has_weight
