"""Drawing of a declared robot at position zero, from the side and from above, as SVG."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from bampipe.arrays import Array
from bampipe.physics.robot import Joint, Robot, rotation_matrix

_INK, _FAINT, _BODY, _WRONG = "#1c2024", "#b4b8bd", "#56b4e9", "#d55e00"
_VIEWS = {"from the side": (0, 2, 1), "from above": (0, 1, 2)}
"""By title: the axes of the base to the right, upwards and towards the viewer."""
_ALONG = 0.8
"""Component of an axis along the view above which it is drawn as pointing to the viewer."""
_AXIS = 0.04
"""Length of a drawn axis on either side of its joint, relative to the robot's length."""
_HEAVIEST = 800.0
"""Area of the heaviest body, square points."""
_NEAR, _LINE = 0.03, 11.0
"""Distance, relative to the robot's length, of joints whose names are stacked, and the line height,
points."""
_SETTINGS: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "bampipe", "font.size": 9.0}


@dataclass(frozen=True)
class _Placed:
    """A joint in the base's frame: its predecessor's place, its own, its axis and body centre."""

    joint: Joint
    before: Array
    place: Array
    axis: Array
    center: Array


def draw_robot(robot: Robot) -> str:
    """Draw the chain at position zero, with joint axes, and bodies in proportion to their mass.

    Rotary joints are round, sliding ones square; impossible bodies have another colour.

    Returns:
        Text of an SVG file.
    """
    placed = _place(robot)
    points = np.array([np.zeros(3), *(p.place for p in placed), *(p.center for p in placed)])
    low, high = points.min(axis=0), points.max(axis=0)
    span, middle, text = max(float((high - low).max()), 1e-3), 0.5 * (low + high), io.StringIO()
    with mpl.rc_context({**mpl.rcParamsDefault, **_SETTINGS, "backend": "svg"}):
        figure = Figure(figsize=(11.0, 5.5), layout="constrained")
        for axes, (title, view) in zip(figure.subplots(1, 2), _VIEWS.items(), strict=True):
            _draw(axes, placed, view, span)
            axes.set(title=f"{title}, at position zero", xlabel="m", aspect="equal")
            axes.set_xlim(middle[view[0]] + span * np.array([-0.65, 0.65]))
            axes.set_ylim(middle[view[1]] + span * np.array([-0.65, 0.65]))
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def _place(robot: Robot) -> list[_Placed]:
    known: dict[str, tuple[Array, Array]] = {"": (np.eye(3), np.zeros(3))}
    found = []
    for joint in robot.joints:
        turn, before = known[joint.after]
        place = before + turn @ joint.position
        turn = turn @ rotation_matrix(joint.rotation)
        known[joint.name] = turn, place
        axis = turn @ joint.axis / np.linalg.norm(joint.axis)
        found.append(_Placed(joint, before, place, axis, place + turn @ joint.center))
    return found


def _draw(axes: Any, placed: Sequence[_Placed], view: tuple[int, int, int], span: float) -> None:
    right, up, towards = view
    seen = [right, up]
    heaviest = max((abs(p.joint.mass) for p in placed), default=0.0) or 1.0
    axes.plot(0.0, 0.0, marker="_", markersize=24, markeredgewidth=3, color=_INK)
    for p in placed:
        axes.plot(*np.array([p.before, p.place])[:, seen].T, color=_INK, linewidth=2.5)
        if p.joint.mass != 0.0:
            axes.plot(*np.array([p.place, p.center])[:, seen].T, color=_FAINT, linewidth=1)
            colour = _WRONG if p.joint.impossible else _BODY
            size = _HEAVIEST * abs(p.joint.mass) / heaviest
            axes.scatter(*p.center[seen], size, colour, alpha=0.45, linewidths=0, zorder=3)
    named: list[Array] = []
    for p in placed:
        at, shape = p.place[seen], "s" if p.joint.kind == "prismatic" else "o"
        axes.plot(*at, shape, markersize=9, color="white", markeredgecolor=_INK, zorder=4)
        if abs(p.axis[towards]) > _ALONG:
            axes.plot(*at, ".", markersize=4, color=_INK, zorder=5)
        else:
            ends = at + _AXIS * span * np.outer([-1.0, 1.0], p.axis[seen])
            axes.plot(*ends.T, "--", color=_INK, linewidth=1, zorder=3)
        below = sum(np.linalg.norm(at - other) < _NEAR * span for other in named)
        named.append(at)
        label = f"{p.joint.name}, {p.joint.mass:.3g} kg" if p.joint.mass else p.joint.name
        axes.annotate(
            label, at, (9.0, 5.0 - _LINE * below), textcoords="offset points", zorder=6,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )  # fmt: skip
