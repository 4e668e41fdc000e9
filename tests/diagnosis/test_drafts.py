"""Formulas drafted for what no effect explains, on sessions of the independent simulators."""

import json
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from independent_runs import record_trials
from made_results import diagnosis, write_result
from sessions import fit_bare

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.files import effect_faults
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Dictionary
from bampipe.diagnosis.drafts.columns import FormDictionary
from bampipe.diagnosis.drafts.search import (
    FormSearch,
    FoundDraft,
    Option,
    draft_formulas,
    weigh_chance,
)
from bampipe.diagnosis.session import candidates_of
from bampipe.errors import InputError, NothingToDoError
from bampipe.files import toml_text
from bampipe.physics import Model
from bampipe.physics.effect import effect_from
from bampipe.progress import silent
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import ChanceOfDraft, DraftResult
from bampipe.run.models import ensure_base
from bampipe.stages import draft as draft_stage
from bampipe.stages import identify
from bampipe.trials.samples import lay_out_samples


def open_forms(session, fit, axis, only=None):
    """A search over the forms of the grammar, or over those whose name holds a text."""
    forms = FormDictionary(fit.linearisation, fit.likelihood.samples, axis)
    forms.add_grammar()
    forms.candidates = {n: f for n, f in forms.candidates.items() if only is None or only in n}
    return FormSearch(session, fit, forms)


def write_diagnosis(root, axis, remains=True):
    """Write the diagnosis of an axis that lacks something unknown."""
    entry = {
        "verdict": "unknown_effect", "unknown": 0.99, "noise_floor": 0.1, "unit": "N.m",
        "standing": "above_floor", "remains": remains,
    }  # fmt: skip
    write_result(root, DiagnoseResult, model="base", **diagnosis({axis: entry}))


