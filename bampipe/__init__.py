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
    from bampipe.api.actions import compare as compare
    from bampipe.api.actions import diagnose as diagnose
    from bampipe.api.actions import draft as draft
    from bampipe.api.actions import extend as extend
    from bampipe.api.actions import filter as filter
    from bampipe.api.actions import follow as follow
    from bampipe.api.actions import identify as identify
    from bampipe.api.actions import ingest as ingest
    from bampipe.api.actions import run_session as run_session
    from bampipe.api.actions import run_stage as run_stage
    from bampipe.api.actions import stiffness as stiffness
    from bampipe.api.actions import validate as validate
    from bampipe.api.actions import write_report as write_report
    from bampipe.api.opened import Picture as Picture
    from bampipe.api.opened import Run as Run
    from bampipe.api.opened import open_run as open_run
    from bampipe.api.session_pair import compare_runs as compare_runs

__version__ = "0.1.0"

_EXPORTED = {
    "actions": "compare diagnose draft extend filter follow identify ingest run_session run_stage"
    " stiffness validate write_report",
    "opened": "Picture Run open_run",
    "session_pair": "compare_runs",
}
_MODULES = {name: module for module, names in _EXPORTED.items() for name in names.split()}
__all__ = ["InputError", *sorted(_MODULES)]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'bampipe' has no attribute {name!r}")
    return getattr(import_module(f"bampipe.api.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
