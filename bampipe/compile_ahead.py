"""Compilation ahead: on a cold start, processes beside the run compile code for later stages.

Otherwise the first stage that needs compiled code would wait for it, and the next one again.
Instead, processes beside the run compile the longest functions and leave their code on disk. No
function is compiled twice, because processes wait for each other (`bampipe.compiled`). A process
that fails leaves its part to the run, which then reports the fault.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bampipe.errors import InputError
from bampipe.generated_code import compiled_folder

_PARTS: tuple[tuple[str, ...], ...] = (
    ("simulation._count_steps", "simulation._run"),
    ("square_root.filter_square_root",),
)
"""Functions of `bampipe.estimate` by process, in the order in which stages need them."""

_END_WITH_PARENT = (
    "import gc, os, sys, threading; gc.disable(); "
    "threading.Thread(target=lambda: os._exit(len(os.read(0, 1))), daemon=True).start()"
)
"""Standard input ends when the run does, killed or not."""


@contextmanager
def compiling_ahead(processes: int) -> Iterator[bool]:
    """Compile ahead during the block if nothing is compiled yet.

    Args:
        processes: how many cores may be used, 0 for all; with one, nothing is started.

    Yields:
        Whether code is compiled for the first time.
    """
    running: list[subprocess.Popen[bytes]] = []
    cold = False
    with suppress(InputError):  # no folder: the run itself reports it with a remedy
        folder = compiled_folder(Path(__file__).with_name("estimate"))
        cold = not folder.exists()
        waiting = [part for part in _PARTS if not any(folder.glob(f"{part[-1]}-*.nbi"))]
        spare = (processes or os.cpu_count() or 1) - 1
        if 0 < spare < len(waiting):
            waiting = [tuple(name for part in waiting for name in part)]
        running = [_start(part) for part in waiting if spare > 0]
    try:
        yield cold or bool(running)
    finally:
        for process in running:
            process.terminate()
            process.wait()


def _start(functions: tuple[str, ...]) -> subprocess.Popen[bytes]:
    # The same places to import from, and nothing from the working folder.
    code = f"{_END_WITH_PARENT}; sys.path[:] = {sys.path!r}"
    for name in functions:
        module = f"bampipe.estimate.{name.partition('.')[0]}"
        code += f"; import {module}; bampipe.estimate.{name}.compile_promised()"
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
