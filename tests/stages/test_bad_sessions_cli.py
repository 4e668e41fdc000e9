"""The bad-input corpus as a user meets it: exit code, one line, nothing left behind."""

import json
import re
from pathlib import Path

import pytest
from conftest import Command
from made_session import Made
from test_bad_sessions import ASIDE, REFUSED, REPAIRED, T01, Damage

from bampipe.data.store import read_parquet


def make(damage: Damage, session: Path) -> Path:
    made = Made()
    after = damage(made)
    made.write(session)
    if after is not None:
        after(session)
    return session


@pytest.mark.parametrize("name", REFUSED)
def test_a_session_is_refused_by_a_line_a_fault(
    name: str, tmp_path: Path, command: Command
) -> None:
    damage, message = REFUSED[name]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs")
    assert (code, out) == (2, "")
    lines = [line for line in err.splitlines() if line.startswith("bampipe: error: ")]
    assert lines and err.endswith("\n".join(lines) + "\n") and "Traceback" not in err, err
    assert all(str(session) in line for line in lines), "a line a fault"
    assert re.search(message, err)
    assert not list((tmp_path / "runs").glob("*")), "a refused session leaves no run folder"


@pytest.mark.parametrize("name", ASIDE)
def test_a_trial_is_set_aside_in_one_line(name: str, tmp_path: Path, command: Command) -> None:
    damage, message = ASIDE[name]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs", "--quiet")
    assert (code, err) == (0, "")
    assert "3 trials: 2 sound, 1 set aside" in out
    (line,) = [line for line in out.splitlines() if line.startswith("set aside: ")]
    assert line.startswith("set aside: t01: trials/t01.")
    assert re.search(message, line.removeprefix("set aside: t01: ")), line
    (samples,) = (tmp_path / "runs").glob("*/ingest/samples.parquet")
    assert set(read_parquet(samples).trial_id) == {"t02", "t03"}


def test_a_repair_is_said_in_one_line(tmp_path: Path, command: Command) -> None:
    damage, message = REPAIRED["a few NaN"]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs", "--quiet")
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if line.startswith("note: t01: ")]
    assert re.search(message, line), line


def test_a_refused_session_leaves_earlier_results_as_they_were(
    tmp_path: Path, command: Command
) -> None:
    session = make(lambda made: None, tmp_path / "session")
    assert command("ingest", session, "--runs", tmp_path / "runs")[0] == 0
    (root,) = (tmp_path / "runs").glob("*")
    before = {path: path.read_bytes() for path in root.rglob("*.parquet")}
    text = (session / "session.toml").read_text()
    (session / "session.toml").write_text(text.replace("session/1", "session/9"))
    code, _, err = command("ingest", session, "--runs", tmp_path / "runs", "--quiet")
    assert code == 2 and err.count("\n") == 1 and "session/9" in err
    assert before and {path: path.read_bytes() for path in root.rglob("*.parquet")} == before


def test_a_byte_order_mark_hides_no_change(tmp_path: Path, command: Command) -> None:
    """A session file saved by an editor that puts a mark first: its trials are watched too."""
    session = make(lambda made: None, tmp_path / "session")
    path = session / "session.toml"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    arguments = ("ingest", session, "--runs", tmp_path / "runs", "--json", "--quiet")
    assert json.loads(command(*arguments)[1])["set_aside"] == []
    (session / T01).write_text("")
    assert [row["trial_id"] for row in json.loads(command(*arguments)[1])["set_aside"]] == ["t01"]
