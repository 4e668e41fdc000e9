"""Trials of one axis that stand side by side in a file, in columns named alike."""

import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np

from bampipe.arrays import Array
from bampipe.data.angle_torque import SmoothedMotion, least_squares
from bampipe.data.survey import DRIVERS, SurveyedColumn
from bampipe.setup.proposal.matching import Matcher
from bampipe.setup.proposal.positions import in_counts, position_in_si

_TOKENS = re.compile(r"\d+|[A-Za-z]+|[^A-Za-z\d]+")
_EXPLAINED, _AS_WELL = 0.8, 1.12
"""Share of each drive that its own motion must explain, and times the mean square that one set of
parameters may leave: measured trials of one axis leave 1.07 at most, joints 1.25 at least."""
_SAME = 0.99
"""Correlation of two positions that are one motion, filtered for example."""


def find_trials(match: Matcher, position: SurveyedColumn, si: str) -> list[dict[str, str]]:
    """Columns of the further trials by those of the first, which has ``position`` in ``si``.

    Further joints look the same, but no one machine explains them all: all that differ in the same
    place of their names, or none.
    """
    columns = {c.name: c for c in match.found.columns}
    drive = next((c for c in match.found.of(*DRIVERS) if c.name in match.used), None)
    trials: dict[int, dict[str, dict[str, str]]] = {}
    joints = set()
    for place, move in _moves(position.name, columns) if drive is not None else ():
        moved = {
            name: columns[other]
            for name in match.used
            if (other := move(name)) in columns and columns[other].role == columns[name].role
        }
        if drive is not None and {position.name, drive.name} <= set(moved):
            q, u = moved[position.name], moved[drive.name]
            alike = abs(np.corrcoef(np.nan_to_num([position.values, q.values]))[0, 1]) > _SAME
            if not alike and _is_one_machine([(position, drive), (q, u)], match.t, si):
                named = {n: c.name for n, c in moved.items() if c.name != n}
                trials.setdefault(place, {}).setdefault(q.name, named)
            elif not alike:
                joints.add(place)
    found = (list(trials[place].values()) for place in trials if place not in joints)
    return max(found, key=len, default=[])


def _moves(name: str, others: Iterable[str]) -> Iterator[tuple[int, Callable[[str], str]]]:
    """How names become those of another trial, by a step of a number or another word; and where."""
    own = _TOKENS.findall(name)
    for other in others:
        theirs = _TOKENS.findall(other)
        apart = [k for k, pair in enumerate(zip(own, theirs, strict=False)) if len(set(pair)) > 1]
        if len(own) == len(theirs) and len(apart) == 1:
            here, there = own[apart[0]], theirs[apart[0]]
            if here.isdigit() == there.isdigit():
                place = sum(map(str.isdigit, own[: apart[0]]))
                yield apart[0], partial(_moved, place=place, here=here, there=there)


def _moved(name: str, place: int, here: str, there: str) -> str:
    tokens = _TOKENS.findall(name)
    if not here.isdigit():
        return "".join(there if token == here else token for token in tokens)
    for k in [k for k, token in enumerate(tokens) if token.isdigit()][place : place + 1]:
        tokens[k] = f"{int(tokens[k]) + int(there) - int(here):0{len(tokens[k])}d}"
    return "".join(tokens)


def _is_one_machine(
    pairs: Iterable[tuple[SurveyedColumn, SurveyedColumn]], t: Array, si: str
) -> bool:
    """Whether motions and drives have the same inertia, friction, weight and stiffness."""
    designs, targets, left = [], [], 0.0
    for position, drive in pairs:
        motion = SmoothedMotion.of(t, position_in_si(position, t, si))
        if motion is None:
            return False
        q, u = motion.position, motion.smooth(np.nan_to_num(drive.values))[motion.inner]
        turns = (np.sin(q), np.cos(q)) if si == "rad" and not in_counts(position) else ()
        designs.append(np.column_stack([motion.moving, q, *turns])[motion.inner])
        targets.append(u - u.mean())  # each may be zeroed anew
        designs[-1] -= designs[-1].mean(axis=0)
        rest = least_squares(designs[-1], targets[-1])[1]
        if not rest @ rest < (1.0 - _EXPLAINED) * (targets[-1] @ targets[-1]):
            return False
        left += float(rest @ rest)
    rest = least_squares(np.concatenate(designs), np.concatenate(targets))[1]
    return float(rest @ rest) < _AS_WELL * left
