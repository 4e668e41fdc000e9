"""The inertial numbers of a robot: possible ones, and the combinations that the trials show."""

from dataclasses import replace

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.estimate.bounded import invert_scaled
from bampipe.estimate.possible_bodies import is_possible, nearest_possible
from bampipe.identification.least_squares_estimate import SquaresFit
from bampipe.lists import join_names
from bampipe.physics import System
from bampipe.physics.base_parameters import base_parameters
from bampipe.physics.newton_euler import INERTIAL
from bampipe.physics.robot import Robot
from bampipe.results.identify import BaseEstimate

_SHOWN = 0.5
"""Share of the drawing's uncertainty below which the trials are said to show a combination."""


def make_possible(system: System, squares: SquaresFit) -> tuple[SquaresFit, list[str]]:
    """The fit with inertial numbers that some body can have, the nearest; and what to tell of it.

    Nearest is what explains the trials and the drawing least badly: the normal equations of the
    fit weigh, and what is no inertial number follows.
    """
    robot = system.model.device.robot
    if robot is None:
        return squares, []
    places = np.array([system.index(p.name) for p in robot.parameters])
    value = squares.p[places].reshape(-1, INERTIAL)
    names = [joint.name for joint in robot.joints]
    wrong = [name for name, body in zip(names, value, strict=True) if not is_possible(body)]
    if not wrong:
        return squares, []
    weight, others, slope = _weight(squares, robot, places)
    drawn = np.array([joint.inertial for joint in robot.joints])
    found = nearest_possible(value, weight, drawn)
    p, problem = squares.p.copy(), squares.problem
    p[places] = found.ravel()
    p[others] += slope @ (found - value).ravel()
    inside = np.isin(squares.free, others)
    moved = squares.free[inside]
    p[moved] = np.clip(p[moved], problem.lower[inside], problem.upper[inside])
    note = (
        f"No body has the inertial numbers that fit {join_names(wrong)} best: the nearest possible"
        " ones are given."
    )
    return replace(squares, p=p), [note]


def _weight(squares: SquaresFit, robot: Robot, places: Indices) -> tuple[Array, Indices, Array]:
    """Weight of a change of the inertial numbers, all others refitted, and how these follow.

    Returns:
        (10 b, 10 b); the places of the other free parameters, and their change (n, 10 b) for one
        of each inertial number.
    """
    normal, count = squares.information, squares.free.size
    column = {int(place): k for k, place in enumerate(squares.free)}
    size = np.array([p.sd for p in robot.parameters])
    weight = np.diag(1.0 / size**2)
    own = [k for k, place in enumerate(places) if int(place) in column]
    inner = [column[int(places[k])] for k in own]
    free = [k for k in range(count) if k not in inner and not squares.at_bound[k]]
    others = [*free, *range(count, len(normal))]
    cross = normal[np.ix_(others, inner)]
    follow = -invert_scaled(normal[np.ix_(others, others)]) @ cross
    block = normal[np.ix_(inner, inner)] + cross.T @ follow
    slope = np.zeros((len(free), len(places)))
    slope[:, own] = follow[: len(free)]
    weight[np.ix_(own, own)] = 0.5 * (block + block.T)
    return weight, squares.free[free], slope


def base_estimates(system: System, p: Array, covariance: Array) -> tuple[BaseEstimate, ...] | None:
    """The combinations that motion can show, with what the trials add to the drawing.

    ``p`` (>= n_p,) are parameters of the model; ``covariance`` is that of those estimated.
    """
    robot = system.model.device.robot
    if robot is None:
        return None
    free = [i for i, item in enumerate(system.parameters) if not item.fixed]
    column = {system.parameters[i].name: k for k, i in enumerate(free)}
    found = []
    for base in base_parameters(robot):
        members = [system.parameters[system.index(name)] for name in base.terms]
        factors = np.array(list(base.terms.values()))
        rows = [column[item.name] for item in members]
        sd = float(np.sqrt(factors @ covariance[np.ix_(rows, rows)] @ factors))
        drawn_sd = float(np.linalg.norm(factors * [item.sd for item in members]))
        found.append(
            BaseEstimate(
                combination=base.words,
                members=tuple(base.terms),
                estimate=float(factors @ [p[system.index(item.name)] for item in members]),
                sd=sd,
                drawn=float(factors @ [item.prior for item in members]),
                drawn_sd=drawn_sd,
                unit=members[0].unit,
                shown=sd < _SHOWN * drawn_sd,
            )
        )
    return tuple(found)


def summarise_bases(system: System, found: tuple[BaseEstimate, ...] | None) -> list[str]:
    """Say how many combinations the trials show, and of which joints none."""
    robot = system.model.device.robot
    if robot is None or found is None:
        return []
    shown = [entry for entry in found if entry.shown]
    seen = {name.rpartition(".")[2] for entry in shown for name in entry.members}
    silent = [joint.name for joint in robot.joints if joint.name not in seen]
    lines = [
        f"Of the {len(found)} combinations of inertial numbers that motion can show, these trials"
        f" show {len(shown)}; of the others the drawing stands."
    ]
    if silent:
        lines.append(f"Of the bodies of {join_names(silent)} the trials say next to nothing.")
    return lines
