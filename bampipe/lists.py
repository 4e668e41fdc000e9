"""Lists in a sentence."""

from collections.abc import Iterable


def join_names(names: Iterable[str], most: int | None = None) -> str:
    """Return ``a, b and c``; of more than ``most`` names, ``a, b and 3 more``."""
    found = list(names)
    if most is not None and len(found) > most:
        return f"{', '.join(found[:most])} and {len(found) - most} more"
    if len(found) < 2:
        return "".join(found)
    return f"{', '.join(found[:-1])} and {found[-1]}"


def count_noun(number: int, noun: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
