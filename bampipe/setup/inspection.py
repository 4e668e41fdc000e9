"""Inspection of a session's set-up by its trials, with mistakes as sentences and records."""

import ast
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bampipe.data.refusals import refusal
from bampipe.estimate.low_pass import Band
from bampipe.lists import join_names
from bampipe.physics import System
from bampipe.results.ingest import IngestResult
from bampipe.results.setup import AxisSetup, AxisState, PossibleMistake, SetupMistake, SetupResult
from bampipe.setup.hypotheses import Correction
from bampipe.setup.plausibility import LEAST_MOVING, Plausibility, distance_from_prior
from bampipe.setup.robot_search import DRAWN_SAMPLES, DrawnSearch, drawn_robot, is_drawn
from bampipe.setup.search import EXPLAINED, MOST_TRIALS, Finding, Search, shorten, spoilt_axes
from bampipe.setup.sentences import sentence
from bampipe.setup.turned_trials import find_turned_trials
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.signals import Signals

_FARTHEST = {"rotary": (62.8, "degrees"), "linear": (20.0, "millimetres")}
"""By kind: the largest plausible travel of an axis, ten turns, rad, or a long hall, m; and the unit
that larger numbers usually have."""
_MANY = 8
"""Largest number of names in a message."""


def inspect_setup(
    system: System,
    session: IngestResult,
    motions: Sequence[Motion],
    band: Band,
    folds: Folds,
    names: Sequence[str] = (),
) -> SetupResult:
    """Inspect the set-up of a session by its trials ``names``, with every input of the device.

    Some trials, spread over the session, show mistakes that all share; each shows its own.

    Raises:
        InputError: the device leaves the scale of its equation open.
    """
    signals = Signals.of_session(system, session)
    _require_scale(system, motions[:1])
    of_kind = [[k for k, fits in enumerate(folds.fitted) if fits == kind] for kind in (True, False)]
    spread = (np.linspace(0, len(k) - 1, min(len(k), MOST_TRIALS)).round() for k in of_kind)
    chosen = [k[n] for k, places in zip(of_kind, spread, strict=True) for n in map(int, places)]
    part = folds.subset(chosen)
    placeholders = _find_placeholders(system, session)
    ones = tuple(n for names in placeholders.values() for n in names)

    def search_in(motions: Sequence[Motion]) -> tuple[Search, Plausibility | None]:
        short = shorten([motions[k] for k in chosen])
        search = Search(system, short, band, part, signals, ones)
        held = search.judge(())
        if is_drawn(system):
            short = shorten(short, DRAWN_SAMPLES)
            search = DrawnSearch(system, short, band, part, signals, ones)
        return search, held

    search, held = search_in(motions)
    # Reversed signs in some trials come first: in all trials together they look like others.
    odd = find_turned_trials(system, motions, band, folds, signals)
    if odd:
        motions = [
            odd[k].correction.change.of_motion(motion, signals) if k in odd else motion
            for k, motion in enumerate(motions)
        ]
        search, _ = search_in(motions)
    findings = search.find_mistakes()
    mistakes = (
        *_record_turned(system, session, odd, names),
        *(_record(system, session, found, placeholders) for found in findings),
    )
    axes = {axis: _axis(k, axis, held, mistakes) for k, axis in enumerate(system.coordinates)}
    warnings = [
        sentence("hardly_moves", axis=axis, still=100.0 * (1.0 - entry.moving_share))
        for axis, entry in axes.items()
        if entry.state == "hardly_moves"
    ]
    unexplained = {}
    if held is not None and not mistakes and search.over_position is None:
        unexplained = {
            axis: sentence("unexplained", axis=axis, explained=100.0 * max(1.0 - left, 0.0))
            for (axis, entry), left in zip(axes.items(), held.left, strict=True)
            if entry.state == "unexplained"
        }
    warnings += _describe_travel(system, session, motions)
    if search.heavier is not None:
        robot = drawn_robot(system)
        warnings.append(robot.describe_mass(search.heavier.place, search.heavier.factor))
    if held is not None and search.over_position is not None:
        unexplained = {
            axis: sentence("over_position", axis=axis, fall=_fall(i, held, search.over_position))
            for i, axis in enumerate(system.coordinates)
            if search.over_position.error[i] < held.error[i] / 1.5
        }
    named = " ".join(mistake.sentence for mistake in mistakes)
    warnings += [
        f"{said}: the scale of all estimates depends on it"
        for said in placeholders
        if said not in named
    ]
    return SetupResult(
        headline="; ".join(mistake.sentence for mistake in mistakes),
        mistakes=mistakes,
        warnings=tuple(warnings),
        unexplained=unexplained,
        tested=search.tested,
        axes=axes,
    )


