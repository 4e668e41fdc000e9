"""What can be chosen about the unscented filter, for every stage that runs one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.schema import STRICT, NotNegative, Positive


@checked_dataclass(frozen=True, config=STRICT)
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
        force_noise: of a force sample, N, model error included; 0 takes it from the data, or
            from the identification where the model has been identified.
        longest_step_s: longest Runge-Kutta step, s.
        block_s: length of the blocks that are taken as independent of each other, s; shorter
            in short sessions, for three a parameter at least.
        trace_rows: most rows a trial in tables of states and of parameters along the data.
    """

    engine: Literal["compiled", "filterpy"] = "compiled"
    measure: Literal["position", "position_velocity"] = "position"
    random_walk: NotNegative = 0.0
    reading_noise: NotNegative = 0.0
    force_noise: NotNegative = 0.0
    longest_step_s: Positive = 1e-3
    block_s: Positive = 2.0
    trace_rows: Annotated[int, Field(gt=0)] = 2000
