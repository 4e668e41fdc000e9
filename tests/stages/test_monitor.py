"""The monitor: the batch filter's numbers, an alarm when the plant changes, a growing file."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Command
from identified_run import RESOLUTION, TRUTH, simulated_run
from made_results import write_model, write_result

from bampipe.cli.monitor import _Output, follow
from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.data.stream import SampleStream
from bampipe.errors import InputError
from bampipe.estimate.unscented import Trial, filter_trials
from bampipe.files import read_json
from bampipe.monitor.monitor import Monitor
from bampipe.monitor.start import MonitorOptions, list_layouts, open_stream, start_from_run
from bampipe.physics import Model, compile_model, registry
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A simulated run, identified perfectly."""
    found = simulated_run(tmp_path_factory.mktemp("monitored"), seconds=12.0)
    return known(found, TRUTH)


def known(found: RunFolder, truth: dict[str, float]) -> RunFolder:
    """The run with the truth as its identified parameters, with small uncertainties."""
    names = list(truth)
    sd = np.array([0.002 * abs(value) for value in truth.values()])
    axes = read_json(found.path("ingest/session.json"))["axes"]
    content = {
        "parameters": {n: {"estimate": truth[n], "sd": s} for n, s in zip(names, sd, strict=True)},
        "covariance": {"names": names, "matrix": np.diag(sd**2).tolist()},
        "input_timing": {"estimate": 0.0},
        "noise": {
            "reading_sd": {a: axes[a]["resolution"] / np.sqrt(12.0) for a in axes},
            "process_sd": dict.fromkeys(
                ("force_x", "force_y", "force_z", "gravity_compensator"), 0.05
            ),
        },
    }
    write_result(found.root, IdentifyResult, **content)
    return found


@pytest.fixture(scope="module")
def begun(run: RunFolder):
    return start_from_run(run, "base", MonitorOptions())


def samples(run: RunFolder, trial: str) -> pd.DataFrame:
    return read_parquet(run.path("ingest/samples.parquet"), trial=trial).drop(columns="trial_id")


def monitor_of(begun: tuple, tell: Callable[[str], object] = pytest.fail) -> Monitor:
    """A monitor with the usual options; where none is given, it must have nothing to tell."""
    return Monitor(*begun, MonitorOptions(), tell)


def push(monitor: Monitor, frame: pd.DataFrame) -> None:
    monitor.push(tuple(frame.columns), frame.to_numpy(dtype=float))


def test_same_estimates_as_the_batch_filter(run: RunFolder, begun: tuple) -> None:
    system, start = begun
    frame = samples(run, "t01")
    names, values = tuple(frame.columns), frame.to_numpy(dtype=float)
    monitor = monitor_of(begun)
    for first in range(0, len(values), 77):
        monitor.push(names, values[first : first + 77])
    n = len(system.coordinates)
    y, u = values[:, 1 : 1 + n].copy(), values[:, 1 + n :].copy()
    batch = filter_trials(
        start.model,
        [Trial(values[:, 0].copy(), u, y, *start.state(system, y[0], u[0]))],
        start.theta, start.covariance, start.settings._replace(stride=1),
    )  # fmt: skip
    report = monitor.report()
    theta, _ = start.model.to_physical(batch.theta)
    found = [item["estimate"] for item in report["parameters"].values()]
    np.testing.assert_allclose(found, theta, rtol=1e-12)
    mean = batch.trials[0].mean[-1]
    for i, state in enumerate(report["state"].values()):
        assert state["position"] == pytest.approx(mean[i], rel=1e-12, abs=1e-14)
        assert state["velocity"] == pytest.approx(mean[n + i], rel=1e-12, abs=1e-14)


def test_a_run_of_thinned_logs_is_refused(run: RunFolder, tmp_path: Path) -> None:
    """A stream has every sample, and a window of the model's would be another time."""
    thinned = RunFolder(Path(shutil.copytree(run.root, tmp_path / "run")))
    result = thinned.read(IngestResult).model_copy(update={"kept_every": 5})
    result.write(thinned.root)
    with pytest.raises(InputError, match="one sample in 5") as raised:
        start_from_run(thinned, "base", MonitorOptions())
    assert "ingest.fastest_hz=0" in raised.value.remedy