def _describe_travel(
    system: System, session: IngestResult, motions: Sequence[Motion]
) -> Iterator[str]:
    """Report axes that move implausibly far, as if degrees were taken for radians unstated."""
    travel = np.max([np.ptp(motion.q, axis=0) for motion in motions], axis=0)
    for coordinate, size in zip(system.model.device.coordinates, travel, strict=True):
        most, meant = _FARTHEST[coordinate.kind]
        axis = session.axes[coordinate.name]
        if size > most and axis.raw_unit == coordinate.unit and not axis.unit_in_log:
            of = {"axis": coordinate.name, "size": size, "unit": coordinate.unit}
            yield sentence("far_travel", **of, meant=meant)


def _axis(
    place: int, axis: str, held: Plausibility | None, mistakes: Sequence[SetupMistake]
) -> AxisSetup:
    moving = held.moving[place] if held is not None else 1.0
    still = moving < LEAST_MOVING
    state: AxisState = "sound"
    if any(axis in mistake.axes or held is None for mistake in mistakes):
        state = "mistaken"
    elif still or held is None or held.left[place] > EXPLAINED:
        state = "hardly_moves" if still else "unexplained"
    return AxisSetup(
        state=state,
        error_percent=None if held is None or still else 100.0 * held.error[place],
        moving_share=moving,
    )


def _record(
    system: System, session: IngestResult, found: Finding, placeholders: Mapping[str, Sequence[str]]
) -> SetupMistake:
    correction, axes = found.correction, spoilt_axes(found)
    said = describe_correction(correction, session)
    left = [s for s, names in placeholders.items() if set(correction.signals) <= set(names)]
    rivals = found.rivals
    if correction.kind == "scale" and left:
        size = _describe_factor(correction.factor, "small", "large")
        said = f"{left[0]}, a placeholder: it makes the drive of the device about {size}"
        rivals = tuple(r for r in rivals if not set(r.signals) <= set(placeholders[left[0]]))

    def errors(of: Plausibility) -> dict[str, float]:
        return dict(zip(system.coordinates, 100.0 * of.error, strict=True))

    return SetupMistake.of(
        correction,
        gravity=correction.change.gravity,
        axes=tuple(system.coordinates[i] for i in axes),
        sentence=said,
        evidence=describe_evidence(system, axes, found.before, found.after),
        error_before=errors(found.before),
        error_after=errors(found.after),
        alternatives=tuple(
            PossibleMistake.of(one, sentence=describe_correction(one, session)) for one in rivals
        ),
    )


def _record_turned(
    system: System, session: IngestResult, odd: Mapping[int, Finding], names: Sequence[str]
) -> Iterator[SetupMistake]:
    """Record trials with a sign of their own; those with the same sign are one mistake."""
    alike: dict[tuple[tuple[str, ...], ...], list[int]] = {}
    for k, found in odd.items():
        either = found.correction, *found.rivals
        alike.setdefault(tuple(one.signals for one in either), []).append(k)
    for any_of, trials in alike.items():
        many = len(trials) > 1
        said = f"{' or '.join(map(join_names, any_of))} {'have' if len(any_of[0]) > 1 else 'has'}"
        its, entry, them = ("their", "entries", "them") if many else ("its", "entry", "the trial")
        whole = sentence(
            "turned_trials", trials=join_names(names[k] for k in trials), said=said,
            names=json.dumps(any_of[0]), its=its, entry=entry, them=them,
        )  # fmt: skip
        record = _record(system, session, replace(odd[trials[0]], rivals=()), {})
        yield record.model_copy(update={"sentence": whole})


