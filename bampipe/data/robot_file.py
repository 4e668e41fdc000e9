"""A chain of joints out of a robot's file, URDF or MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.data.chain import Chain, select_chain
from bampipe.data.mjcf import mjcf_tree
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
    root = read_xml(path)
    if root.tag == "mujoco":
        tree = mjcf_tree(root, str(path))
    elif root.tag == "robot":
        tree = urdf_tree(root, path)
    else:
        raise InputError(
            f"found <{root.tag}>, expected <robot> of a URDF or <mujoco> of an MJCF",
            where=str(path),
        )
    return select_chain(tree, base, tip, payload, str(path))
