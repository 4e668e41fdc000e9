"""Faulty readings: wild ones, dead stretches, and readings at a rail."""

from collections.abc import Sequence

import numpy as np

from bampipe.arrays import Array, Flags, find_runs
from bampipe.data.angle_torque import MOST_ROWS, SmoothedMotion, least_squares
from bampipe.data.quality.channels import fill_missing, take_out
from bampipe.data.quality.table import TrialTable, longest_run
from bampipe.results.ingest import DeadStretch

POSITION, INPUT = (0.95, 20.0), (0.5, 40.0)
"""A reading is wild this many times farther from its neighbours than so large a share of the
readings is. What a position does between three samples is curvature, which has its extremes; an
input jumps with the friction of every reversal, and its median tells its noise."""
_CALM = 0.05
"""Share of that by which its neighbours may change their pace: a machine at a stop turns round, and
the kick of a controller leaves its drive unsteady."""
_LEAP, _OFTEN, _ALIKE = 6.0, 3, 0.1
"""Curvature of a leap of an axis over the median curvature, if there is any; fewest such leaps;
share of their height by which the pulses of one train differ."""
_LONGEST_SPIKE = 2
"""Most samples of one spike."""
_ROUNDING = 1e-6
"""Share of the range below which a change is no step of the sensor."""
_SHORTEST_S = 0.1
_CHANCE = 1e-9
"""Chance of so long a run of equal readings, by the share of equal neighbours in the rest."""
_UNSTEADY = 0.1
"""Least share of changes that take back the one before: readings with noise, no set-points."""
_MOST_DEAD = 0.2
"""Share of the trial beyond which such runs are steps of a command."""
_MOVES = 0.02
"""Share of its travel in the trial that some axis covers meanwhile."""
_TIMES_BESIDE = 5
"""Least ratio of the readings at a rail to those at any level near it."""
_LONGEST_RUN = 5
"""Fewest samples in the longest run at a rail."""
_LEAST_AT_RAILS, _MOST_AT_RAILS = 0.005, 0.6
"""Share of samples at rails: below, they are ignored; above, the column is rather a command."""
_FEWEST_LEVELS = 50
"""Fewest different readings of a column that moves continuously rather than in steps."""
_BESIDE = 10
"""Number of levels next to a rail with which it is compared."""
_EXPLAINED = 0.5
"""Share of the variance between the rails that the motion must explain to predict it beyond."""
_ONE_STEP, _MATTERS = 0.85, 1e-3
"""Least share of an input's residual that one step explains; least residual, of its variance."""
_BEYOND = 2.0
"""Least mean excess of the predicted input over the rail, in deviations of its residual."""


def find_spikes(values: np.ndarray, rule: tuple[float, float]) -> np.ndarray:
    """Tell which of finite readings (T,) are wild by a rule, `POSITION` or `INPUT`; (T,) bool."""
    wild = np.zeros(values.size, dtype=bool)
    if values.size < _LONGEST_SPIKE + 4:
        return wild
    share, far = rule
    changes = np.abs(np.diff(values))
    changes = changes[changes > _ROUNDING * np.ptp(values)]
    step = float(changes.min()) if changes.size else 0.0
    for width in range(1, _LONGEST_SPIKE + 1):
        end = values.size
        before, after = values[1 : end - width - 2], values[width + 2 : end - 1]
        pace = (after - before) / (width + 1)
        off = np.stack(
            [values[2 + k : end - width - 1 + k] - before - (k + 1) * pace for k in range(width)]
        )
        least = np.abs(off).min(axis=0)
        turn = np.maximum(
            np.abs(pace - before + values[: end - width - 3]),
            np.abs(pace - values[width + 3 :] + after),
        )
        limit = far * max(float(np.quantile(least, share)), 0.5 * step)
        one_sided = np.abs(np.sign(off).sum(axis=0)) == width
        starts = 2 + np.flatnonzero(one_sided & (least > limit) & (turn < _CALM * least))
        for k in range(width):
            wild[starts + k] = True
    return wild