def _require_scale(system: System, motions: Sequence[Motion]) -> None:
    """Refuse a device whose residual can be made zero by setting all free parameters to zero."""
    free = [i for i, item in enumerate(system.parameters) if not item.fixed]
    if not free or not all(system.linear[i] for i in free):
        return
    nothing = system.prior
    nothing[free] = 0.0
    for motion in motions:
        u = motion.inputs(system.inputs)
        sizes = []
        for p in (nothing, system.prior):
            z = system.memory(*motion.kinematics, u, p, motion.t)
            sizes.append(np.abs(system.residual(*motion.kinematics, z, u, p)).max())
        if not sizes[0] <= 1e-12 * sizes[1]:
            return
    names = join_names((system.parameters[i].name for i in free), _MANY)
    raise refusal("no_scale", f"device {system.model.device.name!r}", names=names)


def _find_placeholders(system: System, session: IngestResult) -> dict[str, tuple[str, ...]]:
    """Find scales of exactly 1 that nobody has filled in, as clauses, with the signals they scale.

    These are counts of encoders, calibrations, and constants that multiply an input.
    """
    found: dict[str, tuple[str, ...]] = {
        f"counts_per_unit of {axis} is 1": (axis,)
        for axis, encoder in session.axes.items()
        if encoder.counts_per_unit is not None and abs(encoder.counts_per_unit) == 1.0
    }
    force = session.force
    if force.raw_unit == "V":
        ones = tuple(
            name
            for name, row in zip(force.columns, force.calibration, strict=True)
            if sorted(map(abs, row)) == [0.0] * (len(row) - 1) + [1.0]
        )
        if ones:
            found[f"calibration_n_per_v of {', '.join(ones)} is 1"] = ones
    device = system.model.device
    nodes = (node for tree in device.applied.values() for node in ast.walk(tree))
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    inputs = tuple(name for name in (*device.forces, *device.channels) if name in used)
    for name, constant in device.constants.items():
        if name in used and constant.value == 1.0 and constant.unit and constant.sd is None:
            source = f", source {constant.source!r}" if constant.source else ""
            found[f"{name} of the device file is 1 {constant.unit}{source}"] = inputs
    return found


def describe_correction(correction: Correction, session: IngestResult) -> str:
    """Describe a mistake without a full stop: the fault, a colon, the remedy in session.toml."""
    if correction.kind == "exchange":
        return f"{join_names(correction.signals)} are exchanged: exchange their columns"
    if correction.change.gravity is not None:
        shown = ", ".join(f"{v:.4g}" for v in correction.change.gravity)
        return sentence("other_gravity", shown=shown)
    describe = {"clock": _clock, "zero": _zero, "sign": _sign, "scale": _scale}[correction.kind]
    return describe(correction, session)


def describe_evidence(
    system: System, axes: list[int], before: Plausibility, after: Plausibility
) -> str:
    """Describe the effect of a correction: errors of ``axes``, and implausible parameters."""
    parts = [
        f"error of {system.coordinates[i]} falls from {_fall(i, before, after)}"
        for i in axes
        if after.error[i] < before.error[i] / 1.5
    ]
    back = [
        f"{item.name} goes from {old:.3g} to {new:.3g} {item.unit}, where {item.prior:g} ±"
        f" {item.sd:g} is expected"
        for item, old, new in zip(system.parameters, before.p, after.p, strict=True)
        if abs(distance_from_prior(item, old)) > abs(distance_from_prior(item, new)) + 1.0
    ]
    said = "; ".join(parts or back[:3])
    if after.unexplained is not None:
        return said
    if not said:
        named = join_names([system.coordinates[i] for i in axes])
        agree = f"weight, inertia and friction of {named} agree"
        every = len(axes) == len(system.coordinates)
        said = "all drives differ by one factor" if every else agree
    return f"with bodies as drawn, {said}"


