"""A person, or a controller, who follows the sentence that says which trial to record."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Task:
    """What to do with the machine.

    Attributes:
        moves: by axis: ``low``, ``high`` where to turn, rad or m; ``slow``, ``fast`` the band of
            the highest speed of a stroke, per s; ``rest_s`` the pause at each turn.
        pose: by axis, where the others are held.
        seconds: how long.
        brakes: share of the field of the viscous trials that the brakes render.
        reach: share of the range that is covered; haste: factor on the speeds: one for somebody
            who follows well.
        like: number of the free trial that is imitated, and not ``moves`` made.
    """

    moves: Mapping[str, Mapping[str, float]]
    pose: Mapping[str, float]
    seconds: float
    brakes: float = 0.0
    reach: float = 1.0
    haste: float = 1.0
    like: int | None = None

    @classmethod
    def read(cls, path: Path, **sloppiness: float) -> tuple[Task, ...]:
        """The trials of the first proposal of ``next.json``, followed with ``reach`` and ``haste``.

        The trial that is imitated is called t01, t02, or with more behind that.
        """
        first = json.loads(path.read_text(encoding="utf-8"))["proposals"][0]
        parts, example = first.get("parts", 1), first.get("like", "")
        one = cls(
            first["moves"],
            first["pose"],
            first["seconds"] / parts,
            first.get("brakes", 0.0),
            like=int(example[1:3]) - 1 if example else None,
            **sloppiness,
        )
        return (one,) * parts

    def of_trials(self, free: int, tasks: Sequence[Task]) -> Task:
        """The same where the trial that is imitated may be one of ``tasks``, after ``free`` others.

        Args:
            free: number of the free trials before the tasks; tasks: of the session.
        """
        if self.like is None or self.like < free:
            return self
        whole = tasks[self.like - free]
        return replace(whole, seconds=self.seconds, reach=self.reach, haste=self.haste)


def free_motion(
    task: Task | None, number: int, steps: int, step: float, pace: float
) -> tuple[int, int | None, float, float]:
    """Of a free trial, or one that imitates it: steps, the trial's number, reach and pace.

    The number is None of a trial that makes moves. Half the range at twice the speed is four times
    the pace.

    Args:
        task: None for a free trial; number: of the trial; steps: of a free one.
        step: of the integration, s; pace: of free motion.
    """
    if task is None:
        return steps, number, 1.0, pace
    return round(task.seconds / step), task.like, task.reach, pace * task.haste / task.reach


def follow(
    rng: np.random.Generator, task: Task, axes: Sequence[str], step: float
) -> tuple[Any, Any]:
    """Where the person wants the machine to be, (steps, n_axes), and its rate.

    Strokes are raised cosines; each has a speed of its own within the band, turns are off by up to
    5 % of the range, and the middle drifts.
    """
    t = np.arange(round(task.seconds / step)) * step
    goal = np.empty((t.size, len(axes)))
    for i, axis in enumerate(axes):
        if axis in task.moves:
            goal[:, i] = _strokes(rng, task, task.moves[axis], t)
        else:
            goal[:, i] = task.pose[axis]
    return goal, np.gradient(goal, step, axis=0)


def _strokes(rng: np.random.Generator, task: Task, move: Mapping[str, float], t: Any) -> Any:
    middle = 0.5 * (move["low"] + move["high"])
    half = 0.5 * task.reach * (move["high"] - move["low"])
    rest = move.get("rest_s", 0.0)
    path = np.full(t.size, middle)
    start, at, way = 0.1, middle, 1.0
    while start < t[-1]:
        to = middle + way * half * (1.0 + 0.1 * rng.uniform(-1.0, 1.0))
        speed = task.haste * rng.uniform(move["slow"], move["fast"])
        length = 0.5 * np.pi * abs(to - at) / speed
        share = np.clip((t - start) / length, 0.0, 1.0)
        path = np.where(t >= start, at + (to - at) * 0.5 * (1.0 - np.cos(np.pi * share)), path)
        start, at, way = start + length + rest, to, -way
    drift = 0.1 * half * np.sin(2 * np.pi * t / rng.uniform(12.0, 30.0))
    return path + drift
