"""The report in print: pages without holes."""

from __future__ import annotations

import re
from typing import Any

import pytest

from bampipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from bampipe.report.typeset import (
    first_below_a_hole,
    first_overtaking,
    first_with_few_rows,
    mend_first,
    pdf,
)

_POINT = 1.0 / 72.0


def drawing(height_cm: float) -> Figure:
    size = f'width="480pt" height="{height_cm / 2.54 / _POINT:.0f}pt"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size}><rect width="9" height="9"/></svg>'
    return Figure(f"high-{height_cm:g}", "A drawing.", svg)


def lines(count: int) -> list[Block]:
    return [Paragraph("One line of text.")] * count


def pages(*blocks: Block) -> int:
    printed = pdf(Document("Title", "subtitle", (Section("Section", blocks),)), 0)
    return len(re.findall(rb"/Type\s*/Page\b", printed))


def test_text_runs_on_below_a_figure_that_goes_to_the_next_page() -> None:
    # On A4 they fill a page and three quarters; three pages with a hole on the first.
    assert pages(*lines(20), drawing(14.0), *lines(20)) == 2


def test_a_table_that_leaves_a_hole_is_broken() -> None:
    row = ("A name", "several words " * 70)
    table = Table("Caption", ("Name", "What"), (row,) * 6, "ll", (0.0, 1.0))
    assert pages(*lines(20), table, *lines(14)) == 2  # 3 with a hole


@pytest.mark.parametrize(("rows", "breaks"), [(3, False), (4, True)])
def test_a_table_of_few_rows_stays_in_one_piece(rows: int, breaks: bool) -> None:
    table = block(1, "table", rows=[[]] * rows)
    edges = [edge(0, "end", 1, 500.0), edge(1, "start", 2, 65.0), edge(1, "end", 2, 200.0)]
    found = first_below_a_hole([section(block(0, "text"), table)], edges)
    assert (found is table) is breaks


def edge(block: int, side: str, page: int, y: float) -> dict[str, Any]:
    return {"block": block, "edge": side, "page": page, "y": y}


def block(number: int, kind: str, **more: Any) -> dict[str, Any]:
    known = {"id": number, "kind": kind, "loose": False, "kept": False, "raised": 0}
    return {**known, **more}


def section(*blocks: dict[str, Any]) -> dict[str, Any]:
    return {"held": False, "blocks": list(blocks)}


@pytest.mark.parametrize(
    ("text_ends", "figure_page", "expected"),
    [(400.0, 2, 1), (760.0, 2, None), (400.0, 1, None)],
    ids=["hole", "a full page", "on the same page"],
)
def test_the_first_block_below_a_hole(
    text_ends: float, figure_page: int, expected: int | None
) -> None:
    sections = [section(block(0, "text"), block(1, "figure"))]
    edges = [edge(0, "end", 1, text_ends), edge(1, "start", figure_page, 65.0)]
    found = first_below_a_hole(sections, edges)
    assert (found and found["id"]) == expected


@pytest.mark.parametrize(
    ("pages_of_figures", "loose", "expected"),
    [((3, 2), False, 1), ((3, 2), True, None), ((2, 2), False, None), ((2, 3), False, None)],
    ids=["out of order", "moved already", "on one page", "in order"],
)
def test_no_figure_stands_before_an_earlier_one(
    pages_of_figures: tuple[int, int], loose: bool, expected: int | None
) -> None:
    figures = [block(n, "figure", loose=loose or n == 0) for n in range(2)]
    edges = [edge(n, "start", page, 65.0) for n, page in enumerate(pages_of_figures)]
    found = first_overtaking([section(*figures)], edges)
    assert (found and found["id"]) == expected


@pytest.mark.parametrize(
    ("start", "third_row_page", "last_but_one_page", "end", "expected"),
    [
        (720.0, 2, 2, 300.0, 1),
        (700.0, 1, 2, 300.0, None),
        (720.0, 2, 2, 740.0, None),
        (660.0, 1, 1, 90.0, 1),
        (600.0, 1, 1, 90.0, None),
        (600.0, 2, 2, 300.0, None),
    ],
    ids=["two rows", "three rows", "longer than a page", "one left", "a hole", "two high rows"],
)
def test_a_table_leaves_no_row_or_two_by_themselves(
    start: float, third_row_page: int, last_but_one_page: int, end: float, expected: int | None
) -> None:
    edges = [
        edge(1, "start", 1, start),
        edge(1, "third row", third_row_page, 90.0),
        edge(1, "last but one", last_but_one_page, 90.0),
        edge(1, "end", 2, end),
    ]
    found = first_with_few_rows([section(block(1, "table"))], edges)
    assert (found and found["id"]) == expected


def test_a_figure_that_leaves_a_hole_goes_up_in_its_section_before_it_floats() -> None:
    blocks = [
        block(0, "subheading"),
        block(1, "text"),
        block(2, "table", rows=[]),
        block(3, "figure"),
    ]
    sections = [section(*blocks)]
    edges = [edge(1, "end", 1, 300.0), edge(2, "end", 1, 500.0), edge(3, "start", 2, 65.0)]
    orders = []
    for _ in range(3):
        assert mend_first(sections, edges)
        orders.append([one["id"] for one in sections[0]["blocks"]])
        at = orders[-1].index(3)
        # What stands above it is too high for it wherever it goes.
        edges = [edge(0, "end", 1, 500.0 - at), edge(3, "start", 2, 65.0)]
    assert orders == [[0, 1, 3, 2], [0, 3, 1, 2], [0, 1, 2, 3]]
    assert blocks[3]["loose"]


@pytest.mark.parametrize(("text_ends", "held"), [(650.0, True), (500.0, False)])
def test_a_figure_stays_in_its_section_where_the_hole_is_small(
    text_ends: float, held: bool
) -> None:
    figure = block(1, "figure", loose=True)
    sections = [section(block(0, "text"), figure), section(block(2, "text"))]
    edges = [
        edge(0, "end", 1, text_ends),
        edge(2, "section", 1, text_ends + 20.0),
        edge(1, "start", 2, 65.0),
        edge(1, "end", 2, 300.0),
    ]
    assert mend_first(sections, edges) is held
    assert sections[0]["held"] is held


def test_a_column_in_which_no_row_says_anything_is_left_out() -> None:
    table = Table(
        "t", ("Name", "What", "Unit"), (("a", "", "N"), ("b", "", "")), "llr", (0, 1.6, 1)
    )
    shown = table.without_empty_columns()
    assert shown.head == ("Name", "Unit") and shown.rows == (("a", "N"), ("b", ""))
    assert (shown.align, shown.widths) == ("lr", (0, 1))
