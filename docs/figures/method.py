"""Figures of the three method pages, of one simulated session of a joint with two hidden effects.

    python docs/figures/method.py

The joint is that of benchmarks/independent, whose friction truly stops it.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate, read_spec
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.search import Search
from bampipe.diagnosis.select import Selection, open_search, select_effects
from bampipe.diagnosis.session import Session, system_of
from bampipe.results.identify import IdentifyResult
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.samples import take_samples

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "benchmarks"))
from independent import record  # noqa: E402
from independent.sensors import Conditions  # noqa: E402

SEED, HIDDEN = 31, {"stribeck:joint": 0.4, "return_spring:joint": 0.3}
CLEAN = Conditions(trials=4, seconds=10.0)
PIPELINE = """schema = "bampipe.pipeline/1"
name = "figures"
stages = ["ingest", "filter", "identify", "validate"]
"""
plt.rcParams |= {
    "font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "bampipe"
}  # fmt: skip


def identify(folder: Path, hidden: dict[str, float]) -> tuple[bampipe.Run, dict[str, float]]:
    """Record a session and identify the bare model; the run, and the true parameters."""
    folder.mkdir()
    truth = record("joint", folder / "joint", SEED, hidden, CLEAN)
    (folder / "figures.toml").write_text(PIPELINE)
    run = bampipe.run_session(
        folder / "joint", runs=folder / "runs", pipeline=str(folder / "figures.toml")
    )
    return run, truth["parameters"]


def select(run: bampipe.Run) -> tuple[Selection, Search, Session]:
    """The selection of effects, with a search beside the model as given."""
    folder = RunFolder(run.root)
    spec = read_spec(folder, "base", load_model(folder, "base"))
    system, timing = system_of(spec), folder.read(IdentifyResult, "base").input_timing
    trials = read_measured_trials(folder, system, every_input=True, timing=timing)
    session = Session(replace(trials, motions=tuple(trials.motions)), Criteria())
    found = select_effects(session, spec, read_estimate(folder, "base", system))
    with open_search(session, found.initial) as search:
        return found, search, session


def draw_residual(found: Selection) -> None:
    """The residual of the final model around a reversal beside its biases; scatter by speed."""
    fit = found.final
    e, noise, here = fit.linearisation, fit.likelihood.noise, fit.likelihood.samples[0]
    y = take_samples(e.residual, here, 0)
    speed = take_samples([m.qd[e.band.thinned_rows(len(m.t))] for m in e.motions], here, 0)
    step = e.band.step / e.band.rate_hz
    inside = here.trial == 0
    t = (here.rows[inside] - here.rows[inside][0]) * step
    centre = t[np.argmax(np.abs(noise.stopping[0][inside]))]
    shown = np.abs(t - centre) < 1.5
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.6), layout="constrained")
    curves = {
        "measured residual y": (y, "0.6", 2.5),
        "mean of replicates b": (noise.bias[0], "C0", 1.0),
        "fitted bias β b + γ c": (fit.bias[0], "C3", 1.2),
        "replicate that truly stops c": (noise.stopping[0], "black", 0.5),
    }
    for label, (values, colour, width) in curves.items():
        left.plot(t[shown], values[inside][shown], color=colour, lw=width, label=label)
    left.set(xlabel="time, s", ylabel="residual, N.m")
    left.legend(frameon=False, fontsize=6.5)
    scatter = noise.residuals[0].std(axis=0, ddof=1)
    right.loglog(
        np.abs(speed), scatter, ".", ms=1.5, color="0.7", label="each sample", rasterized=True
    )
    order = np.argsort(np.abs(speed))
    right.loglog(
        np.abs(speed)[order], np.sqrt(noise.variance[0])[order], color="C0", label="√v, by class"
    )
    right.set(xlabel="speed, rad/s", ylabel="scatter of replicates, N.m", xlim=(1e-3, None))
    right.legend(frameon=False)
    figure.savefig(HERE / "method_residual.svg", metadata={"Date": None})


def draw_estimates(run: bampipe.Run, truth: dict[str, float]) -> None:
    """Errors of each method in published standard deviations, with and without the bias."""
    found = RunFolder(run.root).read(IdentifyResult, "base")
    names = [name for name in found.parameters if name in truth]
    figure, panel = plt.subplots(figsize=(7.2, 0.6 + 0.45 * len(names)), layout="constrained")
    for row, name in enumerate(names):
        p = found.parameters[name]
        for k, (method, tried) in enumerate(found.methods.items()):
            if name in tried.parameters:
                one = tried.parameters[name]
                x, sd = (one.estimate - truth[name]) / p.sd, one.sd / p.sd
                label = f"{method.replace('_', ' ')}" if row == 0 else None
                panel.errorbar(x, row + 0.18 * k, xerr=1.96 * sd, fmt="o", ms=3, lw=1,
                               color=f"C{k}", label=label)  # fmt: skip
                if method == "least-squares" and p.least_squares_bias is not None:
                    panel.plot(
                        x + p.least_squares_bias / p.sd, row + 0.18 * k, "x", color=f"C{k}",
                        label="least squares, bias left in" if row == 0 else None,
                    )  # fmt: skip
    panel.axvline(0.0, color="0.6", lw=0.8)
    panel.set(yticks=range(len(names)), yticklabels=names)
    panel.set_xlabel("error, in published standard deviations; bars: 95 %")
    panel.legend(frameon=False, fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(HERE / "method_estimation.svg", metadata={"Date": None})


def draw_selection(found: Selection, search: Search) -> None:
    """Gain of each effect alone, and as the set grows, beside what chance gives."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.8), layout="constrained")
    gains = sorted(found.gains.items(), key=lambda pair: pair[1])[-10:]
    colours = ["C3" if name in HIDDEN else "0.7" for name, _ in gains]
    left.barh([name for name, _ in gains], [gain for _, gain in gains], color=colours)
    left.set(xlabel="gain of one effect beside the bare model, nats")
    left.tick_params(axis="y", labelsize=6.5)
    sizes, best = [0], [0.0]
    for beam in search.grow_sets(4):
        sizes.append(len(sizes))
        best.append(search.cost(()) - beam[0][0])
    right.plot(sizes, best, "o-", color="C0", ms=3, label="best set of so many effects")
    level = best[len(found.effects)]
    low, high = level + min(found.replicate_gains), level + max(found.replicate_gains)
    right.axhspan(low, high, color="C1", alpha=0.4, lw=0,
                  label="one more effect, on replicates")  # fmt: skip
    right.plot(len(found.effects) + 1, level + found.largest_gain[0], "s", ms=4, color="C3",
               label="one more effect, measured")  # fmt: skip
    right.set(xlabel="effects in the set", ylabel="log evidence, nats", xticks=sizes)
    right.legend(frameon=False, fontsize=6.5)
    figure.savefig(HERE / "method_selection.svg", metadata={"Date": None})
    print("largest gains of replicates, nats:", np.round(found.replicate_gains, 1))


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        run, _ = identify(Path(name) / "hidden", HIDDEN)
        found, search, _ = select(run)
        draw_residual(found)
        draw_selection(found, search)
        run, truth = identify(Path(name) / "clean", {})
        draw_estimates(run, truth)


if __name__ == "__main__":
    main()
