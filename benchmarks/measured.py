"""What benchmarks on measured machines share: the program run as a user does, free runs, storage.

Results are JSON files in `benchmarks/results/`, with the command, the commit and the versions that
made them; `validation.py` makes the tables of docs/validation.md from these.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate
from bampipe.estimate.simulation import make_plant, simulate
from bampipe.physics import System, compile_model
from bampipe.trials.motion import Motion
from bampipe.trials.reading import read_motions

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DATA = ROOT.parent / "shared" / "real"
PACKAGES = ("bampipe", "numpy", "scipy", "numba")


class Failed(Exception):
    """A command that refused or did not end; the text is its last line."""


def parse(document: str | None, **more: Any) -> tuple[argparse.Namespace, Path]:
    """The options that all share, and the folder to work in.

    Args:
        document: of the script; its first line is the help.
        more: further options, name to arguments of `add_argument`.
    """
    parser = argparse.ArgumentParser(description=(document or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    parser.add_argument("--work", type=Path, help="keep sessions and runs here")
    parser.add_argument("--out", type=Path, help="where the JSON goes; benchmarks/results/ else")
    for name, options in more.items():
        parser.add_argument(f"--{name}", **options)
    given = parser.parse_args()
    work = given.work or Path(tempfile.mkdtemp(prefix="measured_"))
    work.mkdir(parents=True, exist_ok=True)
    return given, work


def need(path: Path) -> Path:
    """The path, or an end with a plain reason."""
    if not path.exists():
        raise SystemExit(f"skipped: {path} is not here; say where with --data")
    return path


def bampipe(*arguments: object, most_s: float = 3600.0) -> tuple[float, str]:
    """Run a command line; its processor seconds and output. A failed gate, code 1, is a result.

    Raises:
        Failed: it refuses, or takes longer than ``most_s``.
    """
    start = processor_seconds()
    command = [sys.executable, "-m", "bampipe", *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=most_s, cwd=ROOT)
    except subprocess.TimeoutExpired:
        raise Failed(f"not done in {most_s:.0f} s") from None
    if done.returncode > 1:
        raise Failed((done.stderr.strip() or done.stdout.strip()).splitlines()[-1])
    return processor_seconds() - start, done.stdout


def processor_seconds() -> float:
    """Of this process and of those it has waited for: says the same on a busy machine."""
    return sum(os.times()[:4])


def read(run: Path, model: str, stage: str) -> Any:
    """The JSON result of one stage for a model."""
    return json.loads((run / f"models/{model}/{stage}.json").read_text(encoding="utf-8"))


def read_ladder(run: Path) -> list[tuple[str, list[str]]]:
    """Each model of a run from the base on to the last that lowers the error, and what it adds."""
    import bampipe as package

    opened = package.open_run(run)
    last, line = opened.model, []
    while last:
        parent = next((m for m in opened.models if last != m and _is_parent(opened, m, last)), "")
        had = opened.effects(parent) if parent else ()
        line.append((last, [e for e in opened.effects(last) if e not in had]))
        last = parent
    return line[::-1]


def _is_parent(opened: Any, parent: str, child: str) -> bool:
    from bampipe.run import models

    return bool(models.read(opened.root, child).parent == parent)


def load(run: Path, model: str) -> tuple[System, Array]:
    """The compiled model of a run folder and its identified parameters."""
    folder = RunFolder(run)
    system = compile_model(load_model(folder, model))
    return system, read_estimate(folder, model, system)


def read_trial(run: Path, trial: str, system: System) -> Motion:
    """One trial as the model needs it."""
    motions = read_motions(RunFolder(run), system, braked=True)
    return next(motion for motion in motions if motion.trial_id == trial)


def run_free(
    system: System, p: Array, motion: Motion, first: int, last: int, q: Array, qd: Array
) -> Array:
    """Positions and velocities, (last - first + 1, 2 n), by the recorded inputs alone.

    Args:
        system: the model; p: its parameters.
        motion: the trial, whose inputs act; first, last: samples between which it runs.
        q, qd: (n,) where and how fast it starts.

    Raises:
        InputError: the motion runs away.
    """
    every = motion.inputs(system.inputs)
    u, p = np.ascontiguousarray(every[first : last + 1]), p[: len(system.parameters)]
    start = np.concatenate([q, qd, system.initial_memory(q, qd, u[0], p)])
    plant = make_plant(p, len(system.noise), system.sign_widths, max_step=1e-3)
    dt = float(motion.t[1] - motion.t[0])
    x, _ = simulate(system.derivative, plant, start, u, dt, smooth=system.forced)
    return np.asarray(x[:, : 2 * len(q)])


def rms(x: Array) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(x))))


def store(name: str, result: dict[str, Any], out: Path | None = None) -> Path:
    """Write a result with the command, the commit and the versions that made it."""
    head = {
        "command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *_asked()]),
        "commit": _ask_git("rev-parse", "--short", "HEAD"),
        "changed": bool(_ask_git("status", "--porcelain", "--", "bampipe")),
        "versions": {"python": platform.python_version(), **_versions(PACKAGES)},
    }
    path = out or RESULTS / f"{name}.json"
    path.write_text(json.dumps({**head, "result": result}, indent=1) + "\n", encoding="utf-8")
    return path


def _asked() -> list[str]:
    """The arguments given, but for the places of files."""
    kept: list[str] = []
    given = iter(sys.argv[1:])
    for one in given:
        if one in ("--data", "--work", "--out", "--cases"):
            next(given, None)
        else:
            kept.append(one)
    return kept


def _ask_git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def _versions(names: Sequence[str]) -> dict[str, str]:
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "source"
    return found
