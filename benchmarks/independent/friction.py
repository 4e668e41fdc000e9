"""Friction and other forces along one axis, as the simulators integrate them.

Dry friction is a set-valued law solved implicitly at every step: an axis whose push is below its
dry friction stands still. Equations such as those of bampipe let it creep instead; ``creep`` does.

numba keeps compiled callers by their own files: after a change of a kernel here, remove
``__pycache__``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit

AXIS = np.dtype(
    [
        (name, np.float64)
        for name in (
            "viscous", "coulomb",                   # resist motion always
            "creep",                                # dry friction as tanh(v/creep) where not zero
            "stribeck", "stribeck_speed",           # extra dry friction that dies out with speed
            "dahl", "dahl_distance",                # dry friction that builds up over a distance
            "dry_difference", "viscous_difference", # half the difference between the directions
            "drag",                                 # grows with the square of the speed
            "ripple", "ripple_phase", "wavenumber", # dry friction along the travel
            "load_share", "side_share",             # dry friction by load along and across
            "softening", "warming_time",            # viscous friction lost as the axis warms
            "spring", "spring_rest",
            "cogging", "cogging_phase", "cogging_wavenumber",
            "detent", "detent_at", "detent_width",  # a magnet that catches near one position
            "rough", "rough_at", "rough_width",     # dry friction around one position
            "stop", "stop_at",                      # a soft stop beyond one position
            "thinning", "thinning_speed",           # viscous friction that levels off (Carreau)
            "slip", "slip_distance",                # dry friction of contacts that hold, then slip
            "cable", "cable_time",                  # a cable that winds and creeps
            "reach_share", "reach_rest",            # dry friction by another axis' position
            "slack_spring", "slack", "slack_at",    # a spring that is slack around one position
            "band", "band_at", "band_width",        # dry friction around one speed
            "tightening", "tightening_from",        # dry friction along the travel
        )
    ]
)  # fmt: skip
"""Laws of one axis; zero switches each off, and lengths and times are never zero."""

_NEVER_ZERO = (
    "stribeck_speed", "dahl_distance", "wavenumber", "warming_time", "cogging_wavenumber",
    "detent_width", "cable_time", "rough_width", "thinning_speed", "slip_distance",
    "band_width",
)  # fmt: skip

_SHAPES = {
    "stribeck_speed", "dahl_distance", "wavenumber", "ripple_phase", "warming_time", "spring_rest",
    "cogging_wavenumber", "cogging_phase", "detent_at", "detent_width", "stop_at",
    "cable_time", "rough_at", "rough_width", "thinning_speed", "slip_distance",
    "slack", "slack_at", "band_at", "band_width", "tightening_from",
}  # fmt: skip
_SAME = {
    "stribeck": {"stribeck": "force", "stribeck_speed": "speed"},
    "presliding": {"dahl": "force", "dahl_distance": "distance"},
    "asymmetric_coulomb": {"dry_difference": "difference",
                           "viscous_difference": "viscous_difference"},
    "quadratic_drag": {"drag": "coefficient"},
    "upper_stop": {"stop": "stiffness", "stop_at": "position"},
    "load_dependent_friction": {"load_share": "coefficient", "side_share": "side_coefficient"},
}  # fmt: skip
"""Laws here, by the names of the parameters in bampipe that mean the same."""

CONTACTS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
"""Of the contacts that share ``slip`` alike: distance at which each slips over the stated one."""

MEMORY = np.dtype(
    [("dahl", np.float64), ("heat", np.float64), ("cable", np.float64), ("slip", np.float64, 5)]
)
"""What an axis remembers: built-up friction (share), friction power (W), cable rest (position),
force of each contact (share)."""


def blank_laws(axes: int) -> np.ndarray:
    """Laws of ``axes`` axes with everything switched off, dtype AXIS, (axes,)."""
    laws = np.zeros(axes, AXIS)
    for name in _NEVER_ZERO:
        laws[name] = 1.0
    laws["stop_at"] = np.inf
    return laws


def set_law(
    law: np.ndarray,
    effect: str,
    typical: Mapping[str, float],
    size: float,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Switch on the laws of ``effect``, such as ``stribeck:yaw``, at ``size`` times ``typical``.

    Shapes are drawn within 15 %. Returns what an identification of the right model must find, by
    full name; nothing where bampipe writes the effect in other mathematics.
    """
    name, _, axis = effect.partition(":")
    sign = rng.choice([-1.0, 1.0]) if name == "asymmetric_coulomb" else 1.0
    for key, value in typical.items():
        law[key] = value * (rng.uniform(0.85, 1.15) if key in _SHAPES else sign * size)
    for part in {"presliding": ("dahl",), "maxwell_slip": ("slip",)}.get(name, ()):
        law[part] = min(law[part], 0.95 * law["coulomb"])
    of_wave = {
        "position_dependent_friction": ("ripple", "ripple_phase", "wavenumber"),
        "torque_ripple": ("cogging", "cogging_phase", "cogging_wavenumber"),
    }
    if name in of_wave:
        height, phase, wavenumber = (law[key] for key in of_wave[name])
        found = {"sine": height * np.cos(phase), "cosine": height * np.sin(phase)}
        found["wavenumber"] = wavenumber
    elif name == "return_spring":
        found = {"stiffness": law["spring"], "offset": law["spring"] * law["spring_rest"]}
    else:
        same = _SAME.get(name, {})
        found = {theirs: law[own] for own, theirs in same.items() if law[own] != 0.0}
    return {f"{name}.{axis}.{key}": float(value) for key, value in found.items()}


