"""Force, brake and other channels: units, signs, missing, frozen or saturated samples."""

from collections.abc import Mapping

import numpy as np

from bampipe.arrays import find_runs
from bampipe.data.quality.table import TrialTable, longest_run
from bampipe.data.session.channels import Channel, Encoder, Register
from bampipe.data.session.conversion import Conversion
from bampipe.data.units import unit
from bampipe.lists import count_noun
from bampipe.results.ingest import DeadStretch

_MOST_MISSING, _AROUND_S = 0.2, 0.1
"""Share of the trial that long gaps may leave out, and s on either side that a filter smears."""
LARGEST_VALUE = 1e6
"""No angle, force, torque or other input is as large as this in SI units."""


def to_declared_units(table: TrialTable, stated: Mapping[str, str]) -> None:
    """Convert columns that the trial has in other units than the tables of the session file.

    InputError where the unit in the file is not that of the session file.
    """
    usual = table.session.raw_units
    declared = usual | table.entry.units
    for column, text in table.entry.units.items():
        here, there = unit(text), unit(usual.get(column, ""))
        if here is None or there is None or here.si != there.si:
            raise table.fault("no_unit", column, unit=text, declared=usual.get(column, "none"))
        table.columns[column] *= here.scale / there.scale
        table.notes.append(f"column '{column}' converted from {text} to {usual[column]}")
    for column, text in stated.items():
        found, expected = unit(text), unit(declared.get(column, ""))
        if found is None or expected is None or "" in (found.si, expected.si):
            continue
        if found.si == "V" and declared[column][:1].isdigit():
            continue  # what a volt of a sensor is worth
        if found.si == "kg":  # the weight of a mass
            found = unit(f"{text.strip('[]() ')}f") or found
        if found == unit("Hz") and expected.si == "rad/s":  # turns a second
            found = unit("rev/s") or found
        if (found.si, found.scale) != (expected.si, expected.scale):
            of = {"unit": text, "declared": declared[column], "column": column}
            raise table.fault("other_unit", column, **of)


def fill_missing(table: TrialTable) -> None:
    """Interpolate missing samples, drop them at the ends; long runs are left out."""
    channels = [name for name in table.columns if name != table.clock]
    unknown = {name: ~np.isfinite(table.columns[name]) for name in channels}
    some = np.logical_or.reduce([*unknown.values()])
    if not some.any():
        return
    for name, missing in unknown.items():
        if missing.all():
            raise table.fault("no_number", name)
    sound = np.flatnonzero(~some)
    if len(sound) == 0:
        raise table.fault("no_row")
    # Sensors that begin late or end early leave the rest as it is.
    start, stop = int(sound[0]), int(sound[-1]) + 1
    if (start > 0 or stop < len(table)) and 2 * (stop - start) >= len(table):
        dropped = count_noun(len(table) - (stop - start), "row")
        table.keep(slice(start, stop))
        table.repairs.append(f"{dropped} with missing samples at the ends dropped")
    for name in channels:
        values = table.columns[name]
        missing = ~np.isfinite(values)
        if missing.any():
            _refuse_missing(table, name, missing)
            values[missing] = np.interp(table.t[missing], table.t[~missing], values[~missing])
            for start, stop in zip(*find_runs(missing), strict=True):
                if stop - start > table.limits.nan_run:
                    first, last = table.t[[start, stop - 1]] - table.t[0] + (-_AROUND_S, _AROUND_S)
                    ends = {"start_s": max(0.0, float(first)), "end_s": float(last)}
                    table.dead.append(DeadStretch(column=name, missing=True, **ends))
            table.repairs.append(
                f"column '{name}': {count_noun(int(missing.sum()), 'missing sample')} interpolated"
            )


def take_out(table: TrialTable, column: str, wild: np.ndarray) -> None:
    """Mark wild readings (T,) of a column as missing, and say so; `fill_missing` fills them."""
    table.columns[column][wild] = np.nan
    words = count_noun(int(wild.sum()), "wild reading")
    table.repairs.append(f"column '{column}': {words} taken out")


def _refuse_missing(table: TrialTable, name: str, missing: np.ndarray) -> None:
    count = int(missing.sum())
    start, length = longest_run(missing)
    lengths = np.subtract(*find_runs(missing)[::-1])
    long = int(lengths[lengths > table.limits.nan_run].sum())
    whole = table.entry.kind == "locked"
    whole |= name in (e.column for e in table.session.encoders if e.integrate)
    if length > table.limits.nan_run and (whole or long > _MOST_MISSING * len(missing)):
        raise table.fault("missing_run", name, start, length=length, most=table.limits.nan_run)
    if count - long > max(table.limits.nan_share * len(missing), table.limits.nan_run):
        of = {"count": count, "total": len(missing), "most": table.limits.nan_share}
        raise table.fault("missing_share", name, int(np.argmax(missing)), **of)


def refuse_frozen(table: TrialTable, column: str) -> None:
    """A force channel that stands still for long is a cable that came off."""
    values = table.columns[column]
    start, length = longest_run(np.diff(values) == 0)
    share = (length + 1) / len(values)
    seconds = float(table.t[min(start + length, len(table) - 1)] - table.t[start])
    if share > table.limits.frozen_share and seconds > table.limits.shortest_s / 2:
        of = {"value": values[start], "seconds": seconds, "share": share}
        raise table.fault("frozen", column, start, **of)


def to_si(table: TrialTable) -> dict[str, np.ndarray]:
    """Columns (T,) in SI units by name: q_<axis>, force_<component>, brake_<axis>, channels."""
    session, raw = table.session, table.columns
    for column in session.force.columns if session.force is not None else ():
        _refuse_wild(table, raw[column], "reads", column, column)
    known, si = Conversion.of_session(session), dict[str, np.ndarray]()
    uses = np.count_nonzero(known.gain, axis=1)
    for k, name in enumerate(known.names[1:], 1):
        for at in np.flatnonzero(known.gain[:, k]):
            uses[at] -= 1
            # A column that nothing else needs is used up: together they may fill the memory.
            values = raw[known.columns[at]] if uses[at] else raw.pop(known.columns[at])
            term = np.multiply(values, known.gain[at, k], out=None if uses[at] else values)
            si[name] = np.add(si[name], term, out=si[name]) if name in si else term
        si[name] += known.offset[k]
        # A fault is laid to the column that weighs most.
        source = known.columns[int(np.argmax(np.abs(known.gain[:, k])))]
        _refuse_wild(table, si[name], "gives", name, source)
    return si


def to_signed(table: TrialTable, source: Channel | Encoder) -> None:
    """Read the unsigned register of a signed number as what it stands for."""
    register = Register(getattr(source, "wrap_bits", None) or 0, source.sign_bit or 0)
    if not any(register):
        return
    values = table.columns[source.column]
    beyond = (values < 0.0) | (values >= register.period)
    table.refuse("register", source.column, values, beyond, most=register.period - 1.0)
    table.columns[source.column] = register.signed(values)


def _refuse_wild(table: TrialTable, values: np.ndarray, verb: str, name: str, column: str) -> None:
    wild = ~(np.abs(values) < LARGEST_VALUE)
    table.refuse("beyond_machines", column, values, wild, verb=verb, name=name)
