"""What is said of a set-up, by the texts of ``sentences.toml``."""

import tomllib
from pathlib import Path

SENTENCES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def sentence(name: str, **known: object) -> str:
    """A sentence on what was found or guessed, with the fields in it."""
    return str(SENTENCES["said"][name].format(**known))
