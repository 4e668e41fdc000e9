"""The report in print: pages without holes."""

import re

import pytest

from bampipe.report.document import Block, Document, Figure, Section, Table
from bampipe.report.typeset import render_pdf

_POINT = 1.0 / 72.0


def drawing(height_cm: float) -> Figure:
    size = f'width="480pt" height="{height_cm / 2.54 / _POINT:.0f}pt"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size}><rect width="9" height="9"/></svg>'
    return Figure(f"high-{height_cm:g}", "A drawing.", svg)


def lines(count: int) -> list[Block]:
    return ["One line of text."] * count


def document(*blocks: Block) -> Document:
    return Document("Title", "subtitle", (Section("Section", blocks),))


def count_pages(printed: bytes) -> int:
    return len(re.findall(rb"/Type\s*/Page\b", printed))


def test_text_runs_on_beside_a_figure_that_goes_to_the_next_page() -> None:
    # On A4 they fill a page and three quarters; three pages with a hole on the first.
    assert count_pages(render_pdf([document(*lines(20), drawing(14.0), *lines(20))])) == 2


@pytest.mark.parametrize(("rows", "words", "pages"), [(6, 70, 2), (12, 25, 2), (6, 25, 2)])
def test_a_table_that_would_leave_a_hole_is_broken(rows: int, words: int, pages: int) -> None:
    table = Table("Caption", "Name | What ~1", [("A name", "several words " * words)] * rows)
    assert count_pages(render_pdf([document(*lines(20), table, *lines(14))])) == pages


def test_a_sheet_is_the_first_version_that_fits_on_one_page() -> None:
    versions = [document(*lines(count)) for count in (80, 20, 10)]
    assert render_pdf(versions) == render_pdf(versions[1:])
    assert count_pages(render_pdf(versions[:1])) > 1


def test_columns_are_read_and_empty_ones_left_out() -> None:
    table = Table("t", "Name | What ~1.6 | >Unit (1/s) ~1", (("a", "", "N"), ("b", "", "")))
    shown = table.drop_empty_columns()
    assert [(one.title, one.side, one.width) for one in shown.read_columns()] == [
        ("Name", "l", 0.0),
        ("Unit (1/s)", "r", 1.0),
    ]
    assert shown.rows == (("a", "N"), ("b", ""))
    first, *_ = Table("t", " ~0.9 | >x", ()).read_columns()
    assert (first.title, first.width) == ("", 0.9)
