"""Formulas drafted for what no effect explains, on sessions of the independent simulators."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from independent_runs import diagnose, error_over_floor, record_run, record_trials

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.files import effect_faults
from bampipe.declarations.model_file import load_model
from bampipe.diagnosis.session import candidates_of, system_of
from bampipe.diagnosis.drafts.effect_file import write_toml
from bampipe.diagnosis.drafts.screen import Screen
from bampipe.diagnosis.drafts.search import FoundDraft, Option, draft
from bampipe.diagnosis.scorer import Scorer
from bampipe.diagnosis.settings import Settings
from bampipe.errors import InputError, NothingToDoError
from bampipe.physics import Model, compile_model
from bampipe.physics.effect import effect_from
from bampipe.progress import silent
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import ChanceOfDraft
from bampipe.stages import draft as draft_stage

FEW = Settings(draft_replicates=4, jobs=1)


@pytest.fixture(scope="module")
def detent(tmp_path_factory):
    """A run of a joint with a magnet in it, diagnosed as unknown, and the draft for it."""
    run, _ = record_run(tmp_path_factory.mktemp("detent"), "joint", 6, "detent:joint")
    unknown = diagnose(run)["axes"]["joint"]
    assert unknown["verdict"] == "unknown_effect"
    assert error_over_floor(unknown) > 3.0
    assert "position" in unknown["sentence"]
    return run, bampipe.draft(run, replicates=4, jobs=1)


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Trials of the arm that lack nothing, and the fit of the bare device."""
    trials, recipe, _ = record_trials(tmp_path_factory.mktemp("clean"), "bam", 6)
    start = system_of(recipe).prior
    return trials, recipe, fit_trials(trials, recipe, start)


@pytest.fixture(scope="module")
def damper(tmp_path_factory):
    """The bare device and its fit to trials in which a coil is commanded."""
    trials, recipe, _ = record_trials(tmp_path_factory.mktemp("damper"), "damper", 6)
    return recipe, fit_trials(trials, recipe, system_of(recipe).prior)


def test_the_draft_is_the_curve_that_was_hidden(detent):
    _, found = detent
    axis = found["axes"]["joint"]
    assert axis["verdict"] == "drafted"
    assert axis["chance"][0]["p_value"] < 1e-4
    (name,) = found["selected"]
    curve = found["effects"][name]["curve"]
    assert curve["variable"] == "position"
    # The magnet of benchmarks/independent/joint.py: 4 N.m at 0.3 rad, all within 15 %.
    found, near = np.array(curve["mean"]), np.linspace(0.85, 1.15, 61)
    at, width = (v[:, :, None] for v in np.meshgrid(0.3 * near, 0.08 * near))
    u = (np.array(curve["at"]) - at) / width
    magnet = -u * np.exp(0.5 - 0.5 * u**2)
    height = np.clip(np.sum(magnet * found, 2) / np.sum(magnet**2, 2), 0.85 * 4.0, 1.15 * 4.0)
    assert np.abs(height[:, :, None] * magnet - found).max(2).min() < 0.02 * 4.0


def test_the_draft_brings_the_error_to_the_floor(detent):
    run, found = detent
    longer = bampipe.extend(run, found["selected"][0])
    rung = longer.ladder.loc[longer.model]
    assert longer.model != "base"
    assert rung["held_out_rmse.joint"] < 1.3 * rung["noise_floor.joint"]
    assert found["axes"]["joint"]["rmse_after"] == pytest.approx(
        rung["held_out_rmse.joint"], rel=0.05
    )


def test_the_effects_of_the_library_that_come_nearest_leave_more(detent):
    _, found = detent
    nearest = found["axes"]["joint"]["nearest"]
    assert nearest
    assert all(n["held_out_rmse"] > 3.0 * found["axes"]["joint"]["rmse_after"] for n in nearest)