def test_no_alarm_while_nothing_changes(run: RunFolder, begun: tuple) -> None:
    monitor = monitor_of(begun)
    push(monitor, samples(run, "t00"))
    report = monitor.report()
    assert report["nis"]["windows"] >= 10
    assert report["alarms"] == 0
    for name, value in TRUTH.items():
        entry = report["parameters"][name]
        assert entry["lower"] - 0.01 * value < value < entry["upper"] + 0.01 * value


def test_begins_where_the_mechanism_is_and_not_its_encoder(tmp_path: Path) -> None:
    """An encoder that reads 5 % too much: where it points, the mechanism never was."""
    hidden = {"encoder_scale.yaw.error": -0.05}
    found = simulated_run(tmp_path, trials=1, effect="encoder_scale:yaw", hidden=hidden)
    write_model(found.root, "base", "encoder_scale:yaw")
    monitor = monitor_of(start_from_run(known(found, TRUTH | hidden), "base", MonitorOptions()))
    values = samples(found, "t00")
    push(monitor, values.head(5))
    read = float(values["q_yaw"].iloc[4])
    state = monitor.report()["state"]["yaw"]
    assert abs(0.05 * read) > 10.0 * RESOLUTION["yaw"]
    assert state["position"] == pytest.approx(0.95 * read, abs=2.0 * RESOLUTION["yaw"])


def test_alarm_when_a_sensor_changes(run: RunFolder, begun: tuple) -> None:
    monitor = monitor_of(begun, lambda _: None)
    frame = samples(run, "t00")
    changed = frame["t"] > 6.0
    frame.loc[changed, "force_x"] *= 1.2
    push(monitor, frame[~changed])
    assert monitor.alarms == 0
    push(monitor, frame[changed])
    assert monitor.alarms > 0


def test_a_gap_starts_the_motion_and_not_the_parameters(run: RunFolder, begun: tuple) -> None:
    said: list[str] = []
    monitor = monitor_of(begun, said.append)
    frame = samples(run, "t00")
    push(monitor, frame[frame["t"] < 4.0])
    before = monitor.report()["parameters"]["mass"]
    push(monitor, frame[frame["t"] > 6.0])
    after = monitor.report()["parameters"]["mass"]
    assert monitor.restarts == 1
    assert "gap" in said[0]
    assert after["upper"] - after["lower"] < 1.2 * (before["upper"] - before["lower"])
    assert monitor.alarms == 0


def test_a_lost_motion_starts_anew(run: RunFolder, begun: tuple) -> None:
    """A force of 1e200 N: the filter fails, the monitor goes on."""
    said: list[str] = []
    monitor = monitor_of(begun, said.append)
    frame = samples(run, "t00")
    frame.loc[1000, "force_x"] = 1e200
    push(monitor, frame)
    assert monitor.restarts >= 1
    assert "grew without bound" in said[0]
    state = monitor.report()["state"]
    assert all(np.isfinite(list(item.values())).all() for item in state.values())


def test_memory_and_speed_hold(run: RunFolder, begun: tuple) -> None:
    """5 kHz sustained, parsing included, on one core; nothing grows."""
    frame = samples(run, "t00")
    source, sink = os.pipe()
    stream = SampleStream(source, "pipe", list_layouts(begun[0], None), True, pytest.fail)
    monitor = monitor_of(begun)
    text = frame.to_csv(index=False).encode()
    step, taken, begin = 1 << 14, 0, time.process_time()
    for first in range(0, len(text), step):
        os.write(sink, text[first : first + step])
        values = stream.read()
        if len(values):
            monitor.push(stream.names, values)
            taken += len(values)
    rate = taken / (time.process_time() - begin)
    os.close(sink)
    os.close(source)
    assert taken >= len(frame) - 1
    assert rate > 5000.0, rate