def find_wild_inputs(values: Array, positions: Sequence[Array]) -> Flags:
    """Tell which finite readings (T,) of an input are wild, (T,).

    Not those of a usual size during which an axis turns back and forth: friction turns with it. Nor
    any if most come where an axis leaps, as a controller answers it, or as a train of equal pulses.

    ``positions``: of each axis, (T,), NaN where they are wild themselves.
    """
    wild = find_spikes(values, INPUT)
    if not wild.any():
        return wild
    low, high = np.quantile(values[~wild], (0.01, 0.99))
    changes = [np.diff(q) for q in positions]
    bends = [np.abs(np.diff(each)) for each in changes]
    some = [np.append(x[x > _ROUNDING * np.nanmax(x)], np.inf) for x in bends]
    leaps = [x > _LEAP * np.median(usual) for x, usual in zip(bends, some, strict=True)]
    answers = 0
    starts, stops = find_runs(wild)
    for start, stop in zip(starts, stops, strict=True):
        usual = np.all((low < values[start:stop]) & (values[start:stop] < high))
        steps = [each[[start - 2, start - 1, stop - 2, stop]] for each in changes]
        turns = any(x[0] * (x[1] + x[2]) < 0.0 and x[3] * (x[1] + x[2]) < 0.0 for x in steps)
        answers += any(each[start - 2 : stop + 1].any() for each in leaps)
        wild[start:stop] = not (usual and turns)
    pulses = values[starts]
    even = len(starts) > _OFTEN and np.ptp(np.diff(starts)) <= 1
    train = even and np.ptp(pulses) < _ALIKE * np.abs(pulses).max()
    return wild & (not train and answers < max(_OFTEN, 0.5 * len(starts)))


def interpolate_spikes(table: TrialTable) -> None:
    """Take wild readings of positions and inputs out and interpolate them, where they are few."""
    positions = {e.column: table.columns[e.column] for e in table.session.encoders}
    wild_of = {column: find_spikes(values, POSITION) for column, values in positions.items()}
    sound = [np.where(wild_of[column], np.nan, values) for column, values in positions.items()]
    wild_of |= {c: find_wild_inputs(table.columns[c], sound) for c in table.inputs}
    few = {c: w for c, w in wild_of.items() if 0 < w.sum() <= table.limits.nan_share * len(w)}
    for column, wild in few.items():
        take_out(table, column, wild)
    if few:
        fill_missing(table)


def note_dead_stretches(table: TrialTable) -> None:
    """Note where an input reads one value for longer than chance would have it."""
    positions = [table.columns[encoder.column] for encoder in table.session.encoders]
    for column in table.inputs:
        for start, stop in find_equal_runs(table.columns[column], table.t):
            travel = [np.ptp(q[start:stop]) / max(float(np.ptp(q)), 1e-300) for q in positions]
            if max(travel, default=0.0) > _MOVES:
                first, last = float(table.t[start]), float(table.t[stop - 1])
                table.dead.append(DeadStretch(column=column, start_s=first, end_s=last))


def find_equal_runs(values: np.ndarray, t: np.ndarray) -> list[tuple[int, int]]:
    """First and the one after the last of runs of equal readings (T,) that chance does not give.

    ``t``: (T,) time stamps, s.
    """
    changes = np.diff(values)
    moved = changes[changes != 0.0]
    # A set-point goes on the way it went, and an input at its limit stays there.
    if moved.size < 2 or np.mean(np.diff(np.sign(moved)) != 0.0) < _UNSTEADY:
        return []
    starts, stops = find_runs(changes == 0.0)
    stops = stops + 1
    long = t[stops - 1] - t[starts] >= _SHORTEST_S
    equal = int(np.sum((stops - starts - 1)[~long]))
    share = equal / max(equal + moved.size, 1)
    least = np.log(_CHANCE) / np.log(max(share, 1e-3)) if share < 1.0 else np.inf
    limits = {x: int(np.sum(values == x)) for x in (values.min(), values.max())}
    found = [
        (int(start), int(stop))
        for start, stop in zip(starts[long], stops[long], strict=True)
        # At the highest or lowest reading, no other sample may stand there, too.
        if least < stop - start >= limits.get(values[start], 0)
    ]
    return found if sum(stop - start for start, stop in found) < _MOST_DEAD * values.size else []


def find_rails(values: np.ndarray) -> dict[float, Flags]:
    """Extremes at which readings (T,) pile up: the samples (T,) at each."""
    levels, counts = np.unique(values, return_counts=True)
    rails = {}
    for rail, pile, beside in (
        (levels[-1], counts[-1], counts[-1 - _BESIDE : -1]),
        (levels[0], counts[0], counts[1 : 1 + _BESIDE]),
    ):
        at_rail, piled = values == rail, len(beside) > 1 and pile > _TIMES_BESIDE * beside.max()
        if piled and longest_run(at_rail)[1] >= _LONGEST_RUN:
            rails[float(rail)] = at_rail
    return rails


