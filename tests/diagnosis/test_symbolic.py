"""Symbolic regression of a residual: its expressions, and what it finds."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from independent_runs import record_trials

from bampipe.declarations.files import effect_faults
from bampipe.diagnosis.session import system_of
from bampipe.diagnosis.drafts import symbolic
from bampipe.diagnosis.drafts.effect_file import write_toml
from bampipe.diagnosis.drafts.screen import Screen


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A screen of the arm's yaw, with a force that two of its axes shape put into the residual."""
    trials, recipe, _ = record_trials(tmp_path_factory.mktemp("arm"), "bam", 7)
    evidence = fit_trials(trials, recipe, system_of(recipe).prior)
    residual = []
    for k, motion in enumerate(evidence.motions):
        force = np.zeros_like(motion.q)
        force[:, 0] = 1.2 * np.sin(6.0 * motion.q[:, 0] + 9.0 * motion.q[:, 2])
        residual.append(evidence.residual[k] + evidence.band.thin(force) * evidence.used[k])
    return recipe, Screen(evidence, 0), Screen(replace(evidence, residual=tuple(residual)), 0)


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
    _, screen, _ = arm
    device = screen.signals.device
    names = ("position", "extension velocity", "direction")
    known = [q for q in symbolic.coordinates(device, 0) if q.words in names]
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3))
    bred = symbolic._sums(text)[-1]
    form, at = symbolic._form(screen, known, bred)
    raw = np.empty((50, len(form.quantities)))
    ratio = dict(zip([q.words for q in known], x.T, strict=True))
    for k, (quantity, span) in enumerate(form.quantities):
        middle = span.middle if quantity.quantity == "position" else 0.0
        reach = 1.0 if quantity.quantity == "direction" else 0.5 * span.width
        raw[:, k] = middle + reach * ratio[quantity.words]
    constants = {n: v for n, (v, _) in form.fixed().items()} | at
    columns = np.column_stack(
        [np.broadcast_to(c, (50, 1)) for c in form.shape.columns(raw, constants)]
    )
    strengths = [c for c, _ in bred.parts] + [bred.constant] * bool(bred.constant)
    scope = {f"X{k + 1}": x[:, k] for k in range(3)}
    scope |= {name: getattr(np, name) for name in ("sin", "tanh", "exp", "abs")}
    wanted = eval(text.replace("^", "**"), {}, scope)
    assert columns @ strengths == pytest.approx(wanted, rel=1e-5, abs=1e-5)


@pytest.mark.long
def test_what_two_axes_shape_is_found_by_symbolic_regression_alone(arm, monkeypatch):
    pytest.importorskip("pyoperon")
    recipe, clean, screen = arm
    monkeypatch.setattr(symbolic, "_ROUNDS", 2)
    best = symbolic.search(screen)[0]
    left = np.sum(screen.fit.left**2) / np.sum(clean.fit.left**2)
    possible = 0.5 * screen.fit.independent * np.log(left)
    assert best.gain > 0.95 * possible
    assert screen.search()[0].gain < 0.3 * possible
    declaration = best.form.declaration("a test")
    text = write_toml(declaration)
    device = recipe.model().device
    tried, faults = effect_faults(tomllib.loads(text), "formula", device)
    assert best.form.canonical in tried
    assert faults == []
    monkeypatch.setattr(symbolic, "_ROUNDS", 1)
    x = np.column_stack(
        [screen.signals.thinned("position"), screen.signals.thinned("extension position")]
    )
    assert symbolic._bred(screen, x) == symbolic._bred(screen, x)
