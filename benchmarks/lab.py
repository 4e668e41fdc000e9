"""Which session drifted: ten simulated sessions, one with more friction, one with a hidden effect.

    python benchmarks/lab.py

The parameters of the sessions scatter by 1 % (the mass by 0.1 %). In the sixth the Coulomb friction
of the yaw is 20 % higher; in the eighth a Stribeck effect is hidden. Everything is run and
diagnosed, then `bampipe lab` says what it makes of them. About ten minutes on two cores.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

TYPICAL = {
    "viscous.yaw": 4.0, "coulomb.yaw": 2.0, "viscous.pitch": 4.2, "coulomb.pitch": 2.2,
    "viscous.extension": 14.0, "coulomb.extension": 3.7, "mass": 3.56,
}  # fmt: skip
DRIFTED, HIDDEN, SESSIONS = 6, 8, 10


def bampipe(*arguments: str, folder: Path) -> str:
    """Run a command in ``folder``; return what it printed."""
    command = [sys.executable, "-m", "bampipe", *arguments]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)
    return done.stdout


def main() -> None:
    """Simulate, run, print the lab's table."""
    rng = np.random.default_rng(7)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(1, SESSIONS + 1):
            values = {
                key: value * (1.0 + (0.001 if key == "mass" else 0.01) * rng.normal())
                for key, value in TYPICAL.items()
            }
            values["coulomb.yaw"] *= 1.2 if number == DRIFTED else 1.0
            session = f"sessions/s{number:02d}"
            settings = [part for key, v in values.items() for part in ("--set", f"{key}={v:.5f}")]
            hidden = ("--effect", "stribeck:yaw") if number == HIDDEN else ()
            bampipe("simulate", session, "--seed", str(number), *settings, *hidden, "-q",
                    folder=folder)  # fmt: skip
            path = folder / session / "session.toml"
            when = f"recorded_at = 2026-09-{number:02d}T09:30:00Z\n"
            path.write_text(when + path.read_text(encoding="utf-8"), encoding="utf-8")
        bampipe("run", "sessions/*", "--pipeline", "diagnose", folder=folder)
        print(bampipe("lab", "-q", folder=folder))


if __name__ == "__main__":
    main()
