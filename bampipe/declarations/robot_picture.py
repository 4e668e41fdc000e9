"""A robot as it is declared, drawn at position zero: from the side and from above, as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from bampipe.arrays import Array
from bampipe.physics.robot import Joint, Robot, rotation_matrix

_SIDE, _MARGIN, _TOP = 420.0, 60.0, 34.0
_INK, _FAINT, _BODY, _WRONG = "#1c2024", "#b4b8bd", "#56b4e9", "#d55e00"
_ALONG = 0.8
"""Of an axis' length along the view: it is drawn as one that points at the eye."""
_LARGEST_PX, _HALF_AXIS_PX, _LINE_PX = 16.0, 14.0, 13.0
_BARS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class _Placed:
    """A joint in the base's frame: where it is and what is before it, its axis, its body."""

    joint: Joint
    before: Array
    place: Array
    axis: Array
    center: Array


@dataclass(frozen=True)
class _View:
    """One projection.

    Attributes:
        title: of it.
        right, up, towards: the base's axes to the right, upwards and to the eye.
        at: its middle, px; middle: the point there, m; scale: px a metre.
    """

    title: str
    right: int
    up: int
    towards: int
    at: tuple[float, float]
    middle: Array
    scale: float

    def pixel(self, point: Array) -> tuple[float, float]:
        off = (point - self.middle) * self.scale
        return self.at[0] + float(off[self.right]), self.at[1] - float(off[self.up])


def draw_robot(robot: Robot) -> str:
    """The chain at position zero: joints with their axes, and bodies as large as their mass.

    A joint that turns is round, one that slides is square; a body that cannot exist has another
    colour.

    Returns:
        Text of an SVG file.
    """
    placed = _place(robot)
    points = np.array([np.zeros(3), *(p.place for p in placed), *(p.center for p in placed)])
    span = max(float(np.ptp(points, axis=0).max()), 1e-3)
    middle, scale = 0.5 * (points.max(axis=0) + points.min(axis=0)), (_SIDE - 2 * _MARGIN) / span
    axes = (("from the side", 0, 2, 1), ("from above", 0, 1, 2))
    views = [
        _View(*view, (_SIDE * (k + 0.5), _TOP + 0.5 * _SIDE), middle, scale)
        for k, view in enumerate(axes)
    ]
    width, height = _SIDE * len(views), _SIDE + _TOP
    bar = max(b for b in _BARS if b <= max(0.4 * span, _BARS[0]))
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}"'
        f' width="{width:g}" height="{height:g}" font-family="sans-serif" font-size="11">',
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>',
        *(line for view in views for line in _draw(placed, view)),
        f'<path d="M14 {height - 14:g}h{bar * scale:.1f}" stroke="{_INK}" stroke-width="2"/>',
        _text(14.0, height - 20.0, f"{bar:g} m"),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _place(robot: Robot) -> list[_Placed]:
    known: dict[str, tuple[Array, Array]] = {"": (np.eye(3), np.zeros(3))}
    found = []
    for joint in robot.joints:
        turn, before = known[joint.after]
        place = before + turn @ np.array(joint.position)
        turn = turn @ rotation_matrix(joint.rotation)
        known[joint.name] = turn, place
        axis = turn @ np.array(joint.axis) / np.linalg.norm(joint.axis)
        found.append(_Placed(joint, before, place, axis, place + turn @ np.array(joint.center)))
    return found


def _draw(placed: Sequence[_Placed], view: _View) -> list[str]:
    x, y = view.pixel(np.zeros(3))
    lines = [
        _text(view.at[0] - 0.5 * _SIDE + 14.0, 20.0, f"{view.title}, at position zero"),
        f'<path d="M{x - 12:.1f} {y + 5:.1f}h24" stroke="{_INK}" stroke-width="3"/>',
    ]
    heaviest = max((abs(p.joint.mass) for p in placed), default=0.0) or 1.0
    for p in placed:
        (x0, y0), (x, y), (xc, yc) = map(view.pixel, (p.before, p.place, p.center))
        lines.append(
            f'<path d="M{x0:.1f} {y0:.1f}L{x:.1f} {y:.1f}" stroke="{_INK}" stroke-width="2.5"/>'
        )
        if p.joint.mass != 0.0:
            radius = _LARGEST_PX * (abs(p.joint.mass) / heaviest) ** 0.5
            colour = _WRONG if p.joint.impossible else _BODY
            lines += [
                f'<path d="M{x:.1f} {y:.1f}L{xc:.1f} {yc:.1f}" stroke="{_FAINT}"/>',
                f'<circle cx="{xc:.1f}" cy="{yc:.1f}" r="{radius:.1f}" fill="{colour}"'
                f' opacity="0.45"><title>{escape(p.joint.name)}: {p.joint.mass:.4g} kg</title>'
                "</circle>",
            ]
    return lines + [line for p in placed for line in _joint(p, view)] + _names(placed, view)


def _joint(p: _Placed, view: _View) -> list[str]:
    x, y = view.pixel(p.place)
    outline = f'fill="white" stroke="{_INK}" stroke-width="1.5"'
    shape = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" {outline}/>'
    if p.joint.kind == "prismatic":
        shape = f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" {outline}/>'
    if abs(p.axis[view.towards]) > _ALONG:
        return [shape, f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.5" fill="{_INK}"/>']
    dx, dy = (float(v) * _HALF_AXIS_PX for v in (p.axis[view.right], -p.axis[view.up]))
    axis = f'<path d="M{x - dx:.1f} {y - dy:.1f}L{x + dx:.1f} {y + dy:.1f}" stroke="{_INK}"'
    return [f'{axis} stroke-dasharray="4 2"/>', shape]


def _names(placed: Sequence[_Placed], view: _View) -> list[str]:
    """Names beside the joints; of those that lie on one another, one below the other."""
    lines: list[str] = []
    taken: list[tuple[float, float]] = []
    for p in placed:
        x, y = view.pixel(p.place)
        x, y = x + 10.0, y - 6.0
        while any(abs(y - other) < _LINE_PX and abs(x - left) < 90.0 for left, other in taken):
            y += _LINE_PX
        taken.append((x, y))
        lines.append(_text(x, y, p.joint.name))
    return lines


def _text(x: float, y: float, words: str) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{_INK}" stroke="white" stroke-width="3"'
        f' paint-order="stroke">{escape(words)}</text>'
    )
