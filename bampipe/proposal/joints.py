"""Which columns of a log are the positions and the drives of a robot's joints.

Columns that belong together have names alike but for the joint: its name, or a number. Only groups
with a column for every joint count, so no joint gets what is left over from another.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.physics.device import Device

Tokens = tuple[str, ...]

_GENERAL = frozenset(["joint", "link", "axis", "motor", "drive"])
"""Words in the name of a joint that a log may leave out."""
_JOINT = "*"


@dataclass(frozen=True)
class Group:
    """Columns alike, one a joint.

    Attributes:
        columns: in the order of the joints.
        named: whether joints were identified by name; else by order.
    """

    columns: tuple[SurveyedColumn, ...]
    named: bool

    def __str__(self) -> str:
        return f"{self.columns[0].name} to {self.columns[-1].name}"


@dataclass(frozen=True)
class Pairing:
    """The columns of a robot.

    Attributes:
        positions, drives: groups that fit, the likeliest first; of drives one a motor.
    """

    positions: tuple[Group, ...]
    drives: tuple[Group, ...]


def pair_joints(device: Device, found: Survey) -> Pairing:
    """Find the groups of columns that stand for a robot's joints and its drives."""
    joints = [c.name for c in device.coordinates]
    motors = [re.sub(r"^(torque|current)_", "", name) for name in device.forces]
    roles = ("current", "force") if device.force_unit == "A" else ("force", "current")
    drives = [group for role in roles for group in _groups(motors, found.of(role))]
    return Pairing(tuple(_groups(joints, found.of("position"))), tuple(drives))


def _groups(names: Sequence[str], columns: Sequence[SurveyedColumn]) -> list[Group]:
    """Groups with a column for each of ``names``, by their names first; a column is in one."""
    split = {column.name: _tokens(column.name) for column in columns}
    wanted = {name: _tokens(name) for name in names}
    bare = {name: tuple(t for t in said if t not in _GENERAL) for name, said in wanted.items()}
    found: list[Group] = []
    for said in (wanted, bare):
        if all(said.values()) and len(set(said.values())) == len(names):
            found += _by_name(said, columns, split)
    found += _by_number(len(names), columns, split)
    taken: set[str] = set()
    chosen = []
    for group in found:
        if all(column.is_constant for column in group.columns):
            continue
        if taken.isdisjoint(column.name for column in group.columns):
            taken |= {column.name for column in group.columns}
            chosen.append(group)
    return chosen


def _by_name(
    said: dict[str, Tokens], columns: Sequence[SurveyedColumn], split: dict[str, Tokens]
) -> Iterator[Group]:
    groups: dict[Tokens, dict[str, SurveyedColumn]] = {}
    # Of names that contain one another, such as wrist and wrist_roll, the longest that is there.
    for column in columns:
        for name in sorted(said, key=lambda name: -len(said[name])):
            rest = _without(split[column.name], said[name])
            if rest is not None:
                groups.setdefault(rest, {}).setdefault(name, column)
                break
    for group in groups.values():
        if len(group) == len(said):
            yield Group(tuple(group[name] for name in said), named=True)


def _by_number(
    count: int, columns: Sequence[SurveyedColumn], split: dict[str, Tokens]
) -> Iterator[Group]:
    """Groups whose names differ by one number only, in its order."""
    groups: dict[Tokens, dict[int, SurveyedColumn]] = {}
    for column in columns:
        tokens = split[column.name]
        for place, token in enumerate(tokens):
            if token.isdigit():
                alike = (*tokens[:place], _JOINT, *tokens[place + 1 :])
                groups.setdefault(alike, {}).setdefault(int(token), column)
    for group in groups.values():
        if len(group) == count:
            yield Group(tuple(group[number] for number in sorted(group)), named=count == 1)


def _tokens(name: str) -> Tokens:
    """Words and numbers of a name, in lower case; a unit in brackets is left out."""
    bare = re.sub(r"[\[(][^\])]*[A-Za-z%°][^\])]*[\])]", " ", name)
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", bare)
    return tuple(str(int(p)) if p.isdigit() else p.lower() for p in parts)


def _without(tokens: Tokens, part: Tokens) -> Tokens | None:
    """``tokens`` with ``part``, which stands in them once, replaced; None where it does not."""
    places = [k for k in range(len(tokens) - len(part) + 1) if tokens[k : k + len(part)] == part]
    if len(places) != 1:
        return None
    k = places[0]
    return (*tokens[:k], _JOINT, *tokens[k + len(part) :])
