"""How fast it is, how much memory it takes and how it installs, beside another commit.

    python benchmarks/speed.py --beside COMMIT --store
    python benchmarks/speed.py --beside COMMIT --without long install
    python benchmarks/speed.py --parts first robots --short

Every measurement is a process of its own, taken from this tree and then from the other one, which
is a git worktree in a temporary folder. Each tree has caches of its own, empty at the beginning;
both read the same logs. A row is a title, a unit, the number here, the number there, and their
ratio: below 1, this tree is better; rows of the filter alone are the other way round, and say so.
On a machine with other work, CPU time counts. On two quiet cores, without the other commit,
``long`` takes a quarter of an hour, ``install`` and ``diagnosis`` minutes, the others one or two.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from independent import arm, record
from independent.draws import USUAL, record_drawn

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
LIBRARIES = ("numpy", "scipy", "numba", "sympy", "pandas", "pyarrow")
STAGES = ("ingest", "filter", "identify", "validate")
FIRST = {"first result": "ingest/session.json", "estimates": "models/base/identify.json"}
"""Results of a run whose appearance is timed."""
JOINTS = {1: "Y", 3: "ZYY", 6: "ZYYXYX", 7: "ZYZYZYZ"}
HIDDEN: dict[str, dict[str, float]] = {
    "clean": {},
    "one effect": {"stribeck:yaw": 0.7},
    "four effects": {
        "stribeck:yaw": 0.7, "presliding:pitch": 0.7, "quadratic_drag:extension": 0.7,
        "transmission_compliance:pitch": 0.7,
    },
}  # fmt: skip
"""Sessions of the BAM that are diagnosed."""

Row = tuple[str, str, float]
"""Title, unit, number."""


@dataclass(frozen=True)
class Cost:
    """Of a process with its children: wall and CPU time, s, largest resident memory, MB."""

    wall: float
    cpu: float
    memory: float
    seen: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Tree:
    """A source tree, and a folder with its caches and its runs."""

    root: Path
    home: Path

    def run(self, *arguments: str, watch: Mapping[str, Path] | None = None) -> Cost:
        """Run ``python ARGUMENTS`` with this tree; note when each file of ``watch`` appears."""
        environment = os.environ | {
            "PYTHONPATH": str(self.root),
            "BAMPIPE_CACHE_DIR": str(self.home / "code"),
            "NUMBA_CACHE_DIR": str(self.home / "compiled"),
        }
        log = self.home / "log.txt"
        begun, seen = time.perf_counter(), {}
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, *arguments], cwd=self.home, env=environment, stdout=out,
                stderr=subprocess.STDOUT,
            )  # fmt: skip
            while True:
                ended, status, usage = os.wait4(process.pid, os.WNOHANG if watch else 0)
                for title, path in (watch or {}).items():
                    if title not in seen and path.exists():
                        seen[title] = time.perf_counter() - begun
                if ended:
                    break
                time.sleep(0.02)
        wall = time.perf_counter() - begun
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in (0, 1):  # 1: a gate failed
            text = log.read_text(encoding="utf-8", errors="replace")
            raise RuntimeError(f"{' '.join(arguments)}: exit {process.returncode}\n{text[-2000:]}")
        return Cost(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0, seen)

    def bampipe(self, *arguments: str, watch: Mapping[str, Path] | None = None) -> Cost:
        """Run ``bampipe ARGUMENTS``."""
        return self.run("-m", "bampipe", *arguments, "--quiet", watch=watch)

    def read(self) -> str:
        """What the last process printed."""
        return (self.home / "log.txt").read_text(encoding="utf-8")


def measure_first_run(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """README's run with nothing compiled and again, then the first session of another device."""
    sample = str(tree.root / "sample_runs/first")
    for title, runs in (("first run, empty caches", "cold"), ("the same, compiled", "warm")):
        watch = {name: tree.home / runs / "first" / path for name, path in FIRST.items()}
        cost = tree.bampipe("run", sample, "--runs", runs, watch=watch)
        yield from ((f"{title}: {name}", "s", at) for name, at in cost.seen.items())
        yield f"{title}: in all", "s", cost.wall
        yield f"{title}: CPU", "s", cost.cpu
    session = _made(logs / "second", lambda at: record("joint", at, 1, {}, USUAL["joint"]))
    cost = tree.bampipe("run", str(session), "--runs", "cold")
    yield "second device, only its own functions to compile", "s", cost.wall


