"""`bampipe monitor`: the filter on samples as they arrive."""

import json as json_text
import os
import sys
import time
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bampipe.cli import places, show
from bampipe.cli.options import RUNS, BestModelOption, RunsOption
from bampipe.errors import InputError

if TYPE_CHECKING:
    from rich.live import Live

    from bampipe.data.stream import SampleStream
    from bampipe.monitor.monitor import Monitor

POLL_S = 0.02
SCREEN_S = 0.25
BLANK: Mapping[str, Any] = {}


def monitor(
    samples: Annotated[
        str, typer.Argument(metavar="FILE", help="A text table that grows; - for standard input.")
    ] = "-",
    run: Annotated[
        str, typer.Option("--run", help="Run folder or name; the most recent run if omitted.")
    ] = "",
    model: BestModelOption = "",
    device: Annotated[
        str, typer.Option("--device", help="Without a run: a built-in device or a device file.")
    ] = "",
    session: Annotated[
        Path | None,
        typer.Option("--session", help="Session folder whose raw logs have the columns of FILE."),
    ] = None,
    every: Annotated[float, typer.Option("--every", help="Seconds of data per line.")] = 1.0,
    window_s: Annotated[
        float, typer.Option("--window", help="Length of the windows that the alarm judges, s.")
    ] = 1.0,
    false_alarms: Annotated[
        float, typer.Option("--false-alarms", help="False alarms of a consistent filter, per hour.")
    ] = 1.0,
    memory_s: Annotated[
        float, typer.Option("--memory", help="Time in which parameters may drift by their sd, s.")
    ] = 60.0,
    once: Annotated[
        bool, typer.Option("--once", help="Stop at the end of the file; do not wait for more.")
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Stop at the first bad line instead of skipping it.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="JSON lines on a terminal too.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No remarks.")] = False,
    runs: RunsOption = RUNS,
) -> None:
    """Follow a log as it grows: state, parameters with bounds, and an alarm.

    Columns by name as in ingest/samples.parquet (t, q_yaw, force_x, brake_yaw, ...; SI), or with
    --session those of its raw logs. Bad lines are skipped and counted. Stop with Ctrl-C.

    Example: bampipe monitor log.csv --run 2026-10-03_s01

    Example: logger | bampipe monitor - --run 2026-10-03_s01 --session sessions/2026-10-03_s01
    """
    from rich.live import Live

    from bampipe.data.run_folder import RunFolder
    from bampipe.monitor import monitor as monitoring
    from bampipe.monitor import start as monitor_start
    from bampipe.run import models

    options = monitor_start.MonitorOptions(window_s, false_alarms, memory_s)
    options.check()
    if not every > 0.0:
        raise InputError("must be positive", where="--every")
    if device and run:
        raise InputError("--device and --run exclude each other")

    def remark(text: str) -> None:
        if not quiet:
            show.note(f"bampipe: {text}")

    if device:
        from bampipe.declarations.files import read_device
        from bampipe.physics import Model, compile_model, registry

        bare = Model(registry.device_from(*read_device(device)))
        system, start = compile_model(bare), None
    else:
        folder = RunFolder(places.find_run(run or None, runs))
        chosen = models.choose_model(folder.root, model)
        remark(f"model {chosen} of {folder.root}")
        system, start = monitor_start.start_from_run(folder, chosen, options)
    stream = monitor_start.open_stream(samples, system, session, strict, remark)
    watch = monitoring.Monitor(system, start, options, remark)
    try:
        on_screen = sys.stdout.isatty() and not json
        with Live(auto_refresh=False) if on_screen else nullcontext() as screen:
            follow(stream, watch, _Output(screen, every), wait=not once and samples != "-")
    finally:
        if stream.descriptor != 0:
            os.close(stream.descriptor)


def follow(stream: "SampleStream", watch: "Monitor", output: "_Output", wait: bool) -> None:
    """Filter the stream to its end, or if ``wait``, until the user stops it."""
    with suppress(KeyboardInterrupt):
        while True:
            values = stream.read(last=not wait)
            if len(values):
                watch.push(stream.names, values)
                output.show(watch, stream)
            watch.note_lines_without_sample(stream.lines_without_sample)
            if watch.alarm and not len(values):
                output.show(watch, stream)
            if stream.ended:
                if not wait:
                    break
                time.sleep(POLL_S)
    output.show(watch, stream, final=True)


class _Output:
    """Write a JSON line per interval of data, or on a terminal a table a few times a second."""

    def __init__(self, screen: "Live | None", every: float) -> None:
        self._every, self._next, self._drawn = every, -float("inf"), 0.0
        self._alarm = False
        self._screen = screen

    def show(self, watch: "Monitor", stream: "SampleStream", final: bool = False) -> None:
        """Show the current state if it is time to."""
        if self._screen:
            if final or time.monotonic() - self._drawn > SCREEN_S:
                self._drawn = time.monotonic()
                self._screen.update(_draw_table(watch.report(), stream.bad_lines), refresh=True)
            return
        content = watch.report()
        t = content["t"]
        alarm = watch.alarm and not self._alarm
        self._alarm = watch.alarm
        if not final and not alarm and not (isinstance(t, float) and t >= self._next):
            return
        if isinstance(t, float):
            self._next = t + self._every
        line = json_text.dumps({**content, "bad_lines": stream.bad_lines}, sort_keys=True)
        show.write_line(line)


def _draw_table(content: Mapping[str, Any], bad_lines: int) -> Any:
    """Return the screen: state and parameters, and below them the consistency of the filter."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for justify in ("left", "right", "right", "left"):
        table.add_column(justify=justify)
    for axis, one in content.get("state", BLANK).items():
        sd = f"± {2.0 * one['velocity_sd']:.2g}"
        table.add_row(axis, f"{one['position']:.5f}", f"{one['velocity']:+.4f} /s", sd)
    for name, one in content.get("parameters", BLANK).items():
        interval = f"{one['lower']:.4g} to {one['upper']:.4g}"
        table.add_row(name, f"{one['estimate']:.4g}", interval, one["unit"])
    clock = "–" if content["t"] is None else f"{content['t']:.2f} s"
    table.add_row("t", clock, f"{content['samples']} samples", "")
    table.add_row("innovations", "", "", _tell_consistency(content))
    restarts = f"{content['restarts']} restarts"
    table.add_row("alarms", str(content["alarms"]), f"{bad_lines} bad lines", restarts)
    return table


def _tell_consistency(content: Mapping[str, Any]) -> Any:
    from rich.text import Text

    nis = content.get("nis", BLANK)
    ratio = nis.get("window")
    if content["alarm"]:
        said = f"no usable data {', '.join(nis.get('useless', ()))}".strip()
        said = said if ratio is None else f"{nis['worst']} is not explained ({ratio:.2f})"
        return Text(f"ALARM: {said}", style="bold red")
    if ratio is None:
        return Text("waiting for a complete window")
    return Text(f"consistent ({ratio:.2f}, alarm from {nis['threshold']:.2f})", style="green")
