"""What `bampipe run` says of its steps beneath their table."""

from types import SimpleNamespace
from typing import Any

import pytest

from bampipe.cli import show
from bampipe.results.identify import EffectEstimate


def step(name: str, **summary: Any) -> Any:
    return SimpleNamespace(step=name, state="done", seconds=1.0, summary=summary)


def test_notes_of_the_logs_and_a_second_that_stands_out_are_said(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found: Any = SimpleNamespace(
        steps=[
            step("ingest", notes=["a force in counts"]),
            step("filter", notes=["t02: not used: 20 sound samples"]),
            step("identify:base", notes=["in the report"], influence={
                "worst_second": {"sentence": "The second from 5.1 s of trial t02 on moves `mass`."}
            }),
            step("identify:more", influence={"worst_second": {"sentence": ""}}),
        ],
        verdicts=[], model="",
    )  # fmt: skip
    show.print_outcome(found)
    printed = capsys.readouterr()
    notes = [line for line in (printed.out + printed.err).splitlines() if line.startswith("note:")]
    assert notes == [
        "note: a force in counts",
        "note: t02: not used: 20 sound samples",
        "note: The second from 5.1 s of trial t02 on moves `mass`.",
    ]


def test_an_effect_that_is_not_identified_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    why = "`stribeck.joint.force` is 18 \u00b1 46 N.m, an interval larger than itself"
    show.print_unidentified(
        {
            "play:joint": EffectEstimate(identified=True),
            "stribeck:joint": EffectEstimate(identified=False, reasons=(why,)),
        }
    )
    said = f"note: `stribeck:joint` does not count as identified: {why}.\n"
    assert capsys.readouterr().out == said
