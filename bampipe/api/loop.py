"""The loop: diagnose a model, extend it by the missing effects, and confirm the result."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model import ModelFile
from bampipe.errors import InputError
from bampipe.files import is_normal, write_text
from bampipe.lists import join_names
from bampipe.phrases import diagnosis as phrases
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.identify import IdentifyResult
from bampipe.run import models, record
from bampipe.run.events import Listener
from bampipe.run.request import Request
from bampipe.run.runner import run_session
from bampipe.stages import base

MOST_ROUNDS = 4


@dataclass(frozen=True)
class LoopOptions:
    """The request that all steps of the loop share, and the listener to their events."""

    request: Request
    listen: Listener

    def lock(self) -> AbstractContextManager[None]:
        """Return a lock on the run folder; do not hold it during :meth:`run`."""
        return record.lock(self.request.root, self.request.wait, self.listen)

    def remove(self, model: str) -> None:
        """Remove a model."""
        folder = self.request.root / "models" / model
        if folder.exists():
            with self.lock():
                shutil.rmtree(folder)

    def run(
        self,
        first: str,
        last: str,
        model: str,
        changed: Mapping[str, Mapping[str, object]] = MappingProxyType({}),
    ) -> None:
        """Run the stages ``first`` to ``last`` on ``model``, with some settings ``changed``."""
        settings = settings_of(self.request.root, model)
        for stage, values in changed.items():
            settings[stage] = {**settings.get(stage, {}), **values}
        step = replace(self.request, first=first, last=last, model=model, settings=settings)
        run_session(step, self.listen)


def settings_of(root: Path, model: str) -> dict[str, dict[str, object]]:
    """Return the last settings of each stage for ``model``, or else for its parent.

    A child is thus identified and judged like its parent.
    """
    line = [model]
    while line[-1] in RunFolder(root).models() and models.read(root, line[-1]).parent:
        line.append(models.read(root, line[-1]).parent)
    made = record.read(root).stages
    used: dict[str, dict[str, object]] = {}
    for name in line[::-1]:
        for stage in base.PER_MODEL:
            step = made.get(f"{stage}:{name}")
            if step is not None:
                used[stage] = {k: value for k, value in step.settings.items() if k != "model"}
                if name != model:  # an effect that is useless in the parent may help the child
                    used[stage].pop("without", None)
    return used


def _find_effect(text: str, drafts: Mapping[str, Path]) -> tuple[str, Path | None]:
    """Return the effect ``name[:target]`` and its file, if it is not built in.

    ``text`` is ``name[:target]`` or ``file.toml[:target]``; a draft needs no target.
    """
    for name, file in drafts.items():
        if text in (name, name.partition(":")[0]):
            return name, file
    path, _, target = text.partition(":")
    if not path.endswith(".toml"):
        return text, None
    from bampipe.declarations.files import read_effect
    from bampipe.physics import registry

    effect = registry.effect_from(read_effect(path), path)
    return f"{effect.name}:{target}" if target else effect.name, Path(path)


def adopt_effect(file: Path, runs: Path) -> Path:
    """Copy an effect file so that every run of the folder ``runs`` finds it; return the copy."""
    from bampipe.declarations.files import read_effect
    from bampipe.physics import registry

    effect = registry.effect_from(read_effect(str(file)), str(file))
    if effect.name in registry.effect_names():
        raise InputError(
            f"there is a built-in effect {effect.name!r}", where=str(file), remedy="rename yours"
        )
    target = runs / models.ADOPTED / f"{effect.name}.toml"
    write_text(target, file.read_text(encoding="utf-8"))
    return target


def extend(options: LoopOptions, parent: str, effects: Sequence[str]) -> str:
    """Extend ``parent`` by ``effects``; identify, validate and compare the child.

    Args:
        effects: ``name[:target]`` of the library or of a draft, or ``file.toml[:target]``.

    Returns:
        The name of the child.

    Raises:
        InputError: the parent or an effect does not exist, the device cannot have the effect, or
            the parent has it already. No files remain.
    """
    root = options.request.root
    run, drafted = RunFolder(root), RunFolder(root).find(DraftResult, parent)
    drafts = {n: run.path(one.file) for n, one in drafted.effects.items()} if drafted else {}
    named = dict(_find_effect(effect, drafts) for effect in effects)
    child = models.child_name(parent, tuple(named))
    for name in named:
        if "/" in name or not is_normal(child):
            raise InputError(
                f"{name!r} is not the name of an effect", remedy="see `bampipe effects`"
            )
    try:
        with options.lock():
            models.ensure_base(root, *options.request.pipeline.base_model)
            _write_child(root, child, parent, named)
        options.run("identify", "validate", parent)
        options.run("identify", "validate", child)
    except BaseException:
        if f"identify:{child}" not in record.read(root).stages:
            options.remove(child)
        raise
    options.run("compare", "compare", "")
    return child


def _write_child(root: Path, child: str, parent: str, named: Mapping[str, Path | None]) -> None:
    """Write the child of ``parent`` with the effects ``named``, its ``model.toml`` last."""
    from bampipe.declarations.model_file import load_model

    before = models.read(root, parent)
    for effect in named:
        if effect in before.effects:
            raise InputError(f"model {parent!r} already has {effect}", where=str(root))
    effect_files = {
        path.name: path for path in (root / "models" / parent / "effects").glob("*.toml")
    }
    for effect, file in named.items():
        if file is not None:
            effect_files[f"{effect.partition(':')[0]}.toml"] = file
    for name, source in sorted(effect_files.items()):
        text = source.read_text(encoding="utf-8")
        write_text(root / "models" / child / "effects" / name, text)
    effects = (*before.effects, *named)
    diagnosis = RunFolder(root).find(DiagnoseResult, parent)
    start = diagnosis.fitted_of(effects) if diagnosis is not None else {}
    model = ModelFile(name=child, parent=parent, device=before.device, effects=effects, start=start)
    models.write(root, model)
    load_model(RunFolder(root), child, as_declared=True)


def follow(
    options: LoopOptions, model: str, tell: Callable[[str], None], draft: bool = False
) -> str:
    """Diagnose, add all missing effects at once, and confirm the result by another diagnosis.

    An effect whose strength is not significant is removed again, and effects that did not improve
    the model are not considered again. Effects that the confirmation finds are added as well,
    unless the verdict is ``unknown_effect``: a further effect would only imitate the unknown one.

    Args:
        tell: called with a line on each finding and each step.
        draft: whether to draft and add a formula if no known effect explains the residual.

    Returns:
        The name of the last model that is better than its parent.
    """
    run, given = RunFolder(options.request.root), model
    options.run("identify", "validate", model)  # the ladder compares each child with it
    left_out: dict[str, dict[str, object]] = {}
    for _ in range(MOST_ROUNDS):
        options.run("diagnose", "diagnose", model, left_out)
        diagnosis = run.read(DiagnoseResult, model)
        for axis in sorted(diagnosis.axes):
            tell(f"{model}, {axis}: {phrases.verdict(diagnosis, axis)}")
        for line in dict.fromkeys(_list_open_questions(diagnosis)):
            tell(line)
        found = () if model != given and diagnosis.remainder_unknown else diagnosis.selected
        if draft and diagnosis.unnamed_axes:
            options.run("draft", "draft", model)
            drafted = run.read(DraftResult, model)
            tell(drafted.sentence)
            found = drafted.selected or found
        if not found:
            break
        child = _add(options, model, found, tell)
        if child:
            model, left_out = child, {}
        elif set(found) <= set(diagnosis.selected):
            # The next diagnosis does not propose effects that did not improve the model.
            left_out = {"diagnose": {"without": (*diagnosis.not_weighed, *found)}}
        else:
            break
    else:
        tell(f"stopped after {MOST_ROUNDS} rounds")
    options.run("compare", "compare", "")
    return model


def _list_open_questions(diagnosis: DiagnoseResult) -> Iterator[str]:
    """Yield a line on each undecided axis: the effect added, and the trial that would decide."""
    trial, open_effects = diagnosis.suggested_trial, phrases.find_open_effects(diagnosis)
    for axis, entry in diagnosis.axes.items():
        if entry.verdict != "undecided":
            continue
        known, parts = phrases.split_alternatives(diagnosis, axis)
        taken = join_names(name for name in entry.effects if name in open_effects)
        added = f"{taken} added provisionally" if taken else "none of these is added"
        beside = f" beside {known}" if known else ""
        asked = trial is not None and {*trial.between} & {*entry.probabilities}
        advice = trial.sentence if trial is not None and asked else phrases.advise_trial(entry)
        yield f"{phrases.open_question(parts)}{beside}: {added}. {advice}"


def _add(
    options: LoopOptions, model: str, effects: tuple[str, ...], tell: Callable[[str], None]
) -> str:
    """Extend ``model`` by the effects with a strength; return "" if it does not improve.

    If it does not, effects on axes whose own error falls are tried without the others.
    """
    tell(f"adding {', '.join(effects)}")
    child = extend(options, model, effects)
    run = RunFolder(options.request.root)
    found = run.read(IdentifyResult, child).effects
    if weak := [name for name in effects if not found[name].has_strength]:
        tell(f"{', '.join(weak)}: strength not significantly different from zero, removed")
        effects = tuple(effect for effect in effects if effect not in weak)
        options.remove(child)
        if not effects:
            return ""
        child = extend(options, model, effects)
    ladder = {rung.model: rung for rung in run.read(CompareResult).ladder}
    if ladder[child].improves_on(ladder[model]):
        return child
    why = "the held-out error does not fall"
    if ladder[child].has_lost_its_floor(ladder[model]):
        why = "there is no noise floor, or the error is implausibly far below it"
    axis_of = {row.effect: row.axis for row in run.read(DiagnoseResult, model).ranking}
    worse = ladder[child].axes_worse_than(ladder[model])
    helpful = tuple(effect for effect in effects if axis_of.get(effect) not in worse)
    again = 0 < len(helpful) < len(effects)
    then = "tried without those on axes whose error rises" if again else f"stopped at {model}"
    tell(f"{', '.join(effects)}: {why}, {then}")
    return _add(options, model, helpful, tell) if again else ""