def test_follows_a_growing_file_until_told_to_stop(run: RunFolder, tmp_path: Path) -> None:
    frame = samples(run, "t00")
    lines = frame.to_csv(index=False).splitlines(keepends=True)
    log = tmp_path / "log.csv"
    log.write_text("".join(lines[:1500]) + lines[1500][:20])
    process = subprocess.Popen(
        [sys.executable, "-m", "bampipe", "monitor", str(log), "--device", "bam", "--every", "0.5"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # Tests run in the background by a shell inherit that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    first = json.loads(process.stdout.readline())
    with log.open("a") as file:
        file.write(lines[1500][20:] + "not a line\n" + "".join(lines[1501:3001]))
    later = first
    while later["samples"] < 2500:
        later = json.loads(process.stdout.readline())
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert 0 < first["samples"] <= 1499  # a line half written waits for its end
    assert json.loads(out.splitlines()[-1])["bad_lines"] == 1
    assert "line 1502" in errors
    assert "Traceback" not in errors
    assert later["parameters"]["mass"]["lower"] < 3.5 < later["parameters"]["mass"]["upper"]


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("t,q_yaw\n", [], "line 1: no column 'q_pitch'"),
        ("", ["--run", "nothing"], "exclude each other"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, command: Command, text: str, options: list[str], said: str
) -> None:
    log = tmp_path / "log.csv"
    log.write_text(text)
    code, _, errors = command("monitor", log, "--device", "bam", "--once", *options)
    assert code == 2 and said in errors and len(errors.splitlines()) == 1


def test_a_model_with_a_force_rate_is_refused() -> None:
    system = compile_model(Model(registry.device("bam"), ("force_delay",)))
    with pytest.raises(InputError, match="not known in real time"):
        list_layouts(system, None)


# Data of no use


@pytest.mark.parametrize(
    ("cell", "columns"),
    [
        ("nan", ("q_yaw",)),
        ("", ("q_yaw", "q_pitch", "q_extension")),
        ("inf", ("q_yaw",)),
        ("1e308", ("force_x",)),
        ("1_0", ("force_x",)),
    ],
    ids=["nothing", "empty", "infinite", "overflow", "words"],
)
def test_useless_data_is_an_alarm(
    run: RunFolder, begun: tuple, tmp_path: Path, cell: str, columns: tuple[str, ...]
) -> None:
    """Two seconds are as they should be, then a sensor dies."""
    frame = samples(run, "t00").astype(object)
    dead = frame["t"] > 2.0
    for column in columns:
        frame.loc[dead, column] = cell
    found = followed(begun, frame.to_csv(index=False), tmp_path)
    for column in columns:
        frame[column] = cell
    for start in (begun[1], None):  # of a run, and of a device alone: useless from the start
        assert followed((begun[0], start), frame.to_csv(index=False), tmp_path)["alarm"]
    assert found["alarm"] and found["alarms"] == 1
    assert found["restarts"] == 0
    if found["bad_lines"]:
        assert found["bad_lines"] == int(dead.sum())
    else:
        assert cell in ("nan", "") and columns[0] == "q_yaw"
        assert found["nis"]["useless"] == [name.removeprefix("q_") for name in columns]
        assert found["nis"]["window"] is None


def test_a_slow_sensor_is_no_useless_one(run: RunFolder, begun: tuple, tmp_path: Path) -> None:
    frame = samples(run, "t00")
    frame.loc[frame.index % 4 != 0, "q_yaw"] = np.nan
    assert not followed(begun, frame.to_csv(index=False), tmp_path)["alarm"]


def followed(begun: tuple, text: str, folder: Path) -> dict:
    """What the monitor says in the end of a file that holds ``text``."""
    path = folder / "log.csv"
    path.write_text(text)
    watch = monitor_of(begun, lambda _: None)
    stream = open_stream(str(path), begun[0], None, False, lambda _: None)
    try:
        follow(stream, watch, _Output(None, 1.0), wait=False)
    finally:
        os.close(stream.descriptor)
    json.dumps(watch.report(), allow_nan=False)
    return {**watch.report(), "bad_lines": stream.bad_lines}


@pytest.mark.parametrize("value", ["0", "-1", "nan"])
def test_an_option_is_called_by_its_name(command: Command, value: str) -> None:
    for option in ("--window", "--false-alarms", "--memory", "--every"):
        code, _, said = command("monitor", "x.csv", "--device", "slider", option, value)
        assert (code, said) == (2, f"bampipe: error: {option}: must be positive\n")
