"""Inertial parameters of a robot: possible bodies and base parameters."""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from bampipe.arrays import Array
from bampipe.estimate.possible_bodies import is_possible, nearest_possible
from bampipe.identification.choice import describe_worse
from bampipe.identification.least_squares_estimate import SquaresFit
from bampipe.lists import join_names
from bampipe.physics import System
from bampipe.physics.base_parameters import base_parameters
from bampipe.physics.newton_euler import INERTIAL
from bampipe.results.identify import BaseEstimate

_SHOWN = 0.5
"""The trials determine a base parameter if its sd is below this fraction of the drawing's."""


def make_possible(system: System, squares: SquaresFit) -> tuple[SquaresFit, list[str]]:
    """Replace impossible bodies of the fit by the nearest possible ones, with notes on the change.

    The distance is measured by the normal equations of the fit, including the drawing, and all
    other parameters adapt. If the nearest possible bodies explain the trials far worse, the fit
    stays as it is: the model lacks something, such as a counterbalance.
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
    nominal = np.array([joint.inertial for joint in robot.joints])
    p = _find_nearest(system, squares, places.reshape(-1, INERTIAL), nominal)
    nearest = (
        f"The inertial parameters fitted to {join_names(wrong)} are physically impossible; the"
        " nearest"
    )
    error, of_fit = (squares.held_out_rmse(values) for values in (p, squares.p))
    if worse := describe_worse(system, error, of_fit, "the fit"):
        return squares, [f"{nearest} possible ones were rejected, because they {worse}."]
    return replace(squares, p=p), [f"{nearest} possible ones are published."]


def _find_nearest(system: System, squares: SquaresFit, places: Array, nominal: Array) -> Array:
    """Return the nearest parameters (n_p + 1,) with possible bodies at ``places``.

    ``places`` and the drawing's numbers, ``nominal``, are (b, 10).
    """
    count, unseen = squares.free.size, np.setdiff1d(places, squares.free)
    weight = block_diag(squares.information, np.zeros((unseen.size, unseen.size)))
    at = np.full(len(weight), -1)  # without the nuisance parameters
    at[:count], at[len(at) - unseen.size :] = squares.free, unseen
    value, low, high = np.zeros(len(at)), np.full(len(at), -np.inf), np.full(len(at), np.inf)
    value[at >= 0] = squares.p[at[at >= 0]]
    low[:count], high[:count] = squares.problem.lower, squares.problem.upper
    # The drawing determines the bodies that no motion shows; friction and drives that none shows
    # stay where the fit left them.
    prior_sd = np.full(len(at), np.inf)
    for row, k in enumerate(at):
        if 0 <= k < len(system.parameters) and not (row < count and system.parameters[k].weighed):
            prior_sd[row] = system.parameters[k].sd or np.inf
    bodies = np.array([[int(np.flatnonzero(at == place)[0]) for place in b] for b in places])
    found = nearest_possible(value, weight, prior_sd, bodies, nominal, (low, high))
    p = squares.p.copy()
    p[at[at >= 0]] = found[at >= 0]
    return p


def base_estimates(system: System, p: Array, covariance: Array) -> tuple[BaseEstimate, ...] | None:
    """Return the base parameters, from the drawing and from the trials.

    ``p`` (>= n_p,) are parameters of the model; ``covariance`` is that of the estimated ones.
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
    """Say how many base parameters the trials determine, and for which joints none."""
    robot = system.model.device.robot
    if robot is None or found is None:
        return []
    shown = [entry for entry in found if entry.shown]
    seen = {name.rpartition(".")[2] for entry in shown for name in entry.members}
    silent = [joint.name for joint in robot.joints if joint.name not in seen]
    lines = [
        f"These trials determine {len(shown)} of the {len(found)} base parameters; the others keep"
        " the values of the drawing."
    ]
    if silent:
        lines.append(f"The trials determine no body of {join_names(silent)}.")
    return lines
