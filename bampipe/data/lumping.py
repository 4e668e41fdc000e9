"""Lumped bodies: what is fixed to a link or held still beside a chain, joined to that link."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from bampipe.data.rigid_body import Body
from bampipe.data.robot_tree import DriveLimits, Tree, TreeJoint, identifier


@dataclass(frozen=True)
class LumpedBodies:
    """What the links of a chain carry: all that the chain does not move against them.

    Attributes:
        tree: all links and joints; moving: the joints of the chain that move.
    """

    tree: Tree
    moving: Sequence[TreeJoint]

    @cached_property
    def _behind(self) -> Mapping[str, Sequence[TreeJoint]]:
        """By link, the joints on it that the chain does not move."""
        starts = {joint.child for joint in self.moving}
        found: dict[str, list[TreeJoint]] = {}
        for joint in self.tree.joints:
            if joint.child not in starts:
                found.setdefault(joint.parent, []).append(joint)
        return found

    def body_on(self, link: str) -> Body:
        """The body of a link with all that is fixed to it or held still on it, in its frame."""
        total = self.tree.bodies[link]
        for joint in self._behind.get(link, ()):
            total = total.joined(self.body_on(joint.child).moved(joint.turn, joint.offset))
        return total

    def held_on(self, link: str) -> Iterator[TreeJoint]:
        """The joints held still on a link and what is on it, of those that carry mass."""
        for joint in self._behind.get(link, ()):
            if joint.kind != "fixed" and self._mass_on(joint.child) > 0.0:
                yield joint
            yield from self.held_on(joint.child)

    def fixed_on(self, link: str) -> Iterator[str]:
        """The links fixed to a link, one on another."""
        for joint in self._behind.get(link, ()):
            if joint.kind == "fixed":
                yield joint.child
                yield from self.fixed_on(joint.child)

    def body_held_on(self, link: str) -> Body:
        """The part of `body_on` that is behind joints held still, in the frame of the link."""
        total = Body()
        for joint in self._behind.get(link, ()):
            fixed = joint.kind == "fixed"
            part = self.body_held_on(joint.child) if fixed else self.body_on(joint.child)
            total = total.joined(part.moved(joint.turn, joint.offset))
        return total

    def _mass_on(self, link: str) -> float:
        behind = self._behind.get(link, ())
        return self.tree.bodies[link].mass + sum(self._mass_on(joint.child) for joint in behind)


def put_bodies(
    tree: Tree, base: str, tip: str, bodies: Mapping[str, Body], limits: Mapping[str, DriveLimits]
) -> Tree:
    """The tree with other bodies and limits on the joints of a chain, the same to its motion.

    What was joined to make the body of a joint is parted again: links on fixed joints get no mass,
    which is in that of the link behind the joint; those on joints that are held keep theirs, which
    is taken off there.

    Args:
        tree: from which the chain was selected.
        base, tip: of the chain.
        bodies, limits: by joint of the chain.
    """
    # A joint that follows one beside the chain is held, too, and has no body of its own.
    path = [joint for joint in tree.path(base, tip) if joint.kind != "fixed"]
    moving = [joint for joint in path if identifier(joint.name) in bodies]
    lumped = LumpedBodies(tree, moving)
    placed = dict(tree.bodies)
    named = {joint.name: identifier(joint.name) for joint in moving}
    for joint in moving:
        own = bodies[named[joint.name]]
        placed[joint.child] = own.without(lumped.body_held_on(joint.child))
        placed |= {link: Body() for link in lumped.fixed_on(joint.child)}
    joints = [
        replace(joint, limits=limits[named[joint.name]]) if joint.name in named else joint
        for joint in tree.joints
    ]
    return replace(tree, bodies=placed, joints=joints)
