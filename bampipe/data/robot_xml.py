"""XML as files of robots have it: one element, numbers in attributes."""

import math
from collections.abc import Iterable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

from bampipe.data.refusals import refusal
from bampipe.errors import InputError
from bampipe.files import read_bytes

LARGEST_BYTES = 20_000_000
DEEPEST = 200
"""Most elements inside one another, and links one behind another."""
Attribute = str | float | Iterable[float]
"""Attribute of an element: text, a number or several."""


def read_xml(path: Path, to_write: bool = False) -> ElementTree.Element:
    """The root of an XML file; ``to_write``: with its comments and prefixes of namespaces.

    Raises:
        InputError: no XML, one with a document type or entities, or too deep.
    """
    where = str(path)
    text = read_bytes(path, LARGEST_BYTES)
    if b"<!ENTITY" in text or b"<!DOCTYPE" in text:
        raise InputError("a robot's file has no document type or entities", where=where)
    try:
        builder = ElementTree.TreeBuilder(insert_comments=to_write)
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=builder))
    except ElementTree.ParseError as error:
        line = error.position[0]
        why = str(error).partition(":")[0]
        raise refusal("no_xml", f"{where}, line {line}", why=why) from error
    if to_write:  # namespaces have the prefixes that they have in the text
        for _, (prefix, name) in ElementTree.iterparse(BytesIO(text), events=("start-ns",)):
            with suppress(ValueError):  # ns1 and the like, which are given anew
                ElementTree.register_namespace(prefix, name)
    level, depth = [root], 0
    while level := [inner for element in level for inner in element]:
        depth += 1
        if depth > DEEPEST:
            raise refusal("nested", where, deepest=DEEPEST)
    return root


def numbers(element: ElementTree.Element | None, key: str, default: str, count: int) -> list[float]:
    """The ``count`` numbers of an attribute, ``default`` where there is none.

    Raises:
        InputError: others, or another number of them.
    """
    text = default if element is None else element.get(key, default)
    try:
        found = [float(part) for part in text.split()]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        tag = "" if element is None else f"<{element.tag} {key}>: "
        expected = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f'{tag}found "{text}", expected {expected}')
    return found


def number(element: ElementTree.Element | None, key: str, default: str = "0") -> float:
    """The number of an attribute; as `numbers`."""
    return numbers(element, key, default, 1)[0]


def document(root: ElementTree.Element, comment: str, indented: bool = True) -> str:
    """The text of a file with a comment at its head; ``indented``, or spaced as it is."""
    head = ElementTree.Comment(f" {comment.replace('--', '- -')} ")
    head.tail = root.text
    root.insert(0, head)
    if indented:
        ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def number_list(values: float | Iterable[float]) -> str:
    """A number or several as an attribute of XML holds them."""
    several = values if isinstance(values, Iterable) else (values,)
    return " ".join(repr(float(v)) for v in several)


def assign(element: ElementTree.Element, **attributes: Attribute) -> ElementTree.Element:
    """Give an element attributes; returns it."""
    texts = {k: v if isinstance(v, str) else number_list(v) for k, v in attributes.items()}
    element.attrib.update(texts)
    return element


def put(parent: ElementTree.Element, tag: str, **attributes: Attribute) -> ElementTree.Element:
    """Add an inner element with attributes; returns it."""
    return assign(ElementTree.SubElement(parent, tag), **attributes)
