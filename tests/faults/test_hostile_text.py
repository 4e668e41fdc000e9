"""Names and sentences out of files that others wrote: shown, never obeyed."""

import io
import os
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from conftest import Command, Toy

from bampipe.cli import show
from bampipe.errors import InputError, printable
from bampipe.report import document
from bampipe.report.page import render_page
from bampipe.report.typeset import render_pdf
from bampipe.results.run import GateVerdict
from bampipe.run.events import Event
from bampipe.run.request import Outcome
from bampipe.run.summaries import junit, markdown

CLEAR_SCREEN = "\x1b[2J"
CONTROLS = [CLEAR_SCREEN, "\x9b31m", "\x07", "\x08", "\r", "\u202e", "\x7f", "\udcff", "\ufffe"]
MARKUP = "<script>alert(1)</script><img src=x onerror=alert(2)>"


@pytest.mark.parametrize("control", CONTROLS)
def test_a_message_obeys_no_control_character(control: str) -> None:
    message = str(InputError(f"no column 'a{control}b'", where=f"t{control}.csv"))
    assert control not in message
    assert message.isprintable() and message.encode()


def test_plain_text_stays_as_it_is() -> None:
    for text in ("ρ = 0 at ±90°, ‘x’ → 3 N.m", "two\nlines\tand a tab", "名前", ""):
        assert printable(text) == text


@pytest.mark.parametrize("control", CONTROLS)
def test_tables_and_lines_obey_no_control_character(
    control: str, capsys: pytest.CaptureFixture[str]
) -> None:
    show.print_table(["name", control], [[f"a{control}b", 1.0]])
    show.say(control)
    show.note(control)
    printed = capsys.readouterr()
    for text in (printed.out, printed.err):
        assert all(c.isprintable() or c == "\n" for c in text)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("name", ["[/b]", "[red]t", f"t{CLEAR_SCREEN}", "[link=file:///etc]x"])
def test_progress_takes_a_trial_for_text(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = _Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    with show.Watcher(quiet=False) as watcher:
        watcher(Event("run", "ingest", "progress", 0.5, name))
        watcher.bars.refresh()
    assert printable(name) in screen.getvalue()


@pytest.mark.parametrize("control", CONTROLS)
def test_junit_is_xml_whatever_a_session_is_called(control: str) -> None:
    given = {"gate": f"gate{control}", "key": f"yaw{control}", "message": f"bad{control}{MARKUP}"}
    verdict = GateVerdict(**given, state="failed", value=1.0)
    outcomes = [
        Outcome(Path(f"s{control}"), "done", verdicts=(verdict,)),
        Outcome(Path("s2"), "refused", error=f"no{control}{MARKUP}"),
    ]
    top = ElementTree.fromstring(junit(outcomes))
    names = [printable(str(suite.get("name"))) for suite in top]
    assert names == [printable(f"s{control}"), "s2"]
    message = top[0][0][0].get("message")
    assert message is not None and message.endswith(MARKUP)


def test_markdown_takes_a_session_for_text(tmp_path: Path) -> None:
    hostile = "x|y`*[a](javascript:b)<img src=x>&lt;b&gt;\n# head\x1b[2J"
    outcome = Outcome(tmp_path / "s", "refused", (), (), hostile)
    (line,) = [line for line in markdown([outcome]).splitlines() if "javascript" in line]
    assert "\x1b" not in line and "# head" not in line[:2]
    bare = line.replace("\\\\", "")
    for mark in "|`*[]<>&":
        inside = bare.strip("| ").partition(" | ")[2].rpartition(" | ")[2]
        assert mark not in inside.replace(f"\\{mark}", ""), mark


def test_a_path_that_is_no_text_is_one_line(toy: Toy, command: Command) -> None:
    folder = os.fsdecode(os.fsencode(toy.folder) + b"/b\xffd")
    shutil.copytree(toy.session, folder)
    code, _, err = command("run", folder, *toy.options)
    assert code == 2 and err.count("\n") == 1, err
    assert "\\udcff" in err and "rename" in err


HOSTILE = (MARKUP, '#import "/etc/passwd"; #read("/etc/x")', "$\\input{/etc/passwd}$", "`*_**`")


@pytest.mark.parametrize("text", HOSTILE)
def test_the_report_takes_names_for_text(text: str) -> None:
    blocks = (
        text,
        document.Subheading(text),
        (text,),
        document.Callout("good", text, text),
        document.Table(text, text.replace(" | ", " "), ((text,),)),
    )
    hostile = document.Document(text, text, (document.Section(text, blocks),))
    body = render_page(hostile)
    for tag in ("<script>alert", "<img src=x"):
        assert tag not in body
    assert render_pdf([hostile]).startswith(b"%PDF")
