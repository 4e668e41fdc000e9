"""The loop: add an effect to a model, measure again, follow the diagnosis."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError
from bampipe.files import is_normal
from bampipe.lists import join_names
from bampipe.run import models, record
from bampipe.run.events import Listener
from bampipe.run.request import Request
from bampipe.run.runner import run_session
from bampipe.stages import base

if TYPE_CHECKING:
    from bampipe.declarations.pipeline import Pipeline
    from bampipe.results.diagnose import DiagnoseResult

MOST_ROUNDS = 4


@dataclass(frozen=True)
class LoopOptions:
    """What every step of the loop needs.

    Attributes:
        root: the run folder.
        pipeline: whose settings count.
        force: run even if nothing changed.
        wait: wait while another process holds the run folder.
        listen: called with every event.
    """

    root: Path
    pipeline: Pipeline
    force: bool
    wait: bool
    listen: Listener

    def lock(self) -> AbstractContextManager[None]:
        """Hold the run folder, as a run does; not while one of :meth:`run` is under way."""
        return record.lock(self.root, self.wait, self.listen)

    def run(
        self,
        first: str,
        last: str,
        model: str,
        changed: Mapping[str, Mapping[str, object]] = MappingProxyType({}),
    ) -> None:
        """Run the stages ``first`` to ``last`` on ``model``, with some settings ``changed``."""
        settings = settings_of(self.root, model)
        for stage, values in changed.items():
            settings[stage] = {**settings.get(stage, {}), **values}
        run_session(
            Request(
                root=self.root,
                pipeline=self.pipeline,
                first=first,
                last=last,
                model=model,
                settings=settings,
                force=self.force,
                wait=self.wait,
            ),
            self.listen,
        )


def settings_of(root: Path, model: str) -> dict[str, dict[str, object]]:
    """Settings that each stage was last given for ``model``, else for the model it came from.

    A ladder compares like with like: a child is identified and judged as its parent was, whether
    a pipeline said how, or a command for one stage.
    """
    line = [model]
    while line[-1] in models.names(root) and models.read(root, line[-1]).parent:
        line.append(models.read(root, line[-1]).parent)
    made = record.read(root).stages
    used: dict[str, dict[str, object]] = {}
    for name in line[::-1]:
        for stage in base.PER_MODEL:
            step = made.get(f"{stage}:{name}")
            if step is not None:
                used[stage] = {k: value for k, value in step.settings.items() if k != "model"}
                if name != model:  # what came to nothing in the parent may count in the child
                    used[stage].pop("without", None)
    return used


def _diagnosis(root: Path, model: str) -> DiagnoseResult:
    from bampipe.results.diagnose import DiagnoseResult

    return RunFolder(root).read(DiagnoseResult, model)


def _split_effect_file(text: str) -> tuple[Path, str] | None:
    """Split ``file.toml[:target]``; None if ``text`` names no file."""
    name, _, target = text.partition(":")
    return (Path(name), target) if name.endswith(".toml") else None


def drafts_of(root: Path, model: str) -> dict[str, Path]:
    """Files of the effects drafted for ``model``, by ``name[:target]``."""
    from bampipe.results.draft import DraftResult

    run = RunFolder(root)
    if not run.exists(DraftResult.file(model)):
        return {}
    effects = run.read(DraftResult, model).effects
    return {name: run.path(effect.file) for name, effect in effects.items()}


def _named(text: str, drafts: Mapping[str, Path]) -> tuple[str, Path | None]:
    """Return the effect ``name[:target]`` and the file it comes from, if it is not built in.

    Args:
        text: ``name[:target]``, or ``file.toml[:target]``.
        drafts: of the model that is extended; their target may be left out.
    """
    for name, file in drafts.items():
        if text in (name, name.partition(":")[0]):
            return name, file
    effect_file = _split_effect_file(text)
    if effect_file is None:
        return text, None
    path, target = effect_file
    from bampipe.declarations.files import read_effect
    from bampipe.physics import registry

    effect = registry.effect_from(read_effect(str(path)), str(path))
    return f"{effect.name}:{target}" if target else effect.name, path


def adopt_effect(file: Path, runs: Path) -> Path:
    """Copy an effect file to where every run of the folder ``runs`` finds it; return the copy.

    Raises:
        InputError: it is no effect file, or its name is that of a built-in effect.
    """
    from bampipe.declarations.files import read_effect
    from bampipe.physics import registry

    effect = registry.effect_from(read_effect(str(file)), str(file))
    if effect.name in registry.effect_names():
        raise InputError(
            f"there is a built-in effect {effect.name!r}", where=str(file), remedy="rename yours"
        )
    target = runs / models.ADOPTED / f"{effect.name}.toml"
    record.replace_text(target, file.read_text(encoding="utf-8"))
    return target


def extend(options: LoopOptions, parent: str, effects: Sequence[str]) -> str:
    """Make the child of ``parent`` that has ``effects`` too; identify, validate, compare.

    Args:
        options: run folder, settings, listener.
        parent: name of a model of this run.
        effects: each ``name[:target]`` of the library or of a draft for the parent, or
            ``file.toml[:target]`` for a lab's own.

    Returns:
        The name of the child.

    Raises:
        InputError: no such parent or effect, one the device cannot have, or one that the parent
            has already; nothing is left behind.
    """
    root = options.root
    drafts = drafts_of(root, parent)
    named = dict(_named(effect, drafts) for effect in effects)
    child = models.child_name(parent, tuple(named))
    for name in named:
        if "/" in name or not is_normal(child):
            raise InputError(f"{name!r} is no name of an effect", remedy="see `bampipe effects`")
    try:
        with options.lock():
            models.ensure_base(root, *options.pipeline.base_model)
            _write_child(root, parent, named)
        options.run("identify", "validate", parent)
        options.run("identify", "validate", child)
    except BaseException:
        if f"identify:{child}" not in record.read(root).stages:
            _remove(options, child)
        raise
    options.run("compare", "compare", "")
    return child


def _remove(options: LoopOptions, model: str) -> None:
    """Remove a model that came to nothing."""
    folder = options.root / "models" / model
    if folder.exists():
        with options.lock():
            shutil.rmtree(folder)


def _write_child(root: Path, parent: str, named: Mapping[str, Path | None]) -> None:
    """Write the child of ``parent`` with more effects, its ``model.toml`` last: then it counts.

    Args:
        root: the run folder, held.
        parent: name of a model.
        named: ``name[:target]`` of each effect, and where it comes from if it is a lab's own.

    Raises:
        InputError: the parent has an effect already, or the device cannot have it.
    """
    from bampipe.declarations.model import ModelFile
    from bampipe.declarations.model_file import load_model

    before = models.read(root, parent)
    for effect in named:
        if effect in before.effects:
            raise InputError(f"model {parent!r} has {effect} already", where=str(root))
    child = models.child_name(parent, tuple(named))
    effect_files = {
        path.name: path for path in (root / "models" / parent / "effects").glob("*.toml")
    }
    for effect, file in named.items():
        if file is not None:
            effect_files[f"{effect.partition(':')[0]}.toml"] = file
    for name, source in sorted(effect_files.items()):
        text = source.read_text(encoding="utf-8")
        record.replace_text(root / "models" / child / "effects" / name, text)
    effects = (*before.effects, *named)
    model = ModelFile(name=child, parent=parent, device=before.device, effects=effects)
    models.write(root, model)
    load_model(RunFolder(root), child, as_declared=True)


def follow(
    options: LoopOptions, model: str, tell: Callable[[str], None], draft: bool = False
) -> str:
    """Diagnose, add all that was found at once, and confirm it by one more diagnosis.

    What is drafted for the rest is added with the set, where that is asked for. An effect that the
    identified model gives no strength is left out again, and what came to nothing when it was added
    is not weighed again. Should the confirmation find more, that is added likewise.

    Args:
        options: run folder, settings, listener.
        model: name of the model to start from.
        tell: called with a line on each thing found and done.
        draft: whether to draft a formula where the diagnosis finds no name.

    Returns:
        The name of the last model that is better than its parent.
    """
    from bampipe.phrases import diagnosis as phrases

    options.run("identify", "validate", model)  # what a child is held against, and the ladder shows
    left_out: dict[str, dict[str, object]] = {}
    for _ in range(MOST_ROUNDS):
        options.run("diagnose", "diagnose", model, left_out)
        diagnosis = _diagnosis(options.root, model)
        for axis in sorted(diagnosis.axes):
            tell(f"{model}, {axis}: {phrases.verdict(diagnosis, axis)}")
        for line in _unsettled(diagnosis):
            tell(line)
        found = diagnosis.selected
        if draft and diagnosis.unnamed_axes:
            found = _drafted(options, model, tell) or found
        if not found:
            break
        child = _add(options, model, found, tell)
        if child:
            model, left_out = child, {}
        elif set(found) <= set(diagnosis.selected):
            # Diagnosed once more: what came to nothing is no longer said to be missing.
            left_out = {"diagnose": {"without": (*diagnosis.not_weighed, *found)}}
        else:
            break
    else:
        tell(f"stopped after {MOST_ROUNDS} rounds")
    options.run("compare", "compare", "")
    return model


def _unsettled(diagnosis: DiagnoseResult) -> list[str]:
    """Say where effects are about as likely as others which of them are added, and what decides."""
    from bampipe.phrases import diagnosis as phrases

    said = []
    trial, open_effects = diagnosis.suggested_trial, phrases.find_open_effects(diagnosis)
    for axis, entry in diagnosis.axes.items():
        if entry.verdict != "undecided":
            continue
        known, parts = phrases.split_alternatives(diagnosis, axis)
        taken = join_names(n for n in entry.effects if n in open_effects)
        which = f"which of them is added is arbitrary, it is {taken}"
        beside = f" beside {known}" if known else ""
        asked = trial is not None and {*trial.between} & {*entry.probabilities}
        said.append(
            f"{phrases.open_question(parts)}{beside}: {which if taken else 'none is added'}. "
            + (trial.sentence if trial is not None and asked else _what_decides(entry.likely))
        )
    return list(dict.fromkeys(said))


def _what_decides(names: Sequence[str]) -> str:
    """What to record where no trial was found that would tell effects apart."""
    if any("delay" in name for name in names) and any("lag" in name for name in names):
        return (
            "A lag weakens what changes fast, a delay does not: log at a higher rate, and record"
            " trials in which the force changes faster."
        )
    return "No trial was found that would tell them; `bampipe next --for decision` looks for one."


def _drafted(options: LoopOptions, model: str, tell: Callable[[str], None]) -> tuple[str, ...]:
    """Draft formulas for what ``model`` leaves; return the names of their effects."""
    from bampipe.results.draft import DraftResult

    options.run("draft", "draft", model)
    found = RunFolder(options.root).read(DraftResult, model)
    tell(found.sentence)
    return found.selected


def _add(
    options: LoopOptions, model: str, effects: tuple[str, ...], tell: Callable[[str], None]
) -> str:
    """Extend ``model`` by those of ``effects`` that keep a strength; "" if that is no better."""
    from bampipe.results.compare import CompareResult

    tell(f"adding {', '.join(effects)}")
    child = extend(options, model, effects)
    idle = _without_strength(options.root, child, effects)
    if idle:
        tell(f"{', '.join(idle)}: no strength beside the other parameters, left out")
        effects = tuple(effect for effect in effects if effect not in idle)
        _remove(options, child)
        if not effects:
            return ""
        child = extend(options, model, effects)
    ladder = {rung.model: rung for rung in RunFolder(options.root).read(CompareResult).ladder}
    if ladder[child].improves_on(ladder[model]):
        return child
    lost = ladder[child].has_lost_its_floor(ladder[model])
    why = (
        "no noise floor could be computed with it, so that its error cannot be judged"
        if lost
        else "the held-out error does not fall after all"
    )
    tell(f"{', '.join(effects)}: {why}, stopped at {model}")
    return ""


def _without_strength(root: Path, model: str, effects: Sequence[str]) -> tuple[str, ...]:
    """Those of ``effects`` whose every strength in ``model`` is zero within two of its sd."""
    from bampipe.declarations.model_file import load_model
    from bampipe.results.identify import IdentifyResult

    run = RunFolder(root)
    found = run.read(IdentifyResult, model).parameters
    idle = []
    for effect in load_model(run, model).effects:
        strengths = [found[p.name] for p in effect.parameters if p.strength and p.name in found]
        unsure = all(abs(p.estimate) < 2.0 * p.sd for p in strengths)
        if effect.name in effects and strengths and unsure:
            idle.append(effect.name)
    return tuple(idle)
