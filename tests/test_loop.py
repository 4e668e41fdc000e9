"""How a model version is made: what its parent was given counts for the child."""

from pathlib import Path

import pytest
from made_results import diagnosis, filled, write_model, write_result

from bampipe.api import loop
from bampipe.data.run_folder import RunFolder
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.ingest import IngestResult
from bampipe.results.run import RunResult
from bampipe.run import models, pipeline
from bampipe.run.events import ignore_event
from bampipe.run.request import Request


def test_a_child_is_identified_as_its_parent_was(tmp_path: Path) -> None:
    write_model(tmp_path, "base", device="slider")
    child = models.child_name("base", ("stribeck:carriage",))
    write_model(tmp_path, child, "stribeck:carriage", parent="base", device="slider")
    settings = {
        "identify:base": {"model": "base", "method": "least-squares"},
        "validate:base": {"model": "base", "seed": 3},
        "diagnose:base": {"model": "base", "seed": 2, "without": ["quadratic_drag:carriage"]},
        f"validate:{child}": {"model": child, "seed": 4},
    }
    hashes = {"key": "0" * 64, "code": "0" * 64}
    stages = {step: {**hashes, "settings": given} for step, given in settings.items()}
    write_result(tmp_path, RunResult, stages=stages)
    given = loop.settings_of(tmp_path, "base")
    assert given == {
        "identify": {"method": "least-squares"},
        "validate": {"seed": 3},
        "diagnose": {"seed": 2, "without": ["quadratic_drag:carriage"]},
    }
    # What came to nothing in the parent may count in the child.
    changed = {"validate": {"seed": 4}, "diagnose": {"seed": 2}}
    assert loop.settings_of(tmp_path, child) == {**given, **changed}


def test_following_judges_the_model_that_it_starts_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[str, ...]] = []
    content = {"axes": {"joint": {"verdict": "unknown_effect"}}}
    found = DiagnoseResult.model_validate(filled(DiagnoseResult, content))
    monkeypatch.setattr(loop.LoopOptions, "run", lambda _, *steps: ran.append(steps))
    monkeypatch.setattr(loop.RunFolder, "read", lambda *_: found)
    options = loop.LoopOptions(Request(tmp_path, pipeline.load()), ignore_event)
    lines: list[str] = []
    assert loop.follow(options, "base", lines.append) == "base"
    assert lines == ["base, joint: unknown effect"]
    assert ran[0] == ("identify", "validate", "base") and ran[-1] == ("compare", "compare", "")
    # A confirmation adds nothing to what is unknown: each further effect would only imitate it.
    content = diagnosis(content["axes"], {("quadratic_drag:joint",): 0.3})
    found = DiagnoseResult.model_validate(filled(DiagnoseResult, content))
    monkeypatch.setattr(loop, "_add", lambda _, model, *__: f"{model}+")
    assert found.selected and loop.follow(options, "base", lines.append) == "base+"


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (
            {("actuator_delay",): 0.56, ("actuator_lag:joint",): 0.44},
            "between actuator_delay (0.56) and actuator_lag:joint (0.44): actuator_delay added"
            " provisionally. A lag weakens",
        ),
        (
            {("a:joint", "b:joint"): 0.7, ("a:joint", "c:joint"): 0.296, (): 0.004},
            "between b:joint (0.70) and c:joint (0.30) beside a:joint (> 0.99): b:joint added"
            " provisionally. No trial was found",
        ),
        ({(): 0.6, ("a:joint",): 0.4}, "between something unknown (0.60) and a:joint (0.40): none"),
    ],
)
def test_an_effect_that_is_added_undecided_is_called_provisional(
    sets: dict[tuple[str, ...], float], said: str
) -> None:
    lines = {}
    for verdict in ("undecided", "missing"):
        content = diagnosis({"joint": {"verdict": verdict, "unknown": 0.6}}, sets)
        content["sets"][0] |= {"unknown": "" if content["selected"] else "joint"}
        found = DiagnoseResult.model_validate(filled(DiagnoseResult, content))
        lines[verdict] = list(loop._list_open_questions(found))
    assert lines["missing"] == []
    assert lines["undecided"][0].startswith(f"these trials do not decide {said}")


