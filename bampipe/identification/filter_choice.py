"""What can be chosen about the unscented filter, for every stage that runs one."""

from __future__ import annotations

from dataclasses import dataclass

from bampipe.errors import InputError

ENGINES = ("compiled", "filterpy")
MEASURES = ("position", "position_velocity")


@dataclass(frozen=True)
class FilterChoice:
    """Settings of the filter.

    Attributes:
        engine: ``compiled``, or ``filterpy``: slow, gives the same numbers.
        measure: ``position``, or ``position_velocity`` as in the paper; filtered velocities are
            not white, so intervals from them are too narrow.
        random_walk: of the parameters, in prior standard deviations per square root of a
            second; 0 takes them as constant, and only then are the intervals calibrated.
        reading_noise: standard deviation of a position reading in encoder steps; 0 takes it
            from the data.
        force_noise: of a force sample, N, model error included; 0 takes it from the data.
        longest_step_s: longest Runge-Kutta step, s.
        block_s: length of the blocks that are taken as independent of each other, s.
        trace_rows: most rows a trial in tables of states and of parameters along the data.
    """

    engine: str = "compiled"
    measure: str = "position"
    random_walk: float = 0.0
    reading_noise: float = 0.0
    force_noise: float = 0.0
    longest_step_s: float = 1e-3
    block_s: float = 2.0
    trace_rows: int = 2000


def check_choice(choice: FilterChoice, stage: str) -> None:
    """Raise :class:`InputError` where a setting of the filter makes no sense."""
    for name, known in (("engine", ENGINES), ("measure", MEASURES)):
        check_among(getattr(choice, name), known, f"{stage}.{name}")
    for name in ("longest_step_s", "block_s", "trace_rows"):
        if not getattr(choice, name) > 0:
            raise InputError("must be positive", where=f"{stage}.{name}")
    for name in ("random_walk", "reading_noise", "force_noise"):
        if getattr(choice, name) < 0:
            raise InputError("must not be negative", where=f"{stage}.{name}")


def check_among(value: str, known: tuple[str, ...], where: str) -> None:
    """Raise :class:`InputError` unless ``value`` is one of ``known``."""
    if value not in known:
        name = where.rpartition(".")[2]
        remedy = f"choose from {', '.join(known)}"
        raise InputError(f"no {name} {value!r}", where=where, remedy=remedy)
