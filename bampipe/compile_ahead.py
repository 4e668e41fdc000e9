"""On a cold start, code that later stages need is compiled by processes beside the run.

Where nothing is compiled yet, the first stage that wants compiled code would wait for it, and the
next one again. Instead, processes beside the run import the modules with most to compile, and so
leave their code on disk. No function is compiled twice, for what one process is at, the others wait
for (`bampipe.compiled`). They start unless there is a folder of code compiled from these sources. A
process that fails leaves its part to the run, which then says what is wrong.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bampipe.errors import InputError
from bampipe.generated_code import compiled_folder

_PARTS = (
    ("bampipe.estimate.propagation", "bampipe.estimate.square_root"),
    ("bampipe.estimate.triangular", "bampipe.estimate.simulation"),
)
"""Modules whose import compiles, by process; what is waited for longest comes first."""

_END_WITH_PARENT = (
    "import gc, os, sys, threading; gc.disable(); "
    "threading.Thread(target=lambda: os._exit(len(os.read(0, 1))), daemon=True).start()"
)
"""Standard input ends when the run does, killed or not."""


@contextmanager
def compiling_ahead(processes: int) -> Iterator[None]:
    """Compile ahead during the block, where nothing is compiled yet.

    Args:
        processes: how many cores may be used, 0 for all; with one, nothing is started.
    """
    running: list[subprocess.Popen[bytes]] = []
    with suppress(InputError):  # no folder: the run itself says so, with what to do
        compiled = compiled_folder(Path(__file__).with_name("estimate"))
        if (processes or os.cpu_count() or 1) > 1 and not compiled.exists():
            running = [_start(modules) for modules in _PARTS]
    try:
        yield
    finally:
        for process in running:
            process.terminate()
            process.wait()


def _start(modules: tuple[str, ...]) -> subprocess.Popen[bytes]:
    # The same places to import from, and nothing from the working folder.
    code = f"{_END_WITH_PARENT}; sys.path[:] = {sys.path!r}; import {', '.join(modules)}"
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