@pytest.fixture(scope="module")
def detent(tmp_path_factory):
    """A run of a joint with a magnet in it, diagnosed as unknown, and the draft for it."""
    root = tmp_path_factory.mktemp("detent")
    record_trials(root, "joint", 6, "detent:joint")
    run = RunFolder(root / "runs/joint")
    ensure_base(run.root, "", ())
    identify.execute(run, run.root, identify.Config(method="least-squares"), silent)
    write_diagnosis(run.root, "joint")
    draft_stage.execute(run, run.root, draft_stage.Config(replicates=6, jobs=1), silent)
    return run, run.read(DraftResult, "base")


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Trials of the arm that lack nothing."""
    return fit_bare(tmp_path_factory.mktemp("clean"), "bam", 6)


def test_the_draft_is_the_curve_that_was_hidden(detent):
    _, found = detent
    axis = found.axes["joint"]
    assert axis.verdict == "drafted"
    assert axis.chance[0].p_value <= 0.01
    assert axis.chance[0].gain > 100.0 * max(1.0, *axis.chance[0].gains)
    assert axis.rmse_after < 1.3 * axis.noise_floor < 0.3 * axis.rmse_before
    curve = found.effects[found.selected[0]].curve
    assert curve.variable == "position"
    # The magnet of benchmarks/independent/joint.py: 4 N.m at 0.3 rad, all within 15 %.
    mean, near = np.array(curve.mean), np.linspace(0.85, 1.15, 61)
    at, width = (v[:, :, None] for v in np.meshgrid(0.3 * near, 0.08 * near))
    u = (np.array(curve.at) - at) / width
    magnet = -u * np.exp(0.5 - 0.5 * u**2)
    height = np.clip(np.sum(magnet * mean, 2) / np.sum(magnet**2, 2), 0.85 * 4.0, 1.15 * 4.0)
    assert np.abs(height[:, :, None] * magnet - mean).max(2).min() < 0.02 * 4.0


def test_the_draft_is_the_most_probable_and_its_file_one_that_a_person_can_keep(detent):
    run, found = detent
    options = found.axes["joint"].options
    assert options[0].effects == () and options[0].constants == 0
    assert len(options) >= 3
    (best,) = (o for o in options if o.held_out_rmse == found.axes["joint"].rmse_after)
    assert best.log_evidence == max(o.log_evidence for o in options)
    (effect,) = found.effects.values()
    declaration = tomllib.loads((run.root / effect.file).read_text(encoding="utf-8"))
    device = draft_stage.load_model(run, "base").device
    tried, faults = effect_faults(declaration, effect.file, device)
    assert set(found.selected) <= set(tried)
    assert faults == []
    assert "drafted by bampipe from" in declaration["source"]
    model = Model(device, found.selected, [effect_from(declaration)])
    typical = {p.name.rpartition(".")[2]: p.typical for p in model.effects[0].parameters}
    for name, constant in effect.constants.items():
        assert typical[name] == pytest.approx(constant.value, rel=1e-5)
        assert constant.low < constant.value < constant.high


@pytest.mark.long
def test_the_same_trials_give_the_same_draft_in_several_processes(detent):
    run, _ = detent
    files = ["models/base/draft.json", "models/base/drafts/*.toml"]
    before = [p.read_bytes() for pattern in files for p in sorted(run.root.glob(pattern))]
    (run.root / files[0]).unlink()
    draft_stage.execute(run, run.root, draft_stage.Config(replicates=6, jobs=2), silent)
    assert [p.read_bytes() for pattern in files for p in sorted(run.root.glob(pattern))] == before


def test_nothing_is_drafted_where_nothing_is_missing(clean):
    session, spec, fit = clean
    (found,) = draft_formulas(session, spec, fit.linearisation.p, (1,), "a test")
    assert found.terms == ()
    assert found.chance[0].p_value > session.criteria.largest_p_value
    assert found.chosen is found.options[0] or len(found.options) == 1


def test_a_formula_in_what_is_measured_is_told_from_chance(clean):
    """What lacks nothing is as likely as the replicates; five times its size in one form is not."""
    session, _, fit = clean
    search = open_forms(session, fit, 1, "bump_by_position")
    assert weigh_chance(search).p_value > session.criteria.largest_p_value
    bump = search.atoms[search.grid_keys[0]].columns[1][:, 0] * fit.likelihood.root[1]
    y = list(fit.problem.y)
    y[1] = y[1] + 5.0 * bump / np.linalg.norm(bump) * np.linalg.norm(y[1])
    bumped = replace(fit, problem=replace(fit.problem, y=tuple(y)))
    chance = weigh_chance(FormSearch(session, bumped, search.forms))
    assert chance.p_value <= session.criteria.largest_p_value
    assert chance.gain > max(chance.gains)


@pytest.mark.long
def test_columns_of_forms_are_those_of_the_compiled_effects(clean, tmp_path):
    """Every shape and factor once: the grammar's text and its columns must say the same."""
    seen = set()
    for _, spec, fit in (clean, fit_bare(tmp_path, "damper", 6)):  # of which a coil is commanded
        linearisation = fit.linearisation
        samples = lay_out_samples(linearisation, Criteria().block_s)
        forms = FormDictionary(linearisation, samples, 0)
        forms.add_grammar()
        for name, form in forms.candidates.items():
            if (form.shape.name, form.factor) not in seen:
                seen.add((form.shape.name, form.factor))
                _hold_against_effect(spec, linearisation, samples, forms, name)


def _hold_against_effect(spec, linearisation, samples, forms, name):
    form = forms.candidates[name]
    searched = {
        constant: _between(low, high) * (2.0 if constant == "longer" else 1.0)
        for constant, (low, high, _) in form.limits().items()
    }
    atom = forms.make(forms.key(name, searched))
    effect = replace(spec, extra=(form.declaration("a test"),))
    item = candidates_of(effect, (form.canonical_name,))[0]
    short = [q.name.rpartition(".")[2] for q in item.parameters]
    no_ranges = SimpleNamespace(range_of=lambda effect, parameter: None)
    exact = Dictionary(linearisation, samples, {name: item}, no_ranges)
    values = np.array([searched[short[i]] for i in item.searched_indices])
    exact.values = lambda key: values
    wanted = exact.make((name, ()))
    columns = [list(form.shape.strengths).index(short[i]) for i in item.linear_indices]
    assert sorted(columns) == list(range(len(form.shape.strengths)))
    for axis, found in atom.columns.items():
        off = np.linalg.norm(found[:, columns] - wanted.columns[axis], axis=0)
        # Made at a lower rate: a sharp edge at a reversal costs several per cent.
        assert (off < 0.1 * np.linalg.norm(wanted.columns[axis], axis=0)).all(), form.canonical_name
    for axis, slope in wanted.slopes.items():
        scale = np.abs(slope).max()
        off = np.median(np.abs(atom.slopes[axis][:, :, columns] - slope))
        assert off < 0.05 * scale, form.canonical_name


