"""What is refused of sessions and logs, and what to do, by the texts of ``refusals.toml``."""

import tomllib
from pathlib import Path

from bampipe.errors import InputError

_REFUSALS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def refusal(name: str, where: str = "", /, **known: object) -> InputError:
    """The error called ``name`` in ``refusals.toml``, with the fields of its sentences."""
    said = {key: text.format(**known) for key, text in _REFUSALS[name].items()}
    return InputError(**{"where": where, **said})
