"""What is refused of sessions and logs, and what to do, by the texts of ``refusals.toml``."""

from bampipe.errors import InputError
from bampipe.files import packaged_table

_REFUSALS = packaged_table(__file__)


def refusal(name: str, where: str = "", /, **known: object) -> InputError:
    """The error called ``name`` in ``refusals.toml``, with the fields of its sentences."""
    said = {key: text.format(**known) for key, text in _REFUSALS[name].items()}
    return InputError(**{"where": where, **said})