def leave_out_rails(table: TrialTable) -> None:
    """Leave out the readings of an input at a rail.

    A command that stands at its limit is all that the machine gets; a reading that does tells
    nothing. A sensor's volts are readings; of other inputs the motion says which of the two they
    are: regressed on it between the rails, an input goes on beyond them or does not.

    Raises:
        InputError: a sensor of a locked trial, which is used as a whole, is at a rail for long.
    """
    force, limits = table.session.force, table.limits
    sensed = force is not None and force.volts and limits.saturated_share < 1.0
    volts = force.columns if force is not None and sensed else ()
    motions = None
    for column in table.inputs:
        values = table.columns[column]
        rails = {rail: at for rail, at in find_rails(values).items() if rail != 0.0}
        share = float(sum(at.mean() for at in rails.values()))
        where = " and ".join(f"{rail:g}" for rail in sorted(rails))
        said = f"{share:.1%} of the samples stand at the rail {where}"
        most = limits.saturated_share if table.entry.kind == "locked" else _MOST_AT_RAILS
        if column in volts and share > most:
            at = int(np.argmax(np.any(list(rails.values()), axis=0)))
            raise table.fault("saturated", column, at, said=said, most=most)
        in_steps = len(np.unique(values)) < _FEWEST_LEVELS and column not in volts
        if not _LEAST_AT_RAILS <= share <= _MOST_AT_RAILS or in_steps:
            continue
        said = f"column '{column}': {said}"
        if column not in volts:
            motions = motions if motions is not None else _motions(table)
            farthest = _beyond(values, rails, motions)
            if farthest is None:
                table.notes.append(f"{said}; left in: the motion does not tell if it takes more")
            if not farthest:
                continue
            said += f", where the motion takes up to {farthest:.3g}"
        table.repairs.append(f"{said}: left out")
        for rail, at_rail in rails.items():
            for start, stop in zip(*find_runs(at_rail), strict=True):
                first, last = float(table.t[start]), float(table.t[stop - 1])
                table.dead.append(DeadStretch(column=column, start_s=first, end_s=last, rail=rail))


def _motions(table: TrialTable, every: int = 1) -> list[SmoothedMotion]:
    encoders = table.session.encoders
    positions = ((table.columns[e.column][::every] - e.zero) * e.scale for e in encoders)
    found = (SmoothedMotion.of(table.t[::every], q) for q in positions)
    return [motion for motion in found if motion is not None]


def _sides(motions: list[SmoothedMotion]) -> Array:
    """Regressors of a drive, (T, P)."""
    sides = [np.ones(len(motions[0].position))]
    for motion in motions:
        angle, by_direction = motion.position, np.abs(motion.moving[:, 1])
        sides += [*motion.moving.T, by_direction, angle, np.sin(angle), np.cos(angle)]
    return np.column_stack(sides)


@np.errstate(over="ignore", invalid="ignore")
def refuse_new_zero(table: TrialTable) -> None:
    """Refuse a trial in which a force sensor was re-zeroed: its unexplained part is a single step.

    Devices with another input that may be switched on, such as a brake, are not tested, nor are
    commands, which go in steps.
    """
    every = max(1, len(table) // MOST_ROWS)
    force, motions = table.session.force, _motions(table, every)
    if force is None or not motions or table.session.brakes or table.session.channels:
        return
    inner = motions[0].inner
    basis = np.linalg.qr(_sides(motions)[inner])[0]
    for column in force.columns:
        if not force.volts and len(np.unique(table.columns[column])) < _FEWEST_LEVELS:
            continue
        values = motions[0].smooth(table.columns[column][::every])[inner]
        rest = values - basis @ (basis.T @ values)
        # A step after each sample, as smooth as the rest, less what the motion takes of it.
        both = np.column_stack([rest, basis]).T
        along, *own = (np.cumsum(motions[0].smooth(x)[::-1])[::-1] for x in both)
        gain = along**2 / np.maximum(np.arange(len(rest), 0, -1) - np.square(own).sum(axis=0), 1.0)
        at, left = every * (int(np.argmax(gain)) + inner.start), float(rest @ rest)
        if gain.max() > _ONE_STEP * left and left > _MATTERS * values.size * np.var(values):
            raise table.fault("new_zero", column, at, t=table.t[at])


def _beyond(
    values: np.ndarray, rails: dict[float, Flags], motions: list[SmoothedMotion]
) -> float | None:
    """Farthest value beyond its rails that the motion asks of an input; 0: none, None: unknown."""
    if not motions:
        return None
    design, target = _sides(motions), motions[0].smooth(values)
    at_rail = np.any(list(rails.values()), axis=0)
    reached = np.convolve(at_rail, np.ones(2 * len(motions[0].window) + 1), "same") > 0.5
    between, inside = np.zeros(len(values), bool), np.zeros(len(values), bool)
    between[motions[0].inner], inside[motions[0].inner] = True, True
    between &= ~reached
    if between.sum() < 10 * design.shape[1]:
        return None
    found, rest = least_squares(design[between], target[between])
    left = float(np.std(rest))
    if left > np.sqrt(1.0 - _EXPLAINED) * float(np.std(target[between])):
        return None
    asked, farthest = design @ found, [0.0]
    for rail, here in rails.items():
        outwards = float(np.sign(rail - np.mean(values)))
        excess = outwards * (asked[here & inside] - rail)
        if len(excess) and np.mean(excess) > _BEYOND * left:
            farthest.append(rail + outwards * float(excess.max()))
    return max(farthest, key=abs)
