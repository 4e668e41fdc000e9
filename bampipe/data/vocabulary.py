"""The words and spellings of ``vocabulary.toml``, by which logs of strangers are understood."""

import tomllib
from pathlib import Path
from typing import Any

_FILE = Path(__file__).with_name("vocabulary.toml")
VOCABULARY: dict[str, Any] = tomllib.loads(_FILE.read_text(encoding="utf-8"))


def word_set(name: str) -> frozenset[str]:
    """Words that have a meaning beside the role of a column."""
    return frozenset(VOCABULARY["words"][name].split())


def by_word(table: str) -> dict[str, str]:
    """Meaning of each word of a table."""
    return {word: key for key, text in VOCABULARY[table].items() for word in text.split()}
