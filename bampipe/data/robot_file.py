"""A chain of joints out of a robot's file, URDF or MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.data.chain import Chain, select_chain
from bampipe.data.mjcf import mjcf_tree
from bampipe.data.robot_tree import Tree
from bampipe.data.robot_xml import read_xml
from bampipe.data.urdf import urdf_tree
from bampipe.errors import InputError


def read_chain(
    path: Path, base: str = "", tip: str = "", payload: Mapping[str, Any] | None = None
) -> Chain:
    """Read the chain of joints from ``base`` to ``tip``; arguments are those of `select_chain`.

    Raises:
        InputError: neither URDF nor MJCF, or none from which there is such a chain.
    """
    return select_chain(read_tree(path), base, tip, payload, str(path))


def read_tree(path: Path) -> Tree:
    """Read the links and joints of a robot's file.

    Raises:
        InputError: neither URDF nor MJCF, or one with wrong entries.
    """
    root = read_xml(path)
    if root.tag == "mujoco":
        return mjcf_tree(root, str(path))
    if root.tag == "robot":
        return urdf_tree(root, path)
    raise InputError(
        f"found <{root.tag}>, expected <robot> of a URDF or <mujoco> of an MJCF",
        where=str(path),
    )