@pytest.mark.parametrize("fault", [ZeroDivisionError, KeyboardInterrupt])
def test_a_child_that_was_never_identified_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: type[BaseException]
) -> None:
    def run(_: loop.LoopOptions, first: str, last: str, model: str) -> None:
        if model != "base":
            assert (tmp_path / "models" / model / "model.toml").is_file()
            raise fault

    write_result(tmp_path, IngestResult, device="slider", axes={"carriage": {}})
    monkeypatch.setattr(loop.LoopOptions, "run", run)
    options = loop.LoopOptions(Request(tmp_path, pipeline.load()), ignore_event)
    with pytest.raises(fault):
        loop.extend(options, "base", ["stribeck:carriage"])
    assert RunFolder(tmp_path).models() == ("base",)


def test_identification_starts_where_the_diagnosis_ended_if_it_fitted_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted = {"stribeck.carriage.speed": 0.02, "force_delay.delay": 0.004}
    content = diagnosis({"carriage": {"verdict": "missing"}}, {("stribeck:carriage",): 1.0})
    write_result(tmp_path, IngestResult, device="slider", axes={"carriage": {}})
    write_result(tmp_path, DiagnoseResult, model="base", **content, fitted=fitted)
    monkeypatch.setattr(loop.LoopOptions, "run", lambda *_: None)
    options = loop.LoopOptions(Request(tmp_path, pipeline.load()), ignore_event)
    for effects, start in (
        (("stribeck:carriage",), {"stribeck.carriage.speed": 0.02}),
        (("stribeck:carriage", "quadratic_drag:carriage"), {}),
    ):
        assert models.read(tmp_path, loop.extend(options, "base", effects)).start == start


def test_what_came_to_nothing_is_not_weighed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next best is tried, and at last the diagnosis says what the loop has found."""
    ran: list[object] = []
    left = ["quadratic_drag:joint", "transmission_compliance:joint"]

    def run(_: loop.LoopOptions, first: str, last: str, model: str, changed: object = None) -> None:
        ran.extend([changed or None] if first == "diagnose" else [])

    def diagnosed(*_: object) -> DiagnoseResult:
        found, not_weighed = tuple(left[len(ran) - 1 : len(ran)]), left[: len(ran) - 1]
        axes = {"joint": {"verdict": "missing" if found else "nothing_missing"}}
        content = {**diagnosis(axes, {found: 1.0}), "not_weighed": not_weighed}
        return DiagnoseResult.model_validate(filled(DiagnoseResult, content))

    monkeypatch.setattr(loop.LoopOptions, "run", run)
    monkeypatch.setattr(loop.RunFolder, "read", diagnosed)
    monkeypatch.setattr(loop, "_add", lambda *_: "")
    lines: list[str] = []
    options = loop.LoopOptions(Request(tmp_path, pipeline.load()), ignore_event)
    assert loop.follow(options, "base", lines.append) == "base"
    assert lines == [
        *(f"base, joint: missing {name} (> 0.99)" for name in left),
        "base, joint: nothing missing",
    ]
    assert ran == [None, *({"diagnose": {"without": tuple(left[:k])}} for k in (1, 2))]


def test_the_device_file_gives_the_base_model_its_effects(tmp_path: Path) -> None:
    effects = ["stribeck:carriage"]
    write_result(tmp_path, IngestResult, device="axis", axes={"x": {}}, default_effects=effects)
    models.ensure_base(tmp_path, "", ())
    assert models.read(tmp_path, "base").effects == ("stribeck:carriage",)
    models.ensure_base(tmp_path, "", ("return_spring:carriage",))
    assert models.read(tmp_path, "base").effects == ("return_spring:carriage",)
