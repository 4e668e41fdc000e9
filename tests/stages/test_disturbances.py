"""Hits, dead sensors and warm-ups are left out and said; what a machine does is not."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import independent
import numpy as np
import pandas as pd
import pytest
from disturbances import DRIVES, SPOILT
from independent_runs import SHORT, run_short

from bampipe.data.run_folder import RunFolder
from bampipe.results.filter import Disturbance, FilterResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.validate import ValidateResult

Spoil = Callable[[np.ndarray, float], None]


def identified(root: Path, name: str, spoil: Spoil | None = None, machine: str = "joint"):
    """A session, its first trial spoilt, as identified and judged."""
    folder = root / name
    shutil.copytree(root / machine, folder)
    text = (folder / "session.toml").read_text()
    (folder / "session.toml").write_text(text.replace(f'_id = "{machine}"', f'_id = "{name}"'))
    if spoil is not None:
        path = min(folder.rglob("*.csv"))
        table = pd.read_csv(path)
        force = table[DRIVES[machine]].to_numpy(float, copy=True)
        spoil(force, 1.0 / float(np.median(np.diff(table["t"]))))
        table[DRIVES[machine]] = force
        table.to_csv(path, index=False)
    return RunFolder(run_short(folder, root).root)


def stretches(run: RunFolder) -> tuple[Disturbance, ...]:
    found = run.read(FilterResult).disturbances
    return tuple(one for each in found.values() for one in each)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("disturbances")
    conditions = replace(SHORT["joint"], trials=4, seconds=10.0)
    independent.record("joint", folder / "joint", 72, {}, conditions)
    return folder


@pytest.fixture(scope="module")
def sound(root: Path) -> RunFolder:
    return identified(root, "sound")


def test_nothing_is_left_out_of_a_sound_session(sound: RunFolder) -> None:
    assert stretches(sound) == ()


@pytest.mark.parametrize("how", ["hit", "dead", "warm_up"])
def test_what_disturbs_is_left_out(root: Path, sound: RunFolder, how: str) -> None:
    def spoil(force: np.ndarray, rate: float) -> None:
        SPOILT[how](force, rate, np.random.default_rng(2))

    run = identified(root, how, spoil)
    one = stretches(run)[0]
    assert sum(each.end_s - each.start_s for each in stretches(run)) < 3.0
    expected = "stuck at one value" if how == "dead" else "a hit, a fault of a sensor"
    assert expected in one.reason
    before = sound.read(IdentifyResult, "base").parameters
    after = run.read(IdentifyResult, "base").parameters
    for name, entry in before.items():
        # Without what was cut, two widths of the sign may be about as likely: that is in the sd.
        sd = float(np.hypot(entry.sd, after[name].sd))
        assert abs(after[name].estimate - entry.estimate) < 3.0 * sd, name
        # By the information that is left, whichever method is published.
        assert after[name].bound_sd < 1.5 * entry.bound_sd, name
    (axis,) = run.read(ValidateResult, "base").axes.values()
    assert axis.standing == "at_floor"


def test_an_error_that_comes_back_is_none(tmp_path: Path) -> None:
    """A stop that the piston runs into again and again is an effect, not an event."""
    stop = {"upper_stop:piston": 1.0}
    independent.record("damper", tmp_path / "damper", 3, stop, SHORT["damper"])
    assert stretches(identified(tmp_path, "stop", machine="damper")) == ()