def _between(low, high):
    return 0.5 * (low + high) if low <= 0.0 else float(np.sqrt(low * high))


def test_a_form_that_cancels_the_drive_gains_nothing(clean):
    """What is to be explained is no explanation: such a form leaves no slope by the force."""
    session, _, fit = clean
    search = open_forms(session, fit, 0, "friction_rise_by_load")
    (name,) = search.forms.candidates
    reach = search.forms.candidates[name].fixed_constants()["reach"][0]
    key = search.forms.key(name, {"place": 0.0})
    search.ensure([key])

    def volume(forms, place, strengths):
        return forms._volume(forms._log_slopes((place,), [strengths], np.ones(forms.n_q)))

    # A rise of this height from load zero is the load itself, against the motion.
    assert volume(search, key, np.array([-0.2 * reach]))[0] < -0.05 * search.problem.independent[0]
    assert volume(search, key, np.array([-reach])) is None
    own = open_forms(session, fit, 0, "slope_by_extension")
    at = own.grid_keys[0]
    assert volume(own, at, np.ones(own.atoms[at].width)) == pytest.approx(0.0)


@pytest.mark.long
def test_hysteresis_of_a_force_sensor_is_found(tmp_path):
    session, _, fit = fit_bare(tmp_path, "bam", 7, "sensor_hysteresis:x")
    search = open_forms(session, fit, 0)
    best, *others = search.best_forms(8, 1)
    form, gain = search.forms.candidates[best[0]], search.cost(()) - search.cost((best,))
    assert form.canonical_name in ("hysteresis_of_reading:x", "two_hystereses_of_reading:x")
    plain = next(k for k in (best, *others) if k[0] == "hysteresis_of_reading:x")
    assert search.cost(()) - search.cost((plain,)) > 0.95 * gain
    rest = [k for k in others if "hyst" not in k[0]]
    assert all(search.cost(()) - search.cost((k,)) < 0.4 * gain for k in rest)
    truth = json.loads((tmp_path / "bam.truth.json").read_text(encoding="utf-8"))
    hidden = truth["hidden_laws"]["sensor_hysteresis:x"]
    assert search.solve((plain,)).strengths[0][0] == pytest.approx(hidden["height"], rel=0.05)
    # By what is read, which is more than the force by the height where the width is reached.
    width = search.forms.values(plain)["width"]
    assert width == pytest.approx(sum(hidden.values()), rel=0.1)


def test_every_form_is_an_effect_file(clean):
    _, spec, fit = clean
    device = spec.model().device
    for axis in range(3):
        forms = FormDictionary(fit.linearisation, fit.likelihood.samples, axis)
        forms.add_grammar()
        for form in forms.candidates.values():
            text = toml_text(form.declaration("a test"))
            tried, faults = effect_faults(tomllib.loads(text), form.name, device)
            assert form.canonical_name in tried
            assert faults == []


def test_a_missing_library_is_named_where_one_quantity_did_not_do(detent):
    run, _ = detent
    diagnosed = run.read(DiagnoseResult, "base").axes["joint"]
    nothing = Option((), 0.5, 0.0, None, np.zeros(0))
    chance = ChanceOfDraft(gain=3.0, gains=(2.0, 3.0), p_value=0.6)
    found = FoundDraft(0, (), (chance,), 0.02, (nothing,), nothing, True)
    said = draft_stage._axis("joint", found, {}, diagnosed, []).sentence
    assert said.endswith("pip install 'bampipe[formulas]' brings pyoperon.")
    there = replace(found, wants_formulas=False)
    assert "pyoperon" not in draft_stage._axis("joint", there, {}, diagnosed, []).sentence


def test_what_is_missing_for_a_draft_is_said(tmp_path):
    run = RunFolder(tmp_path)
    with pytest.raises(InputError, match=r"diagnose\.json"):
        draft_stage.execute(run, tmp_path, draft_stage.Config(), silent)
    write_diagnosis(tmp_path, "joint", remains=False)
    with pytest.raises(NothingToDoError, match="explain all of the residual"):
        draft_stage.execute(run, tmp_path, draft_stage.Config(), silent)
