"""Symbolic regression of a residual: its expressions, and what it finds."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from sessions import fit_bare

from bampipe.declarations.files import effect_faults
from bampipe.diagnosis.drafts import symbolic
from bampipe.diagnosis.drafts.columns import FormDictionary
from bampipe.diagnosis.drafts.forms import list_quantities
from bampipe.diagnosis.drafts.search import FormSearch
from bampipe.estimate.low_pass import low_pass_at
from bampipe.files import toml_text


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The arm's yaw, the model fitted to it, and the same with a force that two axes shape."""
    session, spec, fit = fit_bare(tmp_path_factory.mktemp("arm"), "bam", 7, replicates=4)
    force = []
    for motion, fitted in zip(fit.linearisation.motions, fit.linearisation.fitted, strict=True):
        q = fitted.mechanism.q
        column = 1.2 * np.sin(6.0 * q[:, [0]] + 9.0 * q[:, [2]])
        band = fit.linearisation.band
        kept = band.thinned_rows(len(motion.t))
        force.append(low_pass_at(column, band.cutoff_hz[0], band.rate_hz, kept)[:, 0])
    like = fit.likelihood
    y = list(fit.problem.y)
    y[0] = y[0] + np.concatenate(force)[like.samples[0].rows] * like.root[0]
    return session, spec, replace(fit, problem=replace(fit.problem, y=tuple(y)))


def forms_of(fit):
    return FormDictionary(fit.linearisation, fit.likelihood.samples, 0)


@pytest.mark.parametrize(
    "text",
    [
        "(0.5 + (2.0 * ((-0.3) * X1)))",
        "((1.5 + (0.2 * X3)) * (X1 - (0.7 * sin((0.3 + (2.0 * X1))))))",
        "((-1.2) * (tanh(((0.5 * X1) * X2)) + (((0.4 * X3) - 0.8) ^ 2)))",
        "(exp((0.3 * X2)) * (abs(((-2.0) * X1)) * (X2 + (1.0 + X2))))",
    ],
)
def test_a_bred_expression_and_its_form_have_the_same_value(arm, text):
    _, spec, fit = arm
    names = ("position", "extension velocity", "direction")
    known = {q.words: q for q in list_quantities(spec.model().device, 0)}
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3))
    parts = symbolic._read(text, 3)
    form, at = symbolic.write_form(forms_of(fit), [known[n] for n in names], list(parts))
    ratio = dict(zip(names, x.T, strict=True))
    raw = np.empty((50, len(form.quantities)))
    for k, (quantity, span) in enumerate(form.quantities):
        middle = span.middle if quantity.quantity == "position" else 0.0
        reach = 1.0 if quantity.quantity == "direction" else 0.5 * span.width
        raw[:, k] = middle + reach * ratio[quantity.words]
    columns = form.shape.columns(raw, form.constants_at(at, 1.0))
    scope = {f"X{k + 1}": x[:, k] for k in range(3)}
    scope |= {name: getattr(np, name) for name in ("sin", "tanh", "exp", "abs")}
    wanted = eval(text.replace("^", "**"), {}, scope)
    assert columns @ list(parts.values()) == pytest.approx(wanted, rel=1e-4, abs=1e-4)


@pytest.mark.long
def test_what_two_axes_shape_is_found_by_symbolic_regression_alone(arm):
    pytest.importorskip("pyoperon")
    session, spec, fit = arm
    forms = forms_of(fit)
    symbolic.breed(forms, fit.problem)
    bred = FormSearch(session, fit, forms)
    best = bred.best_forms(6, 1)[0]
    grammar = forms_of(fit)
    grammar.add_grammar()
    structured = FormSearch(session, fit, grammar)
    gain = bred.cost(()) - bred.cost((best,))
    assert structured.largest_gain()[0] < 0.3 * gain
    scale = bred.solve((best,)).scale[0]
    assert scale < 0.05 * bred.solve(()).scale[0]
    form = forms.candidates[best[0]]
    text = toml_text(form.declaration("a test"))
    tried, faults = effect_faults(tomllib.loads(text), "formula", spec.model().device)
    assert form.canonical_name in tried
    assert faults == []
    again = forms_of(fit)
    symbolic.breed(again, fit.problem)
    assert list(again.starts.values()) == list(forms.starts.values())
