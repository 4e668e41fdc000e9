"""bampipe: from raw trial logs of a manipulator to a mechanical model.

For notebooks and programs, see docs/api.md::

    import bampipe

    run = bampipe.run_session("sessions/2026-10-03_s01")
    run.parameters()

What is exported here is loaded when it is first used: ``import bampipe`` itself imports nothing
beyond the standard library.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from bampipe.errors import InputError

if TYPE_CHECKING:
    from bampipe.api.actions import (
        compare,
        diagnose,
        draft,
        extend,
        filter,
        follow,
        identify,
        ingest,
        run_session,
        run_stage,
        stiffness,
        validate,
        write_report,
    )
    from bampipe.api.opened import Picture, Run, open_run
    from bampipe.api.session_pair import compare_runs

__version__ = "0.1.0"

__all__ = [
    "InputError",
    "Picture",
    "Run",
    "compare",
    "compare_runs",
    "diagnose",
    "draft",
    "extend",
    "filter",
    "follow",
    "identify",
    "ingest",
    "open_run",
    "run_session",
    "run_stage",
    "stiffness",
    "validate",
    "write_report",
]

_MODULES = {
    **dict.fromkeys(("Picture", "Run", "open_run"), "bampipe.api.opened"),
    "compare_runs": "bampipe.api.session_pair",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'bampipe' has no attribute {name!r}")
    return getattr(import_module(_MODULES.get(name, "bampipe.api.actions")), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
