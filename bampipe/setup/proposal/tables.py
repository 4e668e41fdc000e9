"""The tables of a proposal that describe the columns, ``[time]`` to ``[channels]``."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.data import guesses
from bampipe.data.names import words
from bampipe.data.quality.clock import spread_stamps, unroll
from bampipe.data.refusals import refusal
from bampipe.data.session.channels import SECONDS, Register
from bampipe.data.stated_rate import interval_of
from bampipe.data.survey import Survey, SurveyedColumn
from bampipe.data.units import bare, spelled, unit
from bampipe.lists import join_names
from bampipe.physics.device import Coordinate, Device
from bampipe.results.rounding import rounded
from bampipe.setup.proposal.matching import Match, Matcher
from bampipe.setup.proposal.notes import UNKNOWN, Notes, entry, quoted
from bampipe.setup.proposal.positions import in_counts, is_force, is_velocity, needs_gain
from bampipe.setup.sentences import sentence

UNKNOWN_RATE = f'sample_rate_hz = "{UNKNOWN}"'
_RECORDED = ":@time"
"""End of the name under which the reader of ROS bags has the time of recording."""
_LIKELY_RATE_HZ = 100.0
"""Assumed for the other guesses where nothing shows the rate."""
_COUNTERS = frozenset(["tick", "ticks", "cycle", "cycles", "timestep", "timesteps", "cyccnt"])
"""Words in the name of a clock that counts at a rate of its own."""
_FRACTIONS = {"ns": 1e9, "us": 1e6, "ms": 1e3}
"""Units of the fraction beside whole seconds, and how many make one second."""
_OF_WINDOWS = (
    (1.2e17, 1.6e17, "100 ns, as Windows counts them since 1601"),
    (6.2e17, 6.6e17, "100 ns, as .NET counts them since the year 1"),
)
"""Least and largest stamp of today, and what it counts."""
_MIXED = 0.1
"""Share of steps at which times fall that are all different, of rows that stand out of order."""
_SLOW_HZ = 40.0
"""Below, accelerations of a joint that stops within a tenth of a second are not seen."""
_POSITION_UNITS = ("rad", "deg", "mrad", "rev", "m", "mm", "cm", "um", "in")
_SURE, _NEAR = 2.0, 0.025
"""Standard errors, and share, within which a usual number of counts is that of a turn."""
_ROUND = [digits * 10.0**n for digits in (1, 2, 3.6, 4, 5, 8) for n in (3, 4)]
_COUNTS = [*(2.0**n for n in range(8, 25)), *_ROUND]
_SPEED_UNITS = ("rad/s", "deg/s", "rev/s", "rev/min", "m/s", "cm/s", "mm/s", "in/s")
_FORCE_UNITS = ("N", "N.m", "mN", "kN", "mN.m", "N.cm", "N.mm", "kN.m", "kgf", "lbf", "kip", "V")
_QUANTITY = {"N": "force", "N.m": "torque", "A": "current", "V": "voltage"}
_MOST_VOLTS = 60.0
"""Highest voltage of a supply: servos count theirs in tenths of a volt."""
_FULL_DUTY = 1.05
"""Largest duty cycle as a share: 1, and a little more by rounding."""


@dataclass(frozen=True)
class ProposedClock:
    """The time of the first log, and how the session file says it.

    Attributes:
        t: (T,) time stamps, s; columns: those that hold the time.
        lines: those of the table ``[time]``; rate: the line on the sample rate, above all tables.
    """

    t: np.ndarray
    columns: tuple[str, ...]
    lines: Sequence[str]
    rate: str = UNKNOWN_RATE


def clock_of(found: Survey, notes: Notes) -> ProposedClock:
    """Propose a clock: by stamps in one column or two, else by counting samples."""
    numbered = [c for c in found.columns if c.may_number_rows]
    numbers = {c.name for c in numbered if c.by_looks or not c.role or found.intervals}
    unsaid = [c for c in found.columns if not c.role]
    counters = [c for c in unsaid if not _COUNTERS.isdisjoint(words(c.name))]
    steps = {c.name: np.diff(c.values) for c in unsaid if guesses.is_time(c.values)}
    even = {name for name, own in steps.items() if np.ptp(own) < np.median(own)}
    unnamed = [c for c in unsaid if c not in counters and c.name in even]
    whole = [c for c in found.of("time") if c.is_integer]
    for rest in reversed(whole):
        for seconds in reversed(whole):
            if unit := _fraction_of(seconds, rest):
                return _in_two_columns(seconds, rest, unit, notes)
    # When a message was recorded is the second best to when it was stamped.
    topics = {c.name.partition(":")[0] for c in found.of("position") if c.name[:1] == "/"}

    def rank(c: SurveyedColumn) -> tuple[bool, bool, bool]:
        # Interpolation does the motion more harm than its drive.
        beside = c.name.partition(":")[0] in topics or not topics
        return c.name.endswith(_RECORDED), "stamp" not in words(c.name), not beside

    stamped = [*sorted(found.of("time"), key=rank), *counters, *unnamed]
    rising = [c for c in stamped if c.name not in numbers and _increases(c.values)]
    return _in_one_column(rising[0], notes) if rising else _count_samples(found, notes)


def _in_one_column(column: SurveyedColumn, notes: Notes) -> ProposedClock:
    start = column.values[np.isfinite(column.values)][0]
    stamps = column.values - start
    known, rows = np.isfinite(stamps), np.arange(len(stamps))
    stamps = np.interp(rows, rows[known], spread_stamps(unroll(stamps[known])[0])[0])
    named = f"column = {quoted(column.name)}"
    named_unit = next((u for u in ("us", "ms", "ns", "min") if u in words(column.name)), "")
    counter = not _COUNTERS.isdisjoint(words(column.name)) or column.role != "time"
    plain = spelled(column.unit, tuple(SECONDS)) in SECONDS
    counter &= column.is_integer and not named_unit and not plain
    kind = "" if counter else guesses.time_unit(stamps + start, column.unit or named_unit)
    written = f"{column.name} {column.unit}"
    tick = re.search(r"(?<![\d.])(\d*\.?\d+) ?_?(ns|us|ms)(?![A-Za-z])", written)
    since = next((why for low, high, why in _OF_WINDOWS if low < start < high), "")
    if since or (tick and (counter or (column.si == "s" and not plain))):
        size = float(tick[1]) * SECONDS[tick[2]] if tick and not since else 1e-7
        why = since or f"{tick and tick[0]}, by its name"
        note = notes.guess(f"a count of {column.name} is {why}")
        lines = [named, 'unit = "ticks"', f"ticks_per_s = {1.0 / size:.10g}{note}"]
        t = stamps * size
        return ProposedClock(t, (column.name,), lines, _stamped_rate(t, notes))
    if not kind or (column.may_number_rows and not named_unit):
        if counter:
            note = notes.ask("ticks", clock=column.name, step=np.median(np.diff(stamps)))
            lines = [named, 'unit = "ticks"', f"ticks_per_s = 0.0{note}"]
        else:
            why = "it rises by 1 a row, as ms at 1000 Hz and numbers of rows do"
            why = why if column.may_number_rows else "no unit gives a likely rate"
            note = notes.ask("time_unit", why=why)
            lines = [named, f'unit = "{UNKNOWN}"{note}']
        return ProposedClock(np.arange(len(stamps)) / _LIKELY_RATE_HZ, (column.name,), lines)
    t = stamps * SECONDS.get(kind, 1.0)
    said = kind == "datetime" or spelled(column.unit, tuple(SECONDS)) == kind
    note = "" if said else notes.guess(f"time is in {kind}, by the rate that it gives")
    lines = [named, f'unit = "{kind}"{note}']
    return ProposedClock(t, (column.name,), lines, _stamped_rate(t, notes))


def _fraction_of(seconds: SurveyedColumn, rest: SurveyedColumn) -> str:
    """Unit of a column that starts again where whole seconds go on; "" if it does not."""
    most, ahead = float(np.max(rest.values)), np.diff(seconds.values)
    # By its size, unless some milliseconds were lost or it is rounded to a few of them.
    kind = next((u for u, size in _FRACTIONS.items() if 0.5 * size < most < size), "")
    again = np.diff(rest.values) < 0.0
    fits = kind and ahead.min() >= 0.0 and again.any() and rest.values.min() >= 0.0
    return kind if fits and np.array_equal(again, ahead > 0.0) else ""


def _in_two_columns(
    seconds: SurveyedColumn, rest: SurveyedColumn, kind: str, notes: Notes
) -> ProposedClock:
    """Propose whole seconds and a column of their fractions, as in ROS and C."""
    t = seconds.values - seconds.values[0] + (rest.values - rest.values[0]) / _FRACTIONS[kind]
    note = notes.guess(f"whole seconds in {seconds.name}, {kind} on top in {rest.name}")
    whole = "datetime" if seconds.stated == "datetime" else "s"
    lines = [f"column = {quoted(seconds.name)}", f'unit = "{whole}"']
    lines += [f"nanoseconds = {quoted(rest.name)}{note}"]
    lines += [f'fraction_unit = "{kind}"'] * (kind != "ns")
    return ProposedClock(t, (seconds.name, rest.name), lines, _stamped_rate(t, notes))


def _count_samples(found: Survey, notes: Notes) -> ProposedClock:
    """Propose to count samples if no column is a clock; a number beside them may give the rate."""
    samples = np.arange(len(found.columns[0].values))
    constants = {c.name: float(c.values[0]) for c in found.columns if c.is_constant}
    steps = {name: interval_of(name, value) for name, value in constants.items()}
    steps = {name: step for name, step in steps.items() if step > 0.0}
    steps |= {name: step for name, step in found.intervals.items() if name not in steps}
    rates = {name: float(f"{1.0 / step:.6g}") for name, step in steps.items()}
    name, rate_hz = next(iter(rates.items())) if len({*rates.values()}) == 1 else ("", 0.0)
    numbers = next((c for c in found.columns if not c.role and _numbers_rows(c)), None)
    if numbers is not None:
        why = f"{numbers.name} numbers the rows, some of which are lost, and {name} sets the rate"
        note = notes.guess(why) if name else notes.ask("row_numbers", clock=numbers.name)
        lines = [f"column = {quoted(numbers.name)}", 'unit = "ticks"']
        lines += [f"ticks_per_s = {rate_hz:g}{note}"]
        rate = f"sample_rate_hz = {rate_hz:g}" if name else UNKNOWN_RATE
        t = unroll(numbers.values - numbers.values[0])[0] / (rate_hz or _LIKELY_RATE_HZ)
        return ProposedClock(t, (numbers.name,), lines, rate)
    if name:
        note = notes.guess(f"samples are counted, and {name} sets the rate")
        taken = tuple(n for n in rates if n in constants)
        counted = (f'unit = "samples"{note}',)
        return ProposedClock(samples / rate_hz, taken, counted, f"sample_rate_hz = {rate_hz:g}")
    stamps = min(found.of("time"), key=lambda column: column.is_constant, default=None)
    why = "no column increases like a time"
    if stamps is not None and stamps.is_constant:
        why = f"{stamps.name} is {stamps.values[0]:g} in all rows; were its last digits printed?"
    elif stamps is not None:
        steps = np.diff(stamps.values[np.isfinite(stamps.values)])
        if np.all(steps) and _MIXED < np.mean(steps < 0.0):
            raise refusal("out_of_order", found.trials[0].file, column=stamps.name)
        why = f"{stamps.name} falls at {np.sum(steps < 0)} and stands at {np.sum(steps == 0)} steps"
        why = why if steps.min() <= 0 else f"{stamps.name} numbers the rows"
    if rates:
        why += f", and the rates are {join_names(f'{rates[n]:g} Hz by {n}' for n in rates)}"
    note = notes.guess(f"samples are counted: {why}")
    rate = UNKNOWN_RATE + notes.ask("rate")
    return ProposedClock(samples / _LIKELY_RATE_HZ, (), (f'unit = "samples"{note}',), rate)


def _numbers_rows(column: SurveyedColumn) -> bool:
    """Whether a column counts rows, some of which are lost."""
    steps = np.diff(unroll(column.values)[0]) if column.is_integer else np.zeros(1)
    return bool(np.min(steps, initial=1.0) >= 1.0 and np.median(steps) == 1.0 < np.max(steps))


def _stamped_rate(t: np.ndarray, notes: Notes) -> str:
    (slowest, fastest), rate_hz = guesses.RATES_HZ, guesses.sample_rate(t)
    doubt = "" if rate_hz > _SLOW_HZ else "; too slow for inertia and quick reversals: log faster"
    if not slowest <= rate_hz <= fastest:
        return UNKNOWN_RATE + notes.ask("time_unit", why=f"{rate_hz:g} Hz is no rate of motion")
    note = notes.guess(f"{rate_hz:g} Hz, from the time stamps{doubt}")
    return f"sample_rate_hz = {rate_hz:g}{note}"


def _increases(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    known = spread_stamps(unroll(known)[0])[0] if len(known) > 3 else known
    return len(known) > 3 and float(np.mean(np.diff(known) > 0)) > 0.9


def encoders_table(device: Device, match: Matcher) -> tuple[list[str], dict[str, SurveyedColumn]]:
    """Propose the column of every axis; its lines, and the columns found, by axis."""
    lines = ["[encoders]"]
    axes: dict[str, SurveyedColumn] = {}
    for axis in device.coordinates:
        column = match.position(axis.name)
        if column is None:
            note = match.notes.ask_column(f"the position of {axis.name}", axis.unit)
            lines.append(f"{axis.name} = {entry(UNKNOWN, axis.unit)}{note}")
            continue
        axes[axis.name] = column
        match.used.add(column.name)
        table = _encoder(axis, column, match)
        if register := match.registers.get(column.name):
            table = table.replace(" }", f"{register.fields} }}", 1)
            match.notes.check.append(f"{column.name} is {register.words}")
        if pairs := match.of_another(column):
            named = ", ".join(f"{quoted(one)} = {quoted(other)}" for one, other in pairs.items())
            table = table.replace(quoted(column.name), quoted(UNKNOWN), 1) + match.notes.ask(
                "which", column=column.name, other=pairs[column.name], pairs=named
            )
        lines.append(f"{axis.name} = {table}")
    return [*lines, ""], axes


def _encoder(axis: Coordinate, column: SurveyedColumn, match: Matcher) -> str:
    if is_velocity(column):
        return _integrated(axis, column, match.notes)
    if in_counts(column):
        return _counted(axis, column, match)
    worth, said = match.turning.get(column.name), spelled(column.unit, _POSITION_UNITS)
    if worth is not None and column.si is not None:
        turns, sd = (column.scale * part for part in (worth.size, worth.sd))
        fields = f", gear_ratio = {turns:.4g}, zero_counts = {worth.zero:.4g}"
        fields += f", scale_sd = {rounded(sd / turns, 1)}"
        of = {"column": column.name, "axis": axis.name, "turns": turns, "sd": rounded(sd, 1)}
        return entry(column.name, said, fields) + match.notes.guess(sentence("geared", **of))
    if column.name == match.geared:
        return entry(column.name, said, ", gear_ratio = 0.0") + match.notes.ask(
            "gear", axis=axis.name, column=column.name
        )
    right, geared = column.si == axis.unit, axis.name in match.robot.gears
    if column.si == "V":
        return entry(column.name, UNKNOWN) + match.notes.ask("volts_of_position", column.name)
    if (column.by_looks or column.is_foreign) and not right:
        why = f"which looks like the position of {axis.name}"
        why = f"stated as '{column.stated}'" if column.is_foreign else why
        note = match.notes.ask("position_unit", f"{column.name}, {why}")
        return entry(column.name, UNKNOWN, _velocity_beside(axis, match)) + note
    if not right and worth is not None:
        return entry(column.name, UNKNOWN) + match.notes.ask(
            "position_unit_by_weight", column=column.name, axis=axis.name, size=worth.size,
            sd=rounded(worth.sd, 1), turn=2.0 * np.pi * worth.size,
        )  # fmt: skip
    by_size = "" if right else guesses.likely_unit(axis.unit, column.values)
    said = (said if right else by_size) or axis.unit
    fields, how = _counting(axis, said, match, match.robot.gears.get(axis.name, 1.0))
    fields += "" if geared else _velocity_beside(axis, match)
    guess = f"is the position of {axis.name}, in {said}" + (", by its size" if by_size else "")
    if geared:
        guess = f"is the position of the motor of {axis.name}, in {said}"
    elif right:
        guess = "" if column.stated or how else f"is in {bare(column.unit)}"
    guess += ("; it " if guess and how else "") + how
    return entry(column.name, said, fields) + (
        match.notes.guess(f"{column.name} {guess}") if guess else ""
    )


def _counting(axis: Coordinate, said: str, match: Matcher, turns: float = 1.0) -> tuple[str, str]:
    """Fields of an encoder that counts differently from a robot's drawing, and the same in words.

    ``turns``: turns of the encoder's shaft for one of the axis.
    """
    direction, zero = match.robot.counting.get(axis.name, (1.0, 0.0))
    fields, ways = match.scale_sd.get(axis.name, ""), []
    if direction * turns != 1.0:
        fields += f", gear_ratio = {direction * turns:.10g}"
    if direction < 0.0:
        ways.append("counts the other way than the drawing")
    if zero:
        known = unit(said)
        reading = -direction * zero * turns / (known.scale if known is not None else 1.0)
        fields += f", zero_counts = {reading:.5g}"
        ways.append(f"reads {reading:.4g} {said} where the drawing has 0")
    why = ", by weight and inertia as drawn: look it up in the controller's manual"
    return fields, " and ".join(ways) + why if ways else ""


def _integrated(axis: Coordinate, column: SurveyedColumn, notes: Notes) -> str:
    si = f"{axis.unit}/s"
    if column.is_foreign:
        return entry(column.name, UNKNOWN) + notes.ask(
            "velocity_unit", column=column.name, stated=column.stated
        )
    said = (spelled(column.unit, _SPEED_UNITS) if column.si == si else "") or si
    integral = f"that of {axis.name} is the integral of {column.name}, in {said}"
    return entry(column.name, said) + notes.guess(f"no position was recorded: {integral}")


def _counted(axis: Coordinate, column: SurveyedColumn, match: Matcher) -> str:
    """The entry of an encoder that counts; the weight of a joint may show what a count is worth."""

    def count(size: str, zero: float, scale_sd: str = "") -> str:
        counting = f"counts_per_unit = {size}, zero_counts = {zero:.0f}{scale_sd}"
        return f'{{ column = {quoted(column.name)}, {counting}, unit = "{axis.unit}" }}'

    worth = match.turning.get(column.name)
    if worth is not None:
        turn, sd = 2.0 * np.pi * worth.size, 2.0 * np.pi * worth.sd
        usual = min(_COUNTS, key=lambda counts: abs(turn - counts))
        is_usual = abs(turn - usual) < max(_SURE * sd, _NEAR * usual)
        size = f"{(usual if is_usual else turn) / (2.0 * np.pi):.6g}"
        scale_sd = "" if is_usual else f", scale_sd = {rounded(sd / turn, 1)}"
        taken = f" ({usual:.0f}, as encoders have, is taken)" if is_usual else ""
        of = {"column": column.name, "axis": axis.name, "turn": turn, "sd": rounded(sd, 1)}
        said = sentence("counts", **of, taken=taken, zero=worth.zero)
        return count(size, worth.zero, scale_sd) + match.notes.guess(said)
    drawn = " of what is read where the drawing has 0" if match.robot.joints else ""
    ask = match.notes.ask(f"counts_{axis.unit}", axis.name, zero=drawn)
    return count("0.0", float(np.median(column.values))) + ask


def _velocity_beside(axis: Coordinate, match: Matcher) -> str:
    """The field of a recorded velocity, against which the position is checked; "" without one."""
    for column in match.found.of("velocity"):
        fits = column.si == f"{axis.unit}/s" and not column.is_constant
        if fits and (match.axes == 1 or axis.name in words(column.name)):
            match.used.add(column.name)
            match.notes.check.append(f"{column.name} is used to check the position only")
            return f", velocity = {entry(column.name, bare(column.unit))}"
    return ""


def input_tables(device: Device, axes: Mapping[str, SurveyedColumn], match: Matcher) -> list[str]:
    """Propose the column of every input; the lines of those tables that have something to say."""
    wanted = {**dict.fromkeys(device.forces, device.force_unit), **device.channels}
    given = match.inputs(wanted, tuple(axes.values()))
    lines, notes = list[str](), match.notes
    sensed = all(name.startswith("force_") for name in device.forces)
    forces = [column for name in device.forces if (column := given[name][0]) is not None]
    if sensed and len(forces) in (0, len(device.forces)):
        match.used |= {column.name for column in forces}
        names = [column.name for column in forces] or [UNKNOWN] * len(device.forces)
        missing = " and ".join(device.forces)
        ask = "" if forces else notes.ask_column(missing, device.force_unit, "driving_column")
        unit_of = [f'unit = "{device.force_unit}"']
        if forces:
            why = given[device.forces[0]][1]
            unit_of = _force_unit(device, forces, why, match.of_motor, match.notes)
        lines += [
            "[force]",
            f"columns = [{', '.join(map(quoted, names))}]{ask}",
            f"components = [{', '.join(map(quoted, device.components))}]",
            *unit_of,
            "",
        ]
        if match.reacting in {column.name for column in forces}:
            lines.insert(-1, "reaction = true" + notes.guess(f"{match.reacting} is the reaction"))
        wanted = dict(device.channels)
    lines += _brakes_table(device, match)
    return lines + _channels_table(wanted, given, match)


def _force_unit(
    device: Device, columns: list[SurveyedColumn], why: str, of_motor: str, notes: Notes
) -> list[str]:
    """The unit that all force columns share, and what makes forces of volts or of counts.

    ``of_motor``: the column of the torque of a motor whose joint is what was logged, by name.
    """
    units = {spelled(bare(column.unit), _FORCE_UNITS) for column in columns}
    common = units.pop() if len(units) == 1 else ""
    known = unit(common)
    names = ", ".join(quoted(column.name) for column in columns)

    def ask_unit(question: str, **known: str) -> list[str]:
        return [f'unit = "{UNKNOWN}"{notes.ask(question, columns=names, **known)}']

    if columns[0].name == of_motor:
        return ask_unit("motor_torque_unit")
    if known is not None and known.si == device.force_unit and common:
        stated = all(column.stated for column in columns)
        guess = f"{names} is a {_QUANTITY[known.si]} in {common}"
        return [f'unit = "{common}"' + ("" if stated else notes.guess(guess))]
    if len({unit(column.unit) for column in columns if column.unit}) > 1:
        return ask_unit("one_force_unit", units=join_names([column.unit for column in columns]))
    counted = any(map(needs_gain, columns))
    if common == "V" or counted:
        row = f"[{', '.join(['0.0'] * len(columns))}]"
        rows = f"[{', '.join([row] * len(columns))}]"
        of_what = f"of {names}" if counted else "volt"
        ask = notes.ask("calibration", si=device.force_unit, of_what=of_what)
        if counted:
            volts = notes.guess(f"{names} counts or is a share: like volts it gets a calibration")
            zero = notes.guess(f"{names} is 0 without force")
        else:
            volts = notes.guess("the force channels are volts, by their names")
            zero = notes.ask("zero_volts")
        return [f'unit = "V"{volts}', f"calibration_n_per_v = {rows}{ask}", f"zero_v = {row}{zero}"]
    odd = next((column for column in columns if column.is_foreign), None)
    if odd is not None or any(c.by_looks or not (c.role or c.unit or why) for c in columns):
        looks = "which looks like what drives the motion"
        return ask_unit("force_unit", why=f"stated as '{odd.stated}'" if odd is not None else looks)
    other = next(
        (c for c in columns if c.si not in (None, "", "V", "kg", "N", device.force_unit)), None
    )
    if other is not None:
        return ask_unit("no_force", column=other.name, unit=bare(other.unit))
    note = ""
    if any(column.si == "kg" for column in columns):
        common = next(unit for unit in ("kgf", "gf") if columns[0].unit.startswith(unit[:-1]))
        note = notes.guess(f"{names} is the weight of a mass: a force in {common}")
    if device.force_unit == "N.m" and any(map(is_force, columns)):
        note = note or ("" if common else notes.guess(f"{names} is a force in N"))
        ask = notes.ask("lever", columns=names)
        return [f'unit = "{common or "N"}"{note}', f"lever_m = 0.0{ask}"]
    if note:
        return [f'unit = "{common}"{note}']
    note = notes.guess(f"{names} is a {_QUANTITY[device.force_unit]} in {device.force_unit}{why}")
    return [f'unit = "{device.force_unit}"{note}']


def _brakes_table(device: Device, match: Matcher) -> list[str]:
    brakes = {axis: c for axis, n in device.brakes.items() if (c := match.named(n, "brake"))}
    if not brakes:
        return []
    match.used |= {column.name for column in brakes.values()}
    units = ", ".join(device.coordinate(axis).torque_unit for axis in brakes)
    return [
        "[brakes]",
        f"columns = [{', '.join(quoted(column.name) for column in brakes.values())}]",
        f'unit = "{units}"' + match.notes.guess("brake commands are in SI units"),
        "",
    ]


def _channels_table(
    wanted: Mapping[str, str], given: Mapping[str, Match], match: Matcher
) -> list[str]:
    """Lines for the inputs ``wanted``, by name, with their SI units; none if nothing is."""
    if not wanted:
        return []
    lines = ["[channels]"]
    for name, si in wanted.items():
        column, why = given[name]
        if column is None:
            lines.append(f"{name} = {entry(UNKNOWN, si)}{match.notes.ask_column(name, si)}")
            continue
        match.used.add(column.name)
        lines.append(f"{name} = {_channel(name, si, column, why, match)}")
    return [*lines, ""]


def _channel(name: str, si: str, column: SurveyedColumn, why: str, match: Matcher) -> str:
    """Column and unit of one input; its register or its scale, if the unit is not enough."""
    register, notes = match.registers.get(column.name), match.notes
    fields = register.fields if register else ""
    turned = name in match.robot.turned or column.name == match.reacting
    fields += (", scale = -1.0" if turned else "") + match.scale_sd.get(name, "")
    slides = (column.si, si) == ("N", "N.m")  # the drive of a sliding joint
    if column.si == si or slides:
        table = entry(column.name, bare(column.unit), fields)
        if column.stated and not why and register is None:
            return table
        return table + notes.guess(f"{column.name} is {name}{why}{_unscaled(si, column, register)}")
    if column.is_foreign and si and not register:
        ask = notes.ask("channel_unit", column=column.name, stated=column.stated)
        return entry(column.name, UNKNOWN, fields) + ask
    if register and si and not column.unit:
        ask = notes.ask("register_unit", column=column.name, register=register.words)
        return entry(column.name, UNKNOWN, fields) + ask
    if si == "A" and column.is_integer and not column.unit:
        return entry(column.name, UNKNOWN, fields) + notes.ask("current_unit", column=column.name)
    if column.si not in (None, si):
        ask = notes.ask("rated", name, si=si, unit=bare(column.unit))
        return entry(column.name, si, f"{fields}, scale = 0.0") + ask
    likely = si if register else guesses.likely_unit(si, column.values) or si
    if name == "supply" and column.is_integer and float(np.nanmedian(column.values)) > _MOST_VOLTS:
        likely = "0.1V"
    if name == "duty" and not column.unit:
        most = float(np.nanmax(np.abs(column.values)))
        if most > 100.0:
            said = f", {register.words}" if register else ""
            ask = notes.ask("duty", name=name, column=column.name, register=said)
            return entry(column.name, "", f"{fields}, scale = 0.0") + ask
        if most > _FULL_DUTY:
            likely = "%"
    where = f" in {likely}" if si else ""
    doubt = "" if likely[:1].isdigit() else _unscaled(si, column, register)
    return entry(column.name, likely, fields) + notes.guess(
        f"{column.name} is {name}{where}{why}{doubt}"
    )


def _unscaled(si: str, column: SurveyedColumn, register: Register | None) -> str:
    """Remark on a column that may be in counts, or is a register."""
    if register:
        return f", {register.words}: give its scale"
    counts = column.is_integer and not column.unit and si
    return "; if in counts, give their scale too" if counts else ""
