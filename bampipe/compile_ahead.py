"""On a cold start, code that later stages need is compiled by processes beside the run.

Where nothing is compiled yet, the first stage that wants compiled code would wait for it, and the
next one again. Instead, the first function that is missing starts processes that import the
modules with most to compile, and so leave their code on disk. No function is compiled twice, for
what one process is at, the others wait for (`bampipe.compiled`). Where everything is compiled,
nothing is started. A process that fails leaves its part to the run, which then says what is wrong.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_PARTS = (
    ("bampipe.estimate.propagation", "bampipe.estimate.square_root"),
    ("bampipe.estimate.triangular", "bampipe.estimate.low_pass", "bampipe.estimate.simulation"),
)
"""Modules whose import compiles, by process; what is waited for longest comes first."""

_END_WITH_PARENT = (
    "import os, sys, threading; "
    "threading.Thread(target=lambda: os._exit(len(os.read(0, 1))), daemon=True).start()"
)
"""Standard input ends when the run does, killed or not."""

_allowed: list[bool] = []
_running: list[subprocess.Popen[bytes]] = []


@contextmanager
def beside(processes: int) -> Iterator[None]:
    """Compile ahead during the block, should a function turn out not to be compiled.

    Args:
        processes: how many cores may be used, 0 for all; with one, nothing is started.
    """
    if (processes or os.cpu_count() or 1) > 1:
        _allowed.append(True)
    try:
        yield
    finally:
        _allowed.clear()
        while _running:
            process = _running.pop()
            process.terminate()
            process.wait()


def missing() -> None:
    """Called where a function of bampipe itself is not found compiled; the first time counts."""
    if not _allowed:
        return
    _allowed.clear()
    for modules in _PARTS:
        # The same places to import from, and nothing from the working folder.
        code = f"{_END_WITH_PARENT}; sys.path[:] = {sys.path!r}; import {', '.join(modules)}"
        _running.append(
            subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        )
