"""Coverage-guided fuzzing of everything that reads what a user or a logger wrote (atheris).

Inputs are mutated towards code not reached before. Nothing but `InputError` may come out, each
input must be dealt with in a few seconds, and an expression that is accepted must consist of
known functions and names only. What is found goes into the tests as a case; inputs that failed
are left in the working folder as crash-*, slow-unit-* or timeout-*.

Usage: pip install atheris; python benchmarks/fuzz.py TARGET --seconds 120
       TARGET: toml, session, csv, parquet, mat, json, effect, device, expression
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["bampipe.data", "bampipe.physics", "tomllib"]):
    from bampipe.data.readers import read_trial
    from bampipe.data.session.file import session_from
    from bampipe.physics import expression, registry
    from bampipe.physics.effect import Effect
    from bampipe.physics.units import check_device, check_effect

import numpy as np
import pandas as pd
import scipy.io
import sympy as sp

from bampipe.errors import InputError
from bampipe.files import read_toml

ROOT = Path(__file__).parent.parent
COLUMNS = ("time_us", "enc", "force_v")
NAMES = ("yaw", "pitch", "force", "speed")
SYMBOLS = {name: sp.Symbol(name, real=True) for name in NAMES}
SPECIAL = {"sgn": sp.sign, "ddt": lambda value: sp.diff(value, SYMBOLS["yaw"])}
LONGEST_INPUT = 4096
LONGEST_SECONDS = 10

Check = Callable[[bytes], object]


def from_file(folder: Path, ending: str) -> Check:
    """Read a trial file of this ending."""
    path = folder / f"trial{ending}"

    def check(data: bytes) -> None:
        path.write_bytes(data)
        trial = read_trial(path, COLUMNS, name="trial")
        lengths = {len(values) for values in trial.columns.values()}
        assert len(lengths) == 1 and set(trial.columns) == set(COLUMNS)

    return check


def from_toml(folder: Path, use: Callable[[dict[str, object]], object]) -> Check:
    """Read a TOML file, and what it says."""
    path = folder / "file.toml"

    def check(data: bytes) -> None:
        path.write_bytes(data)
        use(read_toml(path))

    return check


def check_expression(data: bytes) -> None:
    """Parse and rebuild an expression."""
    tree = expression.parse(data.decode("utf-8", "replace"), "here")
    value = expression.build(tree, SYMBOLS, "here", SPECIAL)
    assert value.free_symbols <= set(SYMBOLS.values()), value


def use_effect(effect: Effect) -> None:
    """Check an effect in the first place where the BAM can have it."""
    device = registry.device("bam")
    for place in effect.targets(device)[:1]:
        check_effect(effect, device, place)


def sample_table() -> pd.DataFrame:
    """A small sound trial."""
    t = np.arange(12)
    return pd.DataFrame({"time_us": 2000 * t, "enc": t - 5, "force_v": 0.125 * t})


def binary(write: Callable[[io.BytesIO], object]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def target(name: str, folder: Path) -> tuple[Check, list[bytes]]:
    """Return what to do with an input, and sound inputs to start from."""
    table = sample_table()
    devices = [p.read_bytes() for p in (ROOT / "bampipe/physics/devices").glob("*.toml")]
    effects = [p.read_bytes() for p in (ROOT / "bampipe/physics/effects").glob("*.toml")]
    sessions = [p.read_bytes() for p in ROOT.glob("sample_runs/*/session.toml")]
    csv = table.to_csv(index=False)
    spoken = [csv, csv.replace(",", ";").replace(".", ","), csv.replace(",", "\t")]
    expressions = [b"-force * exp(-(yaw / speed)**2) * sgn(yaw)", b"clip(yaw, 0, 1) + ddt(yaw)"]
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    targets: dict[str, tuple[Check, list[bytes]]] = {
        "toml": (from_toml(folder, lambda table: table), sessions + effects),
        "session": (from_toml(folder, lambda t: session_from(t, folder, "here")), sessions),
        "device": (
            from_toml(folder, lambda t: check_device(registry.device_from(t, "here"))),
            devices,
        ),
        "effect": (
            from_toml(
                folder,
                lambda t: use_effect(registry.effect_from(t, "here")),
            ),
            effects,
        ),
        "expression": (check_expression, expressions),
        "csv": (from_file(folder, ".csv"), [s.encode() for s in spoken]),
        "json": (
            from_file(folder, ".json"),
            [table.to_json(orient=o).encode() for o in ("records", "split", "columns")],
        ),
        "parquet": (from_file(folder, ".parquet"), [binary(table.to_parquet)]),
        "mat": (from_file(folder, ".mat"), [binary(lambda s: scipy.io.savemat(s, columns))]),
    }
    if name not in targets:
        sys.exit(f"no target {name!r}; choose from {', '.join(targets)}")
    return targets[name]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("target")
    parser.add_argument("--seconds", type=int, default=120)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix=f"bampipe-fuzz-{options.target}-"))
    check, seeds = target(options.target, folder)
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(seeds):
        (corpus / f"seed{number}").write_bytes(seed)

    def one(data: bytes) -> None:
        try:
            check(data)
        except InputError as error:
            line = str(error)
            assert line and "\n" not in line and len(line) < 2000, line

    os.chdir(folder)
    print(f"working in {folder}", flush=True)
    arguments = [sys.argv[0], str(corpus), f"-max_total_time={options.seconds}"]
    arguments += [f"-max_len={LONGEST_INPUT}", f"-timeout={LONGEST_SECONDS}", "-rss_limit_mb=4096"]
    atheris.Setup(arguments, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