def _fall(axis: int, before: Plausibility, after: Plausibility) -> str:
    shares = before.error[axis], after.error[axis]
    said = [f"{100.0 * x:.0f} %" if x >= 0.1 else f"{100.0 * x:.2g} %" for x in shares]
    # Very large percentages are not given in full.
    said = ["over 1000 %" if x >= 10.0 else text for x, text in zip(shares, said, strict=True)]
    return f"{' to '.join(said)} of the applied force"


def format_factor(value: float) -> str:
    """Format a factor with three digits, without powers of ten if it is short."""
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e6 else f"{value:.3g}"


def _describe_factor(factor: float, more: str, less: str) -> str:
    """Say that something is ``factor`` times too ``more``, or the inverse times too ``less``."""
    size, word = (factor, more) if factor > 1.0 else (1.0 / factor, less)
    return f"{format_factor(size)} times too {word}"


def _sign(correction: Correction, session: IngestResult) -> str:
    names = correction.signals
    if len(names) > 1:
        if names[0] in session.force.columns:
            return sentence("all_signs", names=join_names(names), entry=_force_entry(session))
        return f"{join_names(names)} have the wrong sign: negate their columns"
    name = names[0]
    if name in session.axes:
        counts = session.axes[name].counts_per_unit
        fix = "negate counts_per_unit" if counts else "negate gear_ratio, 1 where left out"
        return f"the encoder of {name} counts the other way: {fix}"
    entry = f"scale of channels.{name}" if name in session.channels else "its column"
    if name in session.force.columns:
        if len(session.force.columns) == 1:
            return f"{name} has the wrong sign: put reaction = true into [force], or take it out"
        entry = _force_entry(session) + " in its row"
    return f"{name} has the wrong sign: negate {entry}"


def _scale(correction: Correction, session: IngestResult) -> str:
    fixes = dict.fromkeys(_scale_fix(name, correction, session) for name in correction.signals)
    channels = [f"channels.{name}" for name in correction.signals if name in session.channels]
    if len(channels) == len(correction.signals) > 1:
        factor = format_factor(correction.factor)
        fixes = {f"multiply scale of {join_names(channels)} by {factor}": None}
    verb = "read" if len(correction.signals) > 1 else "reads"
    off = _describe_factor(correction.factor, "little", "much")
    like = f", as {correction.meant} read as {correction.stated}" if correction.meant else ""
    return f"{join_names(correction.signals)} {verb} about {off}{like}: {'; '.join(fixes)}"


def _scale_fix(name: str, correction: Correction, session: IngestResult) -> str:
    factor = correction.factor
    if name in session.axes:
        encoder = session.axes[name]
        if encoder.counts_per_unit:
            stated = encoder.counts_per_unit
            right = format_factor(stated / factor)
            return f"counts_per_unit of {name} should be about {right}, not {format_factor(stated)}"
        if correction.meant and encoder.raw_unit == correction.stated:
            return f'unit = "{correction.meant}"'
        return f"gear_ratio = {format_factor(1.0 / factor)}"
    if name in session.force.columns:
        if correction.meant and session.force.raw_unit == correction.stated:
            return f'unit = "{correction.meant}" of [force]'
        row = " of its row" if len(correction.signals) < len(session.force.columns) else ""
        return f"multiply {_force_entry(session)}{row} by {format_factor(factor)}"
    return f"multiply scale of channels.{name} by {format_factor(factor)}"


def _force_entry(session: IngestResult) -> str:
    return "calibration_n_per_v" if session.force.raw_unit == "V" else "the columns of [force]"


def _zero(correction: Correction, session: IngestResult) -> str:
    axis = correction.signals[0]
    encoder = session.axes[axis]
    off = correction.offset
    size = f"{math.degrees(off):.3g}°" if encoder.unit == "rad" else f"{off:.3g} m"
    zero = encoder.zero - off / encoder.scale
    return f"the zero of {axis} is off by {size}: zero_counts should be about {zero:.6g}"


def _clock(correction: Correction, session: IngestResult) -> str:
    how = _describe_factor(correction.factor, "fast", "slowly")
    return sentence("clock", how=how, rate=session.sample_rate_hz / correction.factor)