def test_the_file_is_an_effect_file_that_a_person_can_keep(detent):
    run, found = detent
    (effect,) = found["effects"].values()
    text = (run.root / effect["file"]).read_text(encoding="utf-8")
    declaration = tomllib.loads(text)
    device = load_model(RunFolder(run.root), "base").device
    tried, faults = effect_faults(declaration, effect["file"], device)
    assert set(found["selected"]) <= set(tried)
    assert faults == []
    assert "drafted by bampipe from" in declaration["source"]
    model = Model(device, found["selected"], [effect_from(declaration)])
    typical = {p.name.rpartition(".")[2]: p.typical for p in model.effects[0].parameters}
    for name, constant in effect["constants"].items():
        assert typical[name] == pytest.approx(constant["value"], rel=1e-5)
        assert constant["low"] < constant["value"] < constant["high"]


def test_the_same_trials_give_the_same_draft(detent):
    run, _ = detent
    files = ["models/base/draft.json", "models/base/drafts/*.toml"]
    before = [p.read_bytes() for pattern in files for p in sorted(run.root.glob(pattern))]
    (run.root / files[0]).unlink()
    bampipe.draft(run, "base", replicates=4, jobs=2)
    assert [p.read_bytes() for pattern in files for p in sorted(run.root.glob(pattern))] == before


def test_nothing_is_drafted_where_nothing_is_missing(clean):
    trials, recipe, evidence = clean
    (found,) = draft(trials, recipe, evidence.p, (1,), FEW, "a test")
    assert found.terms == ()
    assert found.chance[0].p_value > 0.05


@pytest.mark.long
def test_columns_of_the_first_pass_are_those_of_the_compiled_effect(clean, damper):
    """Every shape and factor once: the grammar's text and its columns must say the same."""
    seen = set()
    for recipe, evidence in (clean[1:], damper):
        screen = Screen(evidence, 0)
        for form in screen.forms():
            if (form.shape.name, form.factor) not in seen:
                seen.add((form.shape.name, form.factor))
                _hold_columns_against_effect(recipe, evidence, screen, form)


def _hold_columns_against_effect(recipe, evidence, screen, form):
    declaration = form.declaration("a test")
    wider = replace(recipe, extra=(declaration,))
    item = candidates_of(wider, (form.canonical,))[0]
    searched = {
        name: np.array([_between(low, high) * (2.0 if name == "longer" else 1.0)])
        for name, (low, high, _) in form.limits().items()
    }
    columns = screen.signals.columns(form, searched)[:, :, 0]
    names = [p.name.rpartition(".")[2] for p in item.parameters]
    for strength, column in zip(form.shape.strengths, columns, strict=True):
        p = np.concatenate([evidence.p, [q.prior for q in item.parameters]])
        for name, value in searched.items():
            p[len(evidence.p) + names.index(name)] = value[0]
        p[len(evidence.p) + names.index(strength)] = 1.0
        exact = np.concatenate([
            _low_passed(evidence, item.system, k, p)[evidence.used[k][:, 0]]
            for k in range(len(evidence.motions))
        ])  # fmt: skip
        off = np.linalg.norm(column - exact) / np.linalg.norm(exact)
        # Made at a lower rate: a sharp edge at a reversal costs several per cent.
        assert off < 0.1, (form.canonical, strength)


def _between(low, high):
    return 0.5 * (low + high) if low <= 0.0 else float(np.sqrt(low * high))


def _low_passed(evidence, system, trial, p):
    motion = evidence.motions[trial]
    u = motion.inputs(system.inputs)
    z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
    whole = system.contribution(motion.q, motion.qd, motion.qdd, z, u, p)
    return evidence.band.thin(whole)[:, 0]


