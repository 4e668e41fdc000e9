"""Which trials the errors of a free run speak of."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bampipe.identification import free_run


def test_in_closed_loop_only_judged_trials_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that was fitted is followed to 1 %, one held out to 20 %, in position and command."""
    off = {"fitted": 1.01, "held": 1.2}

    def closed(run: Any, system: Any, motion: Any, p: Any, law: Any) -> free_run._Run:
        motion_of = np.sin(np.linspace(0.0, 6.0, 50))[:, None]
        both, factor = np.hstack([motion_of, motion_of]), off[motion.trial_id]
        return free_run._Run(
            motion.trial_id, both, factor * both, motion_of, factor * motion_of
        )  # fmt: skip

    monkeypatch.setattr(free_run, "_closed", closed)
    monkeypatch.setattr(free_run, "_lacks", lambda *_: "")
    monkeypatch.setattr(free_run, "why_not_free", lambda *_: "")
    monkeypatch.setattr(free_run, "compile_law", lambda _: SimpleNamespace())
    device = SimpleNamespace(prescribed=False, forces=("force_motor",))
    system: Any = SimpleNamespace(
        model=SimpleNamespace(device=device), coordinates=("axis",), coordinate_units=("m",)
    )
    motions: Any = [SimpleNamespace(trial_id=name) for name in off]
    run: Any = None
    for judged, expected in (((False, True), 20.0), ((True, False), 1.0)):
        found = free_run.free_runs(run, system, motions, [np.ones(1)] * 2, judged)
        assert found.mode == "closed_loop" and set(found.trials) == set(off)
        assert found.axes["axis"].relative_error_percent == pytest.approx(expected)
        assert found.forces["force_motor"].relative_error_percent == pytest.approx(expected)
