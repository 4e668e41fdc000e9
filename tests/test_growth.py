"""What keeps the cost of a session linear in its length."""

import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.data import store
from bampipe.errors import InputError
from bampipe.identification.filter_run import choose_stride
from bampipe.trials.folds import Folds
from bampipe.trials.kept import KeptItems
from bampipe.trials.motion import Motion, trial_names


def test_trials_are_held_out_one_by_one_up_to_ten_then_in_ten_groups() -> None:
    names = [f"t{number}" for number in range(57)]
    assert Folds.of_trials(names[:10], (), names).groups == tuple(range(10))
    many = Folds.of_trials(names, (), names).groups
    assert len(many) == 57 and set(many) == set(range(10))
    assert max(many.count(k) for k in range(10)) - min(many.count(k) for k in range(10)) <= 1


def test_items_beyond_the_memory_come_back_bit_by_bit_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    rng = np.random.default_rng(0)
    names = ("q", "qd", "qdd", "qd_sd")
    given = [
        Motion(
            f"t{k} free",
            np.arange(7.0),
            **{name: rng.normal(size=(7, 2)) for name in names},
            channels={"force_x": rng.normal(size=7)},
        )
        for k in range(3)
    ]
    assert all(a is b for a, b in zip(given, KeptItems(given), strict=True))
    kept = KeptItems(iter(given), most=1000)
    for motion, back in zip(given, kept, strict=True):
        assert back.trial_id == motion.trial_id
        assert all(np.array_equal(getattr(motion, name), getattr(back, name)) for name in names)
        assert np.array_equal(motion.channels["force_x"], back.channels["force_x"])
        assert back is not motion
    assert kept[-1] is kept[2] and [m.trial_id for m in kept[:2]] == trial_names(kept)[:2]
    with pytest.raises(IndexError):
        kept[3]
    descriptors = Path("/dev/fd")
    held = len([*descriptors.iterdir()])
    del kept
    assert len([*descriptors.iterdir()]) == held - 1 and [*tmp_path.iterdir()] == []


def test_the_trials_of_a_table_with_and_without_a_row_group_each(tmp_path: Path) -> None:
    one, several = tmp_path / "one.parquet", tmp_path / "several.parquet"
    store.write_parquet(one, {"trial_id": np.array(["a", "a", "b"]), "t": np.arange(3.0)})
    with store.ParquetAppender(several) as file:
        file.append({"trial_id": np.array(["a", "b", "c"]), "t": np.arange(3.0)})
    assert store.trial_ids(one) == {"a", "b"}
    assert store.trial_ids(several) == {"a", "b", "c"}
    store.write_parquet(tmp_path / "none.parquet", {"t": np.arange(3.0)})
    with pytest.raises(InputError, match="no column 'trial_id'"):
        store.trial_ids(tmp_path / "none.parquet")


def test_what_the_filter_stores_is_bounded_in_a_trial_and_in_all() -> None:
    def stride(*sizes: int) -> int:
        return choose_stride([SimpleNamespace(t=np.empty(size)) for size in sizes])  # type: ignore[misc]

    assert stride(8000, 8000, 8000) == 1
    assert stride(20_001) == 2
    assert stride(*[8000] * 12) == 1
    assert stride(*[8000] * 13) == 2
    assert stride(*[4000] * 2500) == 100