def test_a_form_that_cancels_the_drive_gains_nothing(clean, damper):
    """As the score of an effect has it: what is to be explained is no explanation."""
    for recipe, evidence in (clean[1:], damper):
        screen = Screen(evidence, 0)
        forms = [f for f in screen.forms() if f.coordinate.quantity == "load"]
        assert {f.shape.name for f in forms} == {"parabola", "rise"}
        for form in forms:
            place = {name: 0.0 for name in form.shape.searched}
            constants = {n: v for n, (v, _) in form.fixed().items()}
            for share in (-0.2, -1.0):
                # A rise of this height from load zero is the load itself, against the motion.
                values = {n: share * constants["reach"] for n in form.shape.strengths} | place
                wider = replace(recipe, extra=(form.declaration("a test"),))
                item = candidates_of(wider, (form.canonical,))[0]
                p = [values.get(q.name.rpartition(".")[2], q.prior) for q in item.parameters]
                exact = Scorer(evidence)._sensitivity(item, np.array(p))[0]
                assert screen.signals.drive_slope(form, values) == pytest.approx(
                    exact, rel=0.05, abs=0.05
                )
            if form.shape.name == "rise":
                assert screen.signals.drive_slope(form, values) < -1.0
    for name in ("parabola_by_position", "slope_by_position"):
        form = next(f for f in screen.forms() if f.name.endswith(name))
        assert screen.signals.drive_slope(form, dict.fromkeys(form.shape.strengths, 1.0)) == 0.0


def test_hysteresis_of_a_force_sensor_is_found(tmp_path):
    trials, recipe, _ = record_trials(tmp_path, "bam", 7, "sensor_hysteresis:x")
    evidence = fit_trials(trials, recipe, system_of(recipe).prior)
    one, two, *others = sorted(
        Screen(evidence, 0).search()[:8], key=lambda found: "hyst" not in found.form.name
    )
    best = min(one, two, key=lambda found: found.form.constants)
    assert best.form.canonical == "hysteresis_of_reading:x"
    assert best.gain > 0.97 * max(one.gain, two.gain)
    assert all(other.gain < 0.3 * best.gain for other in others)
    truth = json.loads((tmp_path / "bam.truth.json").read_text(encoding="utf-8"))
    hidden = truth["hidden_laws"]["sensor_hysteresis:x"]
    assert best.values["height"] == pytest.approx(hidden["height"], rel=0.03)
    # By what is read, which is more than the force by the height where the width is reached.
    assert best.values["width"] == pytest.approx(sum(hidden.values()), rel=0.1)


def test_every_form_is_an_effect_file(clean):
    _, recipe, evidence = clean
    device = recipe.model().device
    for axis in range(3):
        for form in Screen(evidence, axis).forms():
            text = write_toml(form.declaration("a test"))
            tried, faults = effect_faults(tomllib.loads(text), form.name, device)
            assert form.canonical in tried
            assert faults == []


def test_a_missing_library_is_named_where_one_quantity_did_not_do(detent):
    run, _ = detent
    folder = RunFolder(run.root)
    system = compile_model(load_model(folder, "base"))
    nothing = Option((), 0, np.array([0.5, 0.1, 0.1]), np.ones(3))
    chance = ChanceOfDraft(gain=3.0, gains=(2.0, 3.0, 4.0, 5.0), p_value=0.6)
    found = FoundDraft(
        0, (), (chance,), 0.02, (nothing,), 0.5, 0.5, None, True, None, None
    )  # fmt: skip
    diagnosis = folder.read(DiagnoseResult, "base")
    said = draft_stage._axis(found, {}, diagnosis, system).sentence
    assert said.endswith("pip install 'bampipe[formulas]' brings pyoperon.")
    there = replace(found, wants_formulas=False)
    assert "pyoperon" not in draft_stage._axis(there, {}, diagnosis, system).sentence


def test_what_is_missing_for_a_draft_is_said(tmp_path, detent):
    done, _ = detent
    shutil.copytree(done.root, tmp_path / "run")
    run = RunFolder(tmp_path / "run")
    path = run.path(DiagnoseResult.file("base"))
    known = path.read_text(encoding="utf-8")
    path.write_text(known.replace('"remains": true', '"remains": false'), encoding="utf-8")
    with pytest.raises(NothingToDoError, match="leaves nothing unnamed"):
        draft_stage.execute(run, tmp_path, draft_stage.Config(), silent)
    path.unlink()
    with pytest.raises(InputError, match=r"diagnose\.json is missing"):
        draft_stage.execute(run, tmp_path, draft_stage.Config(), silent)