@njit(cache=True)
def push_along(law, q, memory):
    """Forces of position alone: springs, stops, magnets, cables."""
    force = -law.spring * (q - law.spring_rest)
    force += law.cogging * np.sin(law.cogging_wavenumber * q + law.cogging_phase)
    x = (q - law.detent_at) / law.detent_width
    force -= law.detent * x * np.exp(0.5 - 0.5 * x * x)
    if q > law.stop_at:
        force -= law.stop * (q - law.stop_at)
    past = q - law.slack_at
    if abs(past) > law.slack:
        force -= law.slack_spring * (past - np.sign(past) * law.slack)
    return force - law.cable * (q - memory.cable)


@njit(cache=True)
def dry_level(law, q, v, load, side, elsewhere):
    """Dry friction that opposes motion in the direction of ``v``, without what builds up."""
    level = law.coulomb + law.stribeck * np.exp(-((v / law.stribeck_speed) ** 2))
    level -= law.dahl + law.slip
    level += law.dry_difference * np.sign(v)
    level += law.ripple * np.sin(law.wavenumber * q + law.ripple_phase)
    level += law.load_share * abs(load) + law.side_share * side
    level += law.reach_share * (elsewhere - law.reach_rest)
    level += law.rough * np.exp(-(((q - law.rough_at) / law.rough_width) ** 2))
    level += law.band * np.exp(-(((abs(v) - law.band_at) / law.band_width) ** 2))
    level += law.tightening * (q - law.tightening_from)
    return max(level, 0.0)


@njit(cache=True)
def drag_slope(law, v, memory):
    """Viscous friction as force over velocity."""
    warm = max(1.0 - law.softening * memory.heat, 0.1)
    thin = law.thinning / (1.0 + (v / law.thinning_speed) ** 2) ** 0.35
    return law.viscous * warm + law.viscous_difference * np.sign(v) + law.drag * abs(v) + thin


@njit(cache=True)
def resist(law, memory, v_free, v, h, inertia, q, load, side, elsewhere):
    """Impulse of friction over a step of ``h`` on an axis that would reach ``v_free`` without it.

    Implicit in the velocity: friction stops an axis, and never turns it round.
    """
    impulse = -(law.dahl * memory.dahl + law.slip * np.mean(memory.slip)) * h
    v_free += impulse / inertia
    dry = dry_level(law, q, v_free, load, side, elsewhere) * h / inertia
    # Where the sign changes within the step, the slope of the new direction counts.
    slope = drag_slope(law, v if v * v_free > 0.0 else v_free, memory) * h / inertia
    if law.creep > 0.0:
        v_new = _creep(v_free, dry, slope, law.creep)
    elif abs(v_free) <= dry:
        v_new = 0.0
    else:
        v_new = (v_free - np.sign(v_free) * dry) / (1.0 + slope)
    return impulse + (v_new - v_free) * inertia


@njit(cache=True)
def _creep(v_free, dry, slope, width):
    """Solve v + slope*v + dry*tanh(v/width) = v_free by bisection: the left side only grows."""
    low, high = min(v_free, 0.0), max(v_free, 0.0)
    for _ in range(60):
        v = 0.5 * (low + high)
        if v + slope * v + dry * np.tanh(v / width) < v_free:
            low = v
        else:
            high = v
        if high - low < 1e-9:
            break
    return 0.5 * (low + high)


@njit(cache=True)
def remember(law, memory, q, v, h):
    """Advance what the axis remembers over ``h`` at velocity ``v``: exact for constant velocity."""
    aim = np.sign(v)
    memory.dahl = aim + (memory.dahl - aim) * np.exp(-abs(v) * h / law.dahl_distance)
    power = law.viscous * v * v + law.coulomb * abs(v)
    for i in range(5):
        moved = memory.slip[i] + v * h / (law.slip_distance * CONTACTS[i])
        memory.slip[i] = min(max(moved, -1.0), 1.0)
    memory.heat += (power - memory.heat) * h / law.warming_time
    memory.cable += (q - memory.cable) * h / law.cable_time
