"""Libraries that only some formats need, and how to get them."""

from __future__ import annotations

import importlib
from types import ModuleType

from bampipe.errors import InputError


def need(module: str, extra: str, name: str) -> ModuleType:
    """The module, which belongs to an optional extra of bampipe.

    Args:
        module: full name of what to import.
        extra: the extra of bampipe that brings it.
        name: the file that needs it, for the message.

    Raises:
        InputError: it is not installed; names the pip command.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise InputError(
            f"reading this file needs {package}, which is not installed",
            where=name,
            remedy=f"pip install 'bampipe[{extra}]'",
        ) from error
