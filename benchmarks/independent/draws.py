"""Sessions drawn from a seed: machine, day, hidden effects and strengths; and how each is recorded.

What is drawn is written into tables and results, so that nothing here may change: a seed must give
the session that it gave before. Machines and effects that are added belong to draws of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from independent import MACHINES, record
from independent.sensors import GOOD, HARD, Conditions

DAYS = {"good": GOOD} | HARD
USUAL = {
    "bam": Conditions(creep=True, trials=4, seconds=8.0, rate_hz=250.0),
    "joint": Conditions(creep=True, trials=4, seconds=10.0),
    "axis": Conditions(creep=True, trials=4, seconds=5.0),
    "damper": Conditions(creep=True, trials=4, seconds=10.0),
    "wrist": Conditions(creep=True, trials=4, seconds=10.0),
}
"""Sessions that are recorded and diagnosed within seconds."""
MOST = {"bam": 5, "joint": 3, "axis": 3, "damper": 2, "wrist": 1}
"""Effects hidden at once."""

SHARE_OF_COULOMB = ("presliding", "maxwell_slip", "position_dependent_friction")
"""What takes its force from the Coulomb friction of an axis: two of them leave none, and then the
simulator does not have what its truth says."""


def draw_effects(machine: str, count: int, outside: int, seed: int) -> tuple[str, ...]:
    """Draw ``count`` effects of the library and ``outside`` others, none of one kind twice."""
    rng = np.random.default_rng([seed, count, outside])
    chosen: list[str] = []
    for pool, size in (
        (MACHINES[machine].EFFECTS, count),
        (MACHINES[machine].UNKNOWN, count + outside),
    ):
        for name in rng.permutation(pool):
            kind, _, axis = name.partition(":")
            kinds = {c.partition(":")[0] for c in chosen}
            rivals = SHARE_OF_COULOMB if kind in SHARE_OF_COULOMB else ()
            beside_rival = any(f"{rival}:{axis}" in chosen for rival in rivals)
            if len(chosen) < size and kind not in kinds and not beside_rival:
                chosen.append(str(name))
    return tuple(chosen)


def draw_session(seed: int, clean: bool) -> tuple[str, str, dict[str, float]]:
    """Machine, day and hidden effects with their strengths, 0.1 to 1, each as likely by ratio."""
    rng = np.random.default_rng([seed, clean])
    machine = list(USUAL)[seed % len(USUAL)]
    day = "good" if rng.uniform() < 0.5 else str(rng.choice([d for d in DAYS if d != "good"]))
    count = 0 if clean else int(rng.integers(1, MOST[machine] + 1))
    outside = int(count > 1 and rng.uniform() < 0.2)
    names = () if clean else draw_effects(machine, count - outside, outside, seed)
    return machine, day, {n: round(float(10 ** rng.uniform(-1.0, 0.0)), 3) for n in names}


def record_drawn(
    folder: Path, seed: int, machine: str, day: str, effects: Mapping[str, float]
) -> dict[str, Any]:
    """Write the session of a draw into ``folder``; returns the truth, see `independent.record`."""
    usual, drawn = USUAL[machine], DAYS[day]
    conditions = replace(
        drawn, creep=True, trials=drawn.trials or usual.trials,
        seconds=drawn.seconds or usual.seconds, rate_hz=drawn.rate_hz or usual.rate_hz,
        viscous_trials=3 * any(e.startswith("brake") for e in effects),
    )  # fmt: skip
    return record(machine, folder, seed, effects, conditions)
