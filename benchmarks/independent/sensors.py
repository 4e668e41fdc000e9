"""Conditions of a recording, and the files of a session folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from independent.person import Task


@dataclass(frozen=True)
class Conditions:
    """How well a session is recorded; the defaults are good days.

    Attributes:
        trials: free trials; seconds: length of each; None for what is usual on the machine.
        rate_hz: sample rate; None for what is usual on the machine.
        pace: how fast the motion is, 1 for usual; below 1 slow motion alone.
        noise_factor: true force noise over what the session file states.
        hum: amplitude of 50 Hz (with a fifth of it at 150 Hz) on the force, in its stated noise.
        coarse: counts of the encoders are so many times coarser.
        dropped: share of the samples that are lost.
        jitter: standard deviation of the time between samples, as a share of it; stamps are true.
        creep: dry friction is the smoothed one of the device file instead of a true standstill.
        stop: the friction of the damper, which yields over 2 mm/s, changes its sign at once.
        hold: a motor's command is held for 1 ms, so that it acts half of that late.
        viscous_trials, locked_trials: of a machine with brakes.
        tasks: free trials beside those, in which somebody follows a sentence.
    """

    trials: int | None = None
    seconds: float | None = None
    rate_hz: float | None = None
    pace: float = 1.0
    noise_factor: float = 1.0
    hum: float = 0.0
    coarse: float = 1.0
    dropped: float = 0.0
    jitter: float = 0.0
    creep: bool = False
    stop: bool = False
    hold: bool = False
    viscous_trials: int = 0
    locked_trials: bool = False
    tasks: tuple[Task, ...] = ()


GOOD = Conditions()
HARD = {
    "noise five times what is stated": Conditions(noise_factor=5.0),
    "mains hum": Conditions(hum=10.0),
    "encoders eight times coarser": Conditions(coarse=8.0),
    "three short trials": Conditions(trials=3, seconds=6.0),
    "dropped samples": Conditions(dropped=0.02),
    "jitter": Conditions(jitter=0.1),
    "100 samples a second": Conditions(rate_hz=100.0),
    "held commands": Conditions(hold=True),
}
"""Conditions of hard days, by name."""


def sample_steps(
    rng: np.random.Generator,
    steps: int,
    per_sample: float,
    conditions: Conditions,
    jitter: float = 0.0,
) -> np.ndarray:
    """Integration steps at which the logger samples: jittering, some lost; the first is 0.

    ``jitter`` is that of the machine's logger on good days.
    """
    at = np.arange(0.0, steps, per_sample)
    share = np.hypot(jitter, conditions.jitter)
    at = at + per_sample * np.clip(share * rng.standard_normal(len(at)), -0.45, 0.45)
    at[0] = 0.0
    kept = rng.uniform(size=len(at)) >= conditions.dropped
    kept[0] = True
    chosen = np.minimum(np.rint(at[kept]).astype(np.int64), steps - 1)
    return np.unique(chosen)


def hold_back(force: np.ndarray, width: float) -> np.ndarray:
    """What a sensor of unit hysteresis adds to ``force`` (T,), between -1 and 1.

    It follows the force like a spring that slips once it is ``width`` away from where it rested.
    """
    found = np.zeros(len(force))
    for k in range(1, len(force)):
        moved = found[k - 1] + (force[k] - force[k - 1]) / width
        found[k] = min(max(moved, -1.0), 1.0)
    return found


def read_force(
    rng: np.random.Generator, t: np.ndarray, force: np.ndarray, noise: float, conditions: Conditions
) -> np.ndarray:
    """The reading (T, n) of ``force`` with the noise and hum of ``conditions``."""
    read = force + conditions.noise_factor * noise * rng.standard_normal(force.shape)
    phases = rng.uniform(0.0, 2 * np.pi, (2, force.shape[1]))
    mains = 2 * np.pi * 50.0 * t[:, None]
    hum = np.sin(mains + phases[0]) + 0.2 * np.sin(3 * mains + phases[1])
    return np.asarray(read + conditions.hum * noise * hum)


def write_trial(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write one CSV, a column each; whole numbers stay whole, others get seven figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = pd.DataFrame(dict(columns))
    frame.to_csv(path, index=False, float_format="%.7g", lineterminator="\n")


def write_session(
    folder: Path, head: str, trials: Sequence[Mapping[str, Any]], truth: Mapping[str, Any]
) -> None:
    """Write session.toml with ``head`` before the trials, and the truth beside the folder."""
    lines = [f'schema = "bampipe.session/1"\nsession_id = {json.dumps(folder.name)}\n{head}']
    for trial in trials:
        entries = [f"{key} = {json.dumps(value)}" for key, value in trial.items()]
        lines.append("\n".join(["[[trials]]", *entries]) + "\n")
    (folder / "session.toml").write_text("\n".join(lines), encoding="utf-8")
    beside = folder.with_name(f"{folder.name}.truth.json")
    beside.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")


def tell_truth(
    machine: str,
    seed: int,
    effects: Mapping[str, float],
    outside: Sequence[str],
    parameters: Mapping[str, float],
    conditions: Conditions,
) -> dict[str, Any]:
    """The content of the truth file."""
    return {
        "machine": machine,
        "seed": seed,
        "effects": [name for name in effects if name.split(":")[0] not in outside],
        "outside": [name for name in effects if name.split(":")[0] in outside],
        "strengths": dict(effects),
        "parameters": {name: float(value) for name, value in parameters.items()},
        "conditions": asdict(conditions),
    }
