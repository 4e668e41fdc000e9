"""Runs the stages of one session: order, cache by content, complete files, provenance."""

import json
import shutil
import time
from datetime import UTC, datetime

from bampipe.compile_ahead import compiling_ahead
from bampipe.errors import InputError, MissingResultError, NothingToDoError
from bampipe.files import write_json
from bampipe.results.run import Commit, PipelineUsed, StepRecord, Timing
from bampipe.run import accepted, hashing, models, record, staging
from bampipe.run.events import Event, Listener, ignore_event
from bampipe.run.gates import judge_gates
from bampipe.run.request import Outcome, Request, Step, StepResult, select_stages
from bampipe.run.state import FIRST_TIME, RunState, list_lasting
from bampipe.stages import base


class _Runner:
    """Runs the steps of one session while it holds the run folder."""

    def __init__(self, request: Request, listen: Listener) -> None:
        self.request = request
        self.state = RunState(request)
        self.listen = listen
        self.root = request.root

    def execute(self, step: Step, reason: str) -> StepResult:
        name = self.root.name
        self.listen(Event(name, step.name, "start", 0.0, "" if reason == FIRST_TIME else reason))
        started = datetime.now(UTC)
        clock = time.perf_counter()
        state = self.state
        config = state.configure(step, state.settings(step))
        module = base.load_stage(step.stage)
        declared = base.paths_of(step.model, module.INPUTS)
        inputs = state.inputs(step, declared)
        outputs = base.paths_of(step.model, module.OUTPUTS)
        out = staging.prepare(self.root, step.name, outputs)

        def progress(fraction: float, message: str) -> None:
            self.listen(Event(name, step.name, "progress", fraction, message))

        summary = module.execute(state.folder, out, config, progress)
        written = staging.digest_outputs(out, outputs, step.name)
        settings = list_lasting(config)
        previous = state.records[step.name].outputs if step.name in state.records else {}
        made = StepRecord(
            key=state.key(step, settings, inputs),
            config=settings,
            settings=state.settings(step),
            declared_inputs=declared,
            inputs=inputs,
            outputs=written,
            code=hashing.digest_code(step.stage),
            versions=dict(hashing.versions()),
            summary=json.loads(json.dumps(summary, allow_nan=False)),
        )
        seconds = time.perf_counter() - clock
        timing = Timing(started_at=started.isoformat(timespec="seconds"), seconds=round(seconds, 3))
        remove = tuple(sorted(previous.keys() - written.keys()))
        sealed = Commit(step=step.name, record=made, timing=timing, remove=remove)
        # From here on, the step counts as done.
        write_json(out / staging.COMMIT, sealed.model_dump(mode="json"))
        staging.commit(state, out, sealed)
        self.listen(Event(name, step.name, "done", 1.0))
        return StepResult(step.name, "done", reason, seconds, made.summary)

    def failed(self, step: Step, error: str, *, noted: bool = True) -> None:
        """Report that the step failed, and record it if ``noted``.

        Results of its last success stay, and stay recorded.
        """
        shutil.rmtree(staging.folder(self.root, step.name), ignore_errors=True)
        if noted:
            self.state.failures[step.name] = error
            self.state.save()
        self.listen(Event(self.root.name, step.name, "failed", 0.0, error))

    def step(self, step: Step) -> StepResult:
        try:
            reason = self.state.reason(step)
            if reason:
                return self.execute(step, reason)
        except (MissingResultError, NothingToDoError) as error:
            self.failed(step, str(error), noted=False)
            raise
        except InputError as error:
            # A refused setting or session is no failure of results made without it.
            given = step.stage in base.READS_SESSION or self.request.settings.get(step.stage)
            self.failed(step, str(error), noted=not (given and step.name in self.state.records))
            raise
        except Exception as error:
            self.failed(step, f"{type(error).__name__}: {error}")
            raise
        self.state.failures.pop(step.name, None)
        self.listen(Event(self.root.name, step.name, "unchanged", 1.0))
        summary = self.state.records[step.name].summary
        return StepResult(step.name, "unchanged", "", 0.0, summary)

    def run(self) -> Outcome:
        stages = select_stages(self.request)
        for step in (one for stage in stages for one in self.state.steps(stage)):
            if self.state.settings(step).keys() - {"model"}:
                self.state.declared(step)  # a mistake is refused before any stage runs
        results: list[StepResult] = []
        pipeline = self.request.pipeline
        for stage in stages:
            if stage in base.PER_MODEL:
                models.ensure_base(self.root, *pipeline.base_model)
                if self.request.model:
                    models.read(self.root, self.request.model)
            for step in self.state.steps(stage):
                results.append(self.step(step))
        if not self.request.judge:
            self.state.save()
            return Outcome(self.root, "done", tuple(results))
        judged = self.request.model or self.state.folder.default_model()
        baseline = self.request.accepted or accepted.accepted_folder(self.root.parent)
        found = (judge_gates(gate, self.root, judged, baseline) for gate in pipeline.gates)
        verdicts = tuple(verdict for of_gate in found for verdict in of_gate)
        used = PipelineUsed.of(pipeline, pipeline.model)
        self.state.save(pipeline=used, gates=verdicts)
        return Outcome(self.root, "done", tuple(results), verdicts, model=judged)


def run_session(request: Request, listen: Listener = ignore_event) -> Outcome:
    """Run the selected stages of one session; bad input leaves earlier results as they were."""
    stages = select_stages(request)
    fresh = not request.root.exists()
    with record.lock(request.root, request.wait, listen):
        runner = _Runner(request, listen)
        staging.recover(runner.state)
        try:
            if "identify" not in stages:
                return runner.run()
            with compiling_ahead(request.processes) as cold:
                if cold:
                    listen(Event(request.root.name, "", "compiling"))
                return runner.run()
        except InputError:
            if fresh and not runner.state.records:
                shutil.rmtree(request.root)
            raise
