"""What is said of a set-up, by the texts of ``sentences.toml``."""

from bampipe.files import packaged_table

SENTENCES = packaged_table(__file__)


def sentence(name: str, **known: object) -> str:
    """A sentence on what was found or guessed, with the fields in it."""
    return str(SENTENCES["said"][name].format(**known))
