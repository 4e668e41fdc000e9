"""What keeps the cost of a session linear in its length."""

from __future__ import annotations

from pathlib import Path

from bampipe.stages import validate
from bampipe.stages.base import RunFolder


def test_trials_are_held_out_one_by_one_up_to_ten_then_in_ten_groups() -> None:
    run = RunFolder(Path("nowhere"))

    def groups(trials: int) -> list[int]:
        return validate._groups(run, [None] * trials, "")  # type: ignore[list-item]

    assert groups(10) == list(range(10))
    many = groups(57)
    assert len(many) == 57 and set(many) == set(range(10))
    assert max(many.count(k) for k in range(10)) - min(many.count(k) for k in range(10)) <= 1
