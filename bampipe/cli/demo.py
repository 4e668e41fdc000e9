"""``bampipe demo``: the whole loop on the session that ships for it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bampipe.api.loop import LoopOptions, follow
from bampipe.cli import places
from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.results.compare import CompareResult
from bampipe.results.truth import TruthResult
from bampipe.results.validate import ValidateResult
from bampipe.run import models, pipeline
from bampipe.run.events import Listener
from bampipe.run.request import Request
from bampipe.run.runner import run_session
from bampipe.run.session_name import session_id


def demonstrate(runs: Path, force: bool, listen: Listener, tell: Callable[[str], None]) -> None:
    """Run the whole loop on the session that ships for it; ``tell``: called with each line."""
    samples = pipeline.find_shipped("sample_runs")
    if not samples.is_dir():
        raise InputError("this installation has no sample sessions", where=str(samples))
    session = samples / "demo"
    root = runs / session_id(session)
    chosen = pipeline.load()
    tell(f"1. {session}: an arm with a fault that its model lacks.")
    request = Request(root, chosen, force=force)
    run_session(replace(request, session=session, judge=True), listen)
    for axis, error in RunFolder(root).read(ValidateResult, models.BASE).axes.items():
        tell(
            f"   {axis}: error on unseen trials {error.held_out_rmse:.3g} {error.unit}, "
            f"sensor noise alone would leave {error.noise_floor:.3g} {error.unit}"
        )
    tell("2. Which effect is missing? Diagnose and extend the model until nothing is missing.")
    options = LoopOptions(replace(request, pipeline=chosen.with_every_stage()), listen)
    last = follow(options, models.BASE, lambda line: tell(f"   {line}"))
    tell("3. The error on unseen trials, model by model.")
    for rung in RunFolder(root).read(CompareResult).ladder:
        errors = ", ".join(
            f"{axis} {value:.3g} (floor {rung.noise_floor[axis]:.3g})"
            for axis, value in sorted(rung.held_out_rmse.items())
        )
        tell(f"   {rung.model}: {errors}")
    options.run("report", "report", "")
    truth = TruthResult.read(samples / "demo.truth.json")
    hidden = ", ".join(truth.configuration["effects"])
    found = ", ".join(models.read(root, last).effects) or "nothing"
    tell(f"4. Found: {found}. What was hidden: {hidden}.")
    tell(f"   In print: {root}/report/report.pdf")
    tell(f"next: bampipe report {places.next_to(root, runs)} --open")
