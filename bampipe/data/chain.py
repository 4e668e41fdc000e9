"""A chain of joints out of a robot's file, as the plain tables that a device file holds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bampipe.arrays import Array
from bampipe.data import robot_tree
from bampipe.data.mjcf import mjcf_tree
from bampipe.data.refusals import refusal
from bampipe.data.robot_tree import MOVING, LumpedBodies, Tree, TreeJoint, identifier
from bampipe.data.robot_xml import read_xml
from bampipe.data.urdf import urdf_tree
from bampipe.errors import InputError, did_you_mean, located
from bampipe.lists import join_names

_MANY = 8
"""Most names that a message lists."""


class Branches(InputError):
    """The joints of a robot branch.

    Attributes:
        stem: last link before they do; empty where they do at the base.
        chains: by the link that each ends at, its joints as the file names them, with the link
            behind each.
    """

    stem: str = ""
    chains: Mapping[str, Sequence[tuple[str, str]]] = {}


def read_tree(path: Path) -> Tree:
    """Read the links and joints of a robot's file.

    Raises:
        InputError: neither URDF nor MJCF, or one with wrong entries.
    """
    with located(str(path), ": "):
        root = read_xml(path)
        if root.tag == "mujoco":
            return mjcf_tree(root)
        if root.tag == "robot":
            return urdf_tree(root, path)
        raise InputError(f"found <{root.tag}>, expected <robot> of a URDF or <mujoco> of an MJCF")


def read_chain(
    path: Path, robot: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, robot_tree.DriveLimits], list[str]]:
    """Read the moving joints from the link ``base`` of a table ``[robot]`` to its ``tip``.

    The root of the tree is the base that a table does not name, and its only end the tip. A
    ``payload`` of the table is a body held there, in the frame of the tip.

    Args:
        path: of a URDF or MJCF; robot: the table.

    Returns:
        The table with its links, the entries of ``[robot.joints]`` and, where the file tells of it,
        the gravity; limits of the joints' drives by name; and what was left out or joined, or where
        the gravity is from, a sentence each.

    Raises:
        InputError: another file, a wrong joint or link, or no single chain between the links.
    """
    base, tip = (x if isinstance(x := robot.get(key), str) else "" for key in ("base", "tip"))
    payload = robot.get("payload")
    with located(str(path), ": "):
        tree = read_tree(path)
        _refuse_broken(tree)
        for link in filter(None, (base, tip)):
            _require_link(tree, link, f"no link {link!r}")
        base = base or _only_root(tree)
        tip = tip or _only_end(tree, base)
        tree, held_still = _hold_followers(tree, tree.path(base, tip))
        joints = tree.path(base, tip)
        if isinstance(payload, Mapping):
            held = tree.bodies[tip].joined(robot_tree.Body.of_table(payload))
            tree = replace(tree, bodies={**tree.bodies, tip: held})
        moving = [joint for joint in joints if joint.kind != "fixed"]
        if not moving:
            raise InputError(f"no joint moves between {base!r} and {tip!r}")
        lumped = LumpedBodies(tree, moving)
        limits = {identifier(joint.name): joint.limits for joint in moving}
        held_still += [joint.name for start in moving for joint in lumped.held_on(start.child)]
        notes = [*tree.notes]
        if held_still:
            notes.insert(0, f"held at zero beside the chain: {join_names(held_still, _MANY)}")
        found = {**robot, "joints": _tables(joints, lumped), "base": base, "tip": tip}
        if "gravity" not in robot:
            gravity, said = robot_tree.gravity_at(tree, base)
            notes += [said] if said else []
            found |= {"gravity": list(gravity)} if gravity else {}
        return found, limits, notes


def _hold_followers(tree: Tree, path: Sequence[TreeJoint]) -> tuple[Tree, list[str]]:
    """The tree with joints that follow others of the path alone, and those now held still.

    What follows a joint beside the path is held at zero, and one that follows a follower follows
    what moves that.
    """
    own = {joint.name: joint for joint in path if joint.kind != "fixed"}
    joints, held = list(tree.joints), []
    for k, joint in enumerate(joints):
        if joint.mimic is None or joint.name not in own:
            continue
        (other, ratio, zero), seen = joint.mimic, {joint.name}
        while other in own and other not in seen and own[other].mimic is not None:
            seen.add(other)
            after, by, at = own[other].mimic or ("", 1.0, 0.0)
            other, ratio, zero = after, ratio * by, zero + ratio * at
        if other in own and other not in seen:
            joints[k] = replace(joint, mimic=(other, ratio, zero))
        else:
            joints[k] = replace(joint, kind="fixed", mimic=None)
            held.append(joint.name)
    return replace(tree, joints=joints), held


def frame_of_tip(tree: Tree, base: str, tip: str) -> tuple[Array, Array]:
    """Rotation (3, 3) and place (3,), m, of the tip's frame in that of the last joint that moves.

    Raises:
        InputError: no path between the links.
    """
    turn, offset = np.eye(3), np.zeros(3)
    for joint in tree.path(base, tip):
        if joint.kind != "fixed":
            turn, offset = np.eye(3), np.zeros(3)
            continue
        offset, turn = offset + turn @ joint.offset, turn @ joint.turn
    return turn, offset


def _tables(path: Sequence[TreeJoint], lumped: LumpedBodies) -> dict[str, Any]:
    """The tables of the moving joints of a path, each placed in the frame of the one before."""
    found: dict[str, Any] = {}
    turn, offset, before = np.eye(3), np.zeros(3), ""
    fixed_between = False
    for joint in path:
        offset = offset + turn @ joint.offset
        turn = turn @ joint.turn
        if joint.kind == "fixed":
            fixed_between = True
            continue
        name = identifier(joint.name)
        if name in found:
            raise InputError(f"two joints are called {name!r}")
        angles = Rotation.from_matrix(turn).as_euler("xyz") if fixed_between else joint.angles
        table: dict[str, Any] = {
            "kind": MOVING[joint.kind],
            "position": [float(v) for v in offset],
            "rotation": [float(v) for v in angles],
            "axis": joint.axis,
            "effort": max(joint.limits.effort, 0.0),
            "velocity": max(joint.limits.velocity, 0.0),
            **lumped.body_on(joint.child).table(),
        }
        if joint.mimic is not None:
            other, ratio, zero = joint.mimic
            table |= {"follows": identifier(other), "ratio": ratio, "zero": zero}
        found[name] = {"after": before, **table} if before else table
        turn, offset, before, fixed_between = np.eye(3), np.zeros(3), name, False
    return found


def _refuse_broken(tree: Tree) -> None:
    """Refuse joints without their links or without a direction, loops, and chains too long."""
    for joint in tree.joints:
        for end in (joint.parent, joint.child):
            what = f"joint {joint.name!r} names link {end!r}, which is not there"
            _require_link(tree, end, what)
        if joint.kind in MOVING and not any(joint.axis):
            raise InputError("an axis of length zero", where=f"joint {joint.name!r}")
    if len(tree.above) < len(tree.joints):
        twice = next(j for j in tree.joints if tree.above[j.child] is not j)
        raise refusal("closed_loop", link=twice.child)
    for link in tree.above:
        tree.way(link)


def _require_link(tree: Tree, name: str, what: str) -> None:
    if name not in tree.bodies:
        raise InputError(f"{what}{did_you_mean(name, tree.bodies)}")


def _only_root(tree: Tree) -> str:
    roots = [name for name in tree.bodies if name not in tree.above]
    if not roots:
        raise InputError("no links")
    if len(roots) != 1:
        raise refusal("several_roots", count=len(roots), roots=join_names(roots, _MANY))
    return roots[0]


def _only_end(tree: Tree, base: str) -> str:
    """The last link of the only chain of moving joints from ``base``."""
    above = tree.above
    chains: dict[str, list[str]] = {}
    for link in (joint.child for joint in tree.joints):
        behind = dropwhile(lambda joint: joint.parent != base, tree.way(link))
        chains[link] = [joint.name for joint in behind if joint.kind != "fixed"]
    longest = max(chains, key=lambda link: len(chains[link]), default="")
    ends = [
        link
        for link, names in chains.items()
        if names and above[link].kind != "fixed" and names != chains[longest][: len(names)]
    ]
    if not longest or not chains[longest]:
        raise InputError(f"no joint moves below {base!r}")
    if ends:
        others = [above[longest].child, *ends]
        levels = zip(*(chains[link] for link in others), strict=False)
        common = [level[0] for level in takewhile(lambda level: len(set(level)) == 1, levels)]
        stem = next((j.child for j in tree.joints if common and j.name == common[-1]), "")
        linked = {joint.name: joint.child for joint in tree.joints}
        error = Branches(
            f"the joints branch; chains end at {join_names(others, _MANY)}",
            remedy='choose one: base = "..." and tip = "..." in [robot] of a device file'
            + (f'; tip = "{stem}" ends before they branch' if stem else ""),
        )
        error.stem = stem
        error.chains = {end: [(name, linked[name]) for name in chains[end]] for end in others}
        raise error
    return longest
