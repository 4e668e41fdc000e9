"""The stages as functions, which share the cache of the command line."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from bampipe.api import loop
from bampipe.api.opened import Run, open_run
from bampipe.run import batch, runner
from bampipe.run import pipeline as pipelines
from bampipe.run.events import ignore_event
from bampipe.run.request import Request
from bampipe.run.session_name import session_folder, session_id

Path_ = str | Path
RUNS = "runs"


def run_session(
    session: Path_,
    *,
    runs: Path_ = RUNS,
    pipeline: str = "default",
    first: str = "",
    last: str = "",
    force: bool = False,
    settings: Mapping[str, Mapping[str, object]] | None = None,
) -> Run:
    """Run the stages of a pipeline whose inputs changed, from raw log to report.

    Args:
        session: folder of the session; runs: folder of the run folders.
        pipeline: name or file of a pipeline.
        first, last: stages to start from and to stop after; empty for all.
        force: whether to run unchanged stages, too.
        settings: by stage, then by name: ``{"identify": {"method": "least-squares"}}``.

    Raises:
        InputError: bad input; earlier results stay as they were.
    """
    batch.limit_threads(1)
    folder = session_folder(session)
    root = Path(runs) / session_id(folder)
    runner.run_session(
        Request(
            root=root,
            pipeline=pipelines.load(pipeline),
            session=folder,
            settings={stage: values for stage, values in (settings or {}).items() if values},
            first=first,
            last=last,
            force=force,
            judge=True,
        ),
        ignore_event,
    )
    return Run(root)


def ingest(session: Path_, *, runs: Path_ = RUNS, **settings: object) -> Run:
    """Read a session's raw logs into SI units.

    Raises:
        InputError: the session file has a mistake, or no trial is sound.
    """
    return run_session(session, runs=runs, last="ingest", settings={"ingest": settings})


def filter(run: Run | Path_, **settings: object) -> pd.DataFrame:
    """Differentiate the motion; returns `Run.kinematics`."""
    return _run_stage(run, "filter", "", settings)[0].kinematics


def stiffness(run: Run | Path_, **settings: object) -> pd.DataFrame:
    """Estimate the stiffness of the locked axes; returns `Run.stiffness`."""
    return _run_stage(run, "stiffness", "", settings)[0].stiffness


def identify(run: Run | Path_, model: str = "", **settings: object) -> pd.DataFrame:
    """Estimate the parameters of one model, or of all; returns `Run.parameters`."""
    return _run_stage(run, "identify", model, settings)[0].parameters(model)


def validate(run: Run | Path_, model: str = "", **settings: object) -> pd.DataFrame:
    """Predict held-out trials with one model, or with all; returns `Run.validation`."""
    return _run_stage(run, "validate", model, settings)[0].validation(model)


def diagnose(run: Run | Path_, model: str = "", **settings: object) -> dict[str, Any]:
    """Find the missing effects of a model (default: the best one); returns `Run.diagnosis`."""
    chosen = model or _open(run).model
    return _run_stage(run, "diagnose", chosen, settings)[0].diagnosis(chosen)


def draft(run: Run | Path_, model: str = "", **settings: object) -> dict[str, Any]:
    """Draft a formula for an unexplained residual; returns `Run.drafts`."""
    chosen = model or _open(run).model
    return _run_stage(run, "draft", chosen, settings)[0].drafts(chosen)


def compare(run: Run | Path_, **settings: object) -> pd.DataFrame:
    """Compare the models on the same held-out trials; returns `Run.ladder`."""
    return _run_stage(run, "compare", "", settings)[0].ladder


def write_report(run: Run | Path_, **settings: object) -> Path:
    """Write the report; returns the path of the PDF."""
    return _run_stage(run, "report", "", settings)[0].root / "report" / "report.pdf"


def extend(run: Run | Path_, effect: str | Sequence[str], model: str = "") -> Run:
    """Add one or several effects to a model, identify and validate it again, and compare.

    Args:
        effect: ``name[:target]``, ``file.toml[:target]`` for an effect of your own, or several.
        model: the parent; by default the best confirmed model.

    Returns:
        The run; its `Run.model` is the child if that lowers the held-out error.

    Raises:
        InputError: the effect or the parent does not exist, or the device cannot have the effect.
    """
    opened = _open(run)
    effects = (effect,) if isinstance(effect, str) else tuple(effect)
    loop.extend(_options(opened), model or opened.model, effects)
    return Run(opened.root)


def follow(run: Run | Path_, model: str = "") -> Run:
    """Diagnose and extend until nothing is missing.

    Returns:
        The run, whose `Run.model` is the best one found.
    """
    opened = _open(run)
    loop.follow(_options(opened), model or opened.model, lambda line: None)
    return Run(opened.root)


def _open(run: Run | Path_) -> Run:
    return run if isinstance(run, Run) else open_run(run)


def _options(run: Run) -> loop.LoopOptions:
    """Return the request for any stage of a run, and a listener that does nothing."""
    batch.limit_threads(1)
    return loop.LoopOptions(Request(run.root, pipelines.whole(run.root)), ignore_event)


def run_stage(run: Run | Path_, stage: str, model: str = "", **settings: object) -> dict[str, Any]:
    """Run any stage on the results of earlier ones; returns its summary, a plain record.

    Args:
        stage: name of the stage, as on the command line.
        model: model of a stage that runs for each; by default base and all models run before.
        settings: see ``bampipe STAGE --settings``.

    Raises:
        InputError: the stage, model or setting does not exist, or an earlier stage has not run.
    """
    _, steps = _run_stage(run, stage, model, settings)
    return steps[0] if len(steps) == 1 else {"steps": steps}


def _run_stage(
    run: Run | Path_, stage: str, model: str, settings: Mapping[str, object]
) -> tuple[Run, list[dict[str, Any]]]:
    """Run one stage, for one model or each; return the run with its results, and summaries."""
    changed = {stage: settings} if settings else {}
    request = _options(_open(run)).request
    request = replace(request, settings=changed, first=stage, last=stage, model=model)
    outcome = runner.run_session(request, ignore_event)
    return Run(request.root), [step.summary for step in outcome.steps]
