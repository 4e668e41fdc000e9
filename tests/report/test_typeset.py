"""The report in print: pages without holes."""

from __future__ import annotations

import re

import pytest

from bampipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from bampipe.report.typeset import (
    first_below_a_hole,
    first_overtaking,
    first_with_few_rows,
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
    table = {"id": 1, "kind": "table", "loose": False, "kept": False, "rows": [[]] * rows}
    edges = [edge(0, "end", 1, 500.0), edge(1, "start", 2, 65.0), edge(1, "end", 2, 200.0)]
    assert (first_below_a_hole([{"id": 0, "kind": "text"}, table], edges) is table) is breaks


def edge(block: int, side: str, page: int, y: float) -> dict[str, object]:
    return {"block": block, "edge": side, "page": page, "y": y}


@pytest.mark.parametrize(
    ("text_ends", "figure_page", "expected"),
    [(400.0, 2, 1), (760.0, 2, None), (400.0, 1, None)],
    ids=["hole", "a full page", "on the same page"],
)
def test_the_first_block_below_a_hole(
    text_ends: float, figure_page: int, expected: int | None
) -> None:
    blocks = [{"id": 0, "kind": "text"}, {"id": 1, "kind": "figure", "loose": False}]
    edges = [edge(0, "end", 1, text_ends), edge(1, "start", figure_page, 65.0)]
    found = first_below_a_hole(blocks, edges)
    assert (found and found["id"]) == expected


@pytest.mark.parametrize(
    ("pages_of_figures", "loose", "expected"),
    [((3, 2), False, 1), ((3, 2), True, None), ((2, 2), False, None), ((2, 3), False, None)],
    ids=["out of order", "moved already", "on one page", "in order"],
)
def test_no_figure_stands_before_an_earlier_one(
    pages_of_figures: tuple[int, int], loose: bool, expected: int | None
) -> None:
    blocks = [{"id": n, "kind": "figure", "loose": loose or n == 0} for n in range(2)]
    edges = [edge(n, "start", page, 65.0) for n, page in enumerate(pages_of_figures)]
    found = first_overtaking(blocks, edges)
    assert (found and found["id"]) == expected


@pytest.mark.parametrize(
    ("third_row_page", "end", "expected"),
    [(2, 300.0, 1), (1, 300.0, None), (2, 740.0, None)],
    ids=["two rows alone", "three rows", "longer than a page"],
)
def test_a_table_leaves_no_two_rows_at_the_end_of_a_page(
    third_row_page: int, end: float, expected: int | None
) -> None:
    blocks = [{"id": 1, "kind": "table", "kept": False}]
    edges = [
        edge(1, "start", 1, 720.0),
        edge(1, "third row", third_row_page, 90.0),
        edge(1, "end", 2, end),
    ]
    found = first_with_few_rows(blocks, edges)
    assert (found and found["id"]) == expected


def test_a_column_in_which_no_row_says_anything_is_left_out() -> None:
    table = Table(
        "t", ("Name", "What", "Unit"), (("a", "", "N"), ("b", "", "")), "llr", (0, 1.6, 1)
    )
    shown = table.without_empty_columns()
    assert shown.head == ("Name", "Unit") and shown.rows == (("a", "N"), ("b", ""))
    assert (shown.align, shown.widths) == ("lr", (0, 1))
