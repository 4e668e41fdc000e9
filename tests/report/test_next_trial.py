"""The section on what to record next, and the protocol sheet."""

import re
from types import SimpleNamespace

import pytest
from made_results import filled

from bampipe.report import protocol
from bampipe.report.document import Callout, Table
from bampipe.report.protocol import protocol_sheet
from bampipe.report.sections import diagnosis, next_trial
from bampipe.results.next import ExpectedSd, NextResult, Plan

SENTENCE = "Move yaw slowly back and forth between −23° and 23°, for 20 s."
SD = {"before": 0.01, "after": 0.005, "low": 0.0042, "high": 0.006, "unit": "N.m"}
FOUND = filled(
    NextResult,
    {
        "purpose": "sensitivity",
        "sentence": SENTENCE,
        "why": "These trials would not have shown stribeck:yaw below 2 N.m.",
        "proposals": [{"sd": {"coulomb.yaw": SD}}],
        "sensitivity": {
            "stribeck:yaw": {
                "parameter": "stribeck.yaw.force", "smallest": 2.0, "unit": "N.m", "axis": "yaw",
                "with_proposal": 0.5,
            },
            "force_bias:x": {
                "parameter": "force_bias.x.bias", "smallest": None, "unit": "N", "axis": "",
            },
        },
    },
)  # fmt: skip


def results_with(found: NextResult | None) -> SimpleNamespace:
    return SimpleNamespace(
        read=lambda kind, model="": found if kind is NextResult else None,
        root=SimpleNamespace(name="s01"),
        models=("base",),
    )


def test_the_section_says_what_to_do_where_somebody_asked():
    assert not [*next_trial.list_blocks(results_with(None))]
    blocks = [*next_trial.list_blocks(results_with(NextResult.model_validate(FOUND)))]
    first = blocks[0]
    assert isinstance(first, Callout)
    assert first.text == SENTENCE
    sd, sensitivity = (one for one in blocks if isinstance(one, Table) and one.rows)
    assert sd.rows == (("`coulomb.yaw`", "0.010", "0.0050", "N·m"),)
    assert not sd.note
    # What no trial shows stands first, with a dash.
    assert [row[0] for row in sensitivity.rows] == ["`force_bias:x`", "`stribeck:yaw`"]
    assert sensitivity.rows[0][1:4:2] == ("–", "–")
    assert sensitivity.rows[1][3:6] == ("2.0", "0.50", "1.0")
    asked = diagnosis._tell_sensitivity(results_with(NextResult.model_validate(FOUND)), "base")
    assert asked == (
        "These trials would not have shown stribeck:yaw below 2 N.m. The table under What to record"
        " next lists every effect."
    )
    without = diagnosis._tell_sensitivity(results_with(None), "base")
    assert "`bampipe next s01` computes" in without
    entry = ExpectedSd.model_validate(SD | {"low": 0.002, "high": 0.009})
    table = next_trial.tabulate_sds("Expected", {"coulomb.yaw": entry})
    assert table.rows == (("`coulomb.yaw`", "0.010", "0.0020 to 0.0090", "N·m"),)
    assert "eight of ten" in table.note


def made_plan(trials: int = 1, sentence: str = SENTENCE, parameters: int = 1) -> Plan:
    content = {
        "sentence": "With 3 trials, 60 s in all, what is asked is expected to be reached.",
        "trials": [{"sentence": sentence, "times": 3}] * trials,
        "sd": {
            f"coulomb.joint_{k}": SD | {"asked": 0.005, "after": 0.004 + k}
            for k in range(parameters)
        },
    }
    return Plan.model_validate(filled(Plan, content))


@pytest.mark.parametrize(("trials", "parameters"), [(0, 70), (1, 70), (8, 8), (8, 70)])
def test_the_protocol_sheet_is_one_page(trials, parameters):
    axes = [f"joint_{k} between −240° and 9° (−4.19 to 0.16 rad) at up to 410°/s" for k in range(7)]
    plan = made_plan(trials, f"Move them as in t01, {', '.join(axes)}, for 20 s.", parameters)
    sheet = protocol_sheet(plan, "s01", "base", by_hand=False)
    assert len(re.findall(rb"/Type\s*/Page\b", sheet)) == 1


def test_a_sheet_lists_the_parameters_that_stay_farthest_from_what_is_asked():
    table = protocol._tabulate_uncertainties(made_plan(parameters=20), "base", 3)
    assert [row[0] for row in table.rows] == [f"`coulomb.joint_{k}`" for k in (17, 18, 19)]
    assert "Of 20 parameters" in table.note


def test_the_protocol_sheet_is_the_same_pdf_again():
    plan = made_plan()
    sheet = protocol_sheet(plan, "s01", "base", by_hand=True)
    assert sheet.startswith(b"%PDF")
    assert sheet == protocol_sheet(plan, "s01", "base", by_hand=True)
    # A machine without a handle is not asked to let go of it.
    assert sheet != protocol_sheet(plan, "s01", "base", by_hand=False)