def measure_start(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """Start of the command line."""
    costs = [tree.run("-m", "bampipe", "--help") for _ in range(6)][1:]
    yield "bampipe --help, least of five", "s", min(cost.wall for cost in costs)
    yield "bampipe --help, least of five: CPU", "s", min(cost.cpu for cost in costs)


def measure_robots(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """`identify` of arms and of a light drive with much friction, everything compiled."""
    for count, kinds in JOINTS.items():
        rate = 250.0 if short or count < 7 else 1000.0
        seconds = 6.0 if short else 20.0
        source = _made(
            logs / f"arm{count}",
            lambda at, k=kinds, r=rate, s=seconds: arm.record_logs(
                at, 300, k, style="joint_states", trials=3, seconds=s, rate_hz=r
            ),
        )
        session = tree.home / f"arm{count}"
        shutil.copytree(source, session)
        tree.bampipe("init", str(session))
        plural = "s" if count > 1 else ""
        title = f"identify, {count} joint{plural}, 3 × {seconds:g} s at {rate:g} Hz"
        yield from _identify_again(tree, session, title)
    session = _made(logs / "drive", lambda at: record("drive", at, 3))
    yield from _identify_again(tree, session, "identify, light drive on a test bench")


def _identify_again(tree: Tree, session: Path, title: str) -> Iterator[Row]:
    tree.bampipe("run", str(session), "--until", "identify")
    cost = tree.bampipe("identify", session.name, "--force")
    yield title, "s", cost.wall
    yield f"{title}: CPU", "s", cost.cpu
    yield f"{title}: memory", "MB", cost.memory


def measure_diagnosis(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """`diagnose` of sessions of the BAM, everything compiled."""
    for number, (title, effects) in enumerate(HIDDEN.items()):
        session = _made(
            logs / f"hidden{number}",
            lambda at, e=effects: record_drawn(at, 60 + len(e), "bam", "good", e),
        )
        tree.bampipe("run", str(session), "--until", "validate")
        tree.bampipe("diagnose", session.name, "--set", "jobs=2")
        cost = tree.bampipe("diagnose", session.name, "--set", "jobs=2", "--force")
        yield f"diagnose, BAM, {title}", "s", cost.wall
        yield f"diagnose, BAM, {title}: CPU", "s", cost.cpu


def measure_long_session(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """Memory and time of each stage on a long session: one simulated trial, over and over."""
    count, trial = (10**5 if short else 10**7), 4000
    source = _simulated(tree, logs, "trials", 5, trial / 500.0)
    session = _made(logs / "long", lambda at: repeat_session(source, at, count // (5 * trial)))
    tree.bampipe("run", str(source), "--runs", "warmed", "--until", "validate")
    for stage in STAGES:
        cost = tree.bampipe(stage, str(session) if stage == "ingest" else session.name)
        title = f"{stage}, {count:.0e} samples"
        yield f"{title}: memory", "MB", cost.memory
        yield f"{title}: CPU a sample", "µs", 1e6 * cost.cpu / count
    shutil.rmtree(tree.home / "runs" / session.name)


def measure_batch(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """A batch of small sessions, two trials of four seconds each."""
    count = 10 if short else 200
    source = _simulated(tree, logs, "small", 2, 4.0)

    def make(at: Path) -> None:
        for number in range(count):
            repeat_session(source, at / f"s{number:03d}", 1)

    batch = _made(logs / "batch", make)
    tree.bampipe("run", str(source), "--runs", "warmed", "--until", "compare")
    sessions = [str(path) for path in sorted(batch.iterdir())]
    cost = tree.bampipe("run", *sessions, "--jobs", "2", "--runs", "many", "--until", "compare")
    yield f"batch of {count} sessions, 2 jobs: a session", "s", cost.wall / count
    yield f"batch of {count} sessions: CPU a session", "s", cost.cpu / count
    yield f"batch of {count} sessions: largest process", "MB", cost.memory
    dask = "--engine", "dask", "--runs", "dask", "--until", "compare"
    cost = tree.bampipe("run", *sessions, *dask)
    yield f"batch of {count} sessions, Dask, a worker a core: a session", "s", cost.wall / count
    yield f"batch of {count} sessions, Dask: CPU a session", "s", cost.cpu / count


def measure_install(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """Installation into an empty environment from pip's cache."""
    place = tree.home / "environment"
    source = tree.home / "source"
    shutil.copytree(tree.root, source, ignore=shutil.ignore_patterns(".git", "build", "*.egg-info"))
    subprocess.run([sys.executable, "-m", "venv", str(place)], check=True)
    install = [str(place / "bin/python"), "-m", "pip", "install", "--quiet", str(source)]
    subprocess.run(install, check=True)  # what is not in pip's cache yet is fetched here
    shutil.rmtree(place)
    subprocess.run([sys.executable, "-m", "venv", str(place)], check=True)
    empty = _megabytes(place)
    begun = time.perf_counter()
    subprocess.run(install, check=True)
    took = time.perf_counter() - begun
    yield "install, pip, from its cache", "s", took
    yield "install, size beside an empty environment", "MB", _megabytes(place) - empty


def measure_filter(tree: Tree, logs: Path, short: bool) -> Iterator[Row]:
    """The filter beside C in one process, by `filter_speed.py`."""
    seconds, repeats = ("4", "3") if short else ("16", "15")
    for device in ("slider", "bam"):
        tree.run(
            str(ROOT / "benchmarks/filter_speed.py"), "--device", device, "--only-c",
            "--seconds", seconds, "--repeats", repeats,
        )  # fmt: skip
        found = re.findall(r"^\| (.*?) \| ([\d.]+) \| .*? \| ([\d.]+) \|$", tree.read(), re.M)
        for title, step, ratio in found:
            if title == "bampipe":
                yield f"filter, {device}: a step", "µs", float(step)
            else:
                yield f"filter, {device}: {title} over bampipe, more is better", "×", float(ratio)


PARTS: dict[str, Callable[[Tree, Path, bool], Iterator[Row]]] = {
    "start": measure_start,
    "first": measure_first_run,
    "robots": measure_robots,
    "diagnosis": measure_diagnosis,
    "long": measure_long_session,
    "batch": measure_batch,
    "install": measure_install,
    "filter": measure_filter,
}


def _made(folder: Path, make: Callable[[Path], object]) -> Path:
    """The folder, made where it does not exist: both trees read the same logs."""
    if not folder.exists():
        folder.mkdir(parents=True)
        make(folder)
    return folder


def _simulated(tree: Tree, logs: Path, name: str, trials: int, seconds: float) -> Path:
    """A simulated session of the BAM, as Parquet."""
    session = logs / name
    if not session.exists():
        tree.bampipe(
            "simulate", str(session), "--seed", "1", "--trials", str(trials),
            "--duration", str(seconds), "--file-format", "parquet",
        )  # fmt: skip
    return session


def repeat_session(source: Path, target: Path, copies: int) -> None:
    """Write a session with the trials of ``source`` so many times over.

    A file that is there twice counts once, so the force reading of each copy is shifted by a
    nanovolt: that changes the file and no result.
    """
    head, *trials = (source / "session.toml").read_text(encoding="utf-8").split("[[trials]]")
    (target / "trials").mkdir(parents=True, exist_ok=True)
    blocks = [re.sub(r"(?m)^session_id = .*$", f'session_id = "{target.name}"', head)]
    for copy in range(copies):
        for block in trials:
            name = block.split('file = "')[1].split('"')[0]
            new = f"trials/c{copy:04d}_{Path(name).name}"
            frame = pd.read_parquet(source / name)
            frame["force_x_v"] += 1e-9 * copy
            frame.to_parquet(target / new)
            blocks.append("[[trials]]" + block.replace(name, new))
    (target / "session.toml").write_text("".join(blocks), encoding="utf-8")


def _megabytes(folder: Path) -> float:
    return sum(p.lstat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6


def measure(trees: Mapping[str, Tree], parts: Sequence[str], logs: Path, short: bool) -> list[dict]:
    """Measure each part, one tree after the other; where one cannot, its numbers are none."""
    rows: dict[str, dict[str, object]] = {}
    for part in parts:
        for name, tree in trees.items():
            try:
                for title, unit, value in PARTS[part](tree, logs, short):
                    row = rows.setdefault(title, {"part": part, "title": title, "unit": unit})
                    row[name] = round(value, 4)
                    print(f"{name}: {title}: {value:.3g} {unit}", file=sys.stderr, flush=True)
            except (RuntimeError, subprocess.CalledProcessError) as problem:
                print(f"{part}, {name}: {problem}", file=sys.stderr)
    return list(rows.values())


def write_table(content: Mapping[str, Any]) -> str:
    """The rows as Markdown: with ratios where there is another commit, else a line a process."""
    here, beside = content["commit"], content["beside"]
    versions = ", ".join(f"{name} {number}" for name, number in content["versions"].items())
    head = f"{content['machine']}, load {content['load']} at the beginning; {versions}"
    if beside:
        table = [f"| | unit | {here} | {beside} | ratio |", "|-|-|-|-|-|"]
        for row in content["rows"]:
            ours, theirs = row.get("this"), row.get("other")
            numbers = ours, theirs, ours / theirs if ours and theirs else None
            table.append(
                f"| {row['title']} | {row['unit']} | {' | '.join(map(_number, numbers))} |"
            )
        return "\n".join([head, "", *table])
    lines: dict[str, list[str]] = {}
    for row in content["rows"]:
        title, _, kind = row["title"].partition(": ")
        place = ("CPU", "memory").index(kind) + 1 if kind in ("CPU", "memory") else 0
        if f"{title}: in all" in lines and place:
            title += ": in all"
        line = lines.setdefault(title if place else row["title"], ["", "", ""])
        line[place] = _number(row["this"]) + ("" if place else f" {row['unit']}")
    table = [f"| | {here} | CPU, s | memory, MB |", "|-|-|-|-|"]
    table += [f"| {title} | {' | '.join(line)} |" for title, line in lines.items()]
    return "\n".join([head, "", *table])


def _number(value: float | None) -> str:
    return (
        "–"
        if value is None or not np.isfinite(value)
        else f"{value:.3g}"
        if value < 1e3
        else f"{value:.0f}"
    )


def _commit_of(name: str) -> str:
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", name]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def main(arguments: Sequence[str]) -> None:
    """Measure, print the table, and store it where asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--beside", help="a commit to measure beside this tree")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--without", nargs="+", choices=PARTS, default=[])
    parser.add_argument("--short", action="store_true", help="small sizes, to try the parts")
    parser.add_argument("--store", action="store_true", help="write results/speed.json")
    given = parser.parse_args(arguments)
    load = f"{os.getloadavg()[0]:.1f}"
    commit = _commit_of("HEAD")
    beside = _commit_of(given.beside) if given.beside else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trees = {"this": Tree(ROOT, folder / "this")}
        if given.beside:
            worktree = ["git", "-C", str(ROOT), "worktree"]
            subprocess.run([*worktree, "add", "--detach", str(folder / "tree"), given.beside],
                           check=True, capture_output=True)  # fmt: skip
            trees["other"] = Tree(folder / "tree", folder / "other")
        try:
            for tree in trees.values():
                tree.home.mkdir()
            parts = [part for part in given.parts if part not in given.without]
            rows = measure(trees, parts, folder / "logs", given.short)
        finally:
            if given.beside:
                subprocess.run([*worktree, "remove", "--force", str(folder / "tree")], check=True)
    python = f"Python {platform.python_version()}"
    content = {
        "commit": commit,
        "beside": beside,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {python}",
        "load": load,
        "versions": {library: version(library) for library in LIBRARIES},
        "rows": rows,
    }
    print(write_table(content))
    if given.store:
        text = json.dumps(content, indent=1, ensure_ascii=False)
        (RESULTS / "speed.json").write_text(text + "\n", encoding="utf-8")
        path = RESULTS / "measured.json"
        measured = json.loads(path.read_text(encoding="utf-8"))
        command = " ".join(["python benchmarks/speed.py", *arguments])
        measured["speed"] = {"command": command, "commit": commit}
        text = json.dumps(dict(sorted(measured.items())), indent=2, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
