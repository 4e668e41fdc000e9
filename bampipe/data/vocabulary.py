"""The words and spellings of ``vocabulary.toml``, by which logs of strangers are understood."""

from bampipe.files import packaged_table

VOCABULARY = packaged_table(__file__)


def word_set(name: str) -> frozenset[str]:
    """Words that have a meaning beside the role of a column."""
    return frozenset(VOCABULARY["words"][name].split())


def by_word(table: str) -> dict[str, str]:
    """Meaning of each word of a table."""
    return {word: key for key, text in VOCABULARY[table].items() for word in text.split()}
