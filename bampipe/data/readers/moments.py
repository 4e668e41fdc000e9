"""Dates and times as seconds."""

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd

from bampipe.data.refusals import refusal
from bampipe.errors import InputError

NANOSECONDS = 1_000_000_000
LONGEST = 256
"""Characters of the longest text that is taken for a date and time."""
_DAY = 86_400 * NANOSECONDS
_MOMENT = re.compile(r"\s*\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d([.,]\d+)?(Z|[+-]\d\d:?\d\d)?\s*\Z")
"""ISO 8601 date and time."""
_OF_DAY = re.compile(
    r"\s*(?:\d+ days |\d{3}:(?=\d\d:\d\d:))?"
    r"(?:\d{1,2}:\d\d:\d\d(?:[.,]\d+|[:;]\d{3})?|\d{1,2}:\d\d[.,]\d+)\s*\Z"
)
"""Time of day, of a stop watch, since the first sample as in pandas, of a day of the year."""
_LOCAL = re.compile(
    r"\s*(?:(?P<a>\d{1,2})(?P<sep>[./-])(?P<b>\d{1,2}|[A-Z][a-z]{2})(?P=sep)(?P<year>\d{4})[T ]+)?"
    r"(?P<hour>\d{1,2})(?P<rest>:\d\d(?::\d\d(?:[.,:]\d+)?)?)(?P<half> ?[AaPp]\.?[Mm]\.?)?\s*\Z"
)
"""Date and time as people write them: the date may be left out beside AM or PM."""
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def is_moment(cell: str) -> bool:
    """Whether a text is a date and time, or a time of day, that needs no form."""
    local = _LOCAL.match(cell)
    known = local is not None and bool(local["a"] or local["half"])
    return known or bool(_MOMENT.match(cell) or _OF_DAY.match(cell))


def nanoseconds(values: Sequence[str | None] | np.ndarray, form: str, row: int = 1) -> np.ndarray:
    """Moments as whole nanoseconds since 1970 (UTC), (T,) int64; the least one where missing.

    Args:
        values: text, or numpy datetime64.
        form: as of ``strptime``; "" for ISO 8601 or times of day, which are of 1970-01-01.
        row: number of the first row, for messages.

    Raises:
        InputError: a cell is no date and time of that form.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind == "M":
        return values.astype("datetime64[ns]").astype(np.int64)
    longest = max((len(value) for value in values if value is not None), default=0)
    if longest > LONGEST:
        raise InputError(f"a text of {longest} characters, expected a date and time")
    text = pd.Series(values, dtype="string").str.strip()
    plain = text
    if not form:
        plain = _iso_of_local(text).str.replace(",", ".")  # ISO 8601 takes either as decimal sign
        of_day = plain.str.match(_OF_DAY).fillna(False)
        clock = plain.str.replace(r"^(\d\d?:\d\d:\d\d)[:;]", r"\1.", regex=True)
        clock = clock.str.replace(r"^(\d\d?:\d\d\.)", r"0:\1", regex=True)
        clock = clock.str.replace(r"^(\d{3}):", r"\1 days ", regex=True)
        since = pd.to_timedelta(clock.where(of_day), errors="coerce")
        plain = plain.mask(of_day, (pd.Timestamp(0) + since).astype("string"))
    try:
        moments = pd.to_datetime(plain, format=form or "ISO8601", utc=True, errors="coerce")
    except (ValueError, OverflowError) as error:
        raise refusal("no_form", form=form) from error
    wrong = (moments.isna() & text.notna() & (text != "")).to_numpy()
    if wrong.any():
        at = int(np.argmax(wrong))
        known = {"row": row + at, "cell": str(text.iloc[at])[:40]}
        raise refusal("other_form", **known, form=form) if form else refusal("no_moment", **known)
    return np.asarray(moments.dt.tz_localize(None), dtype="datetime64[ns]").astype(np.int64)


def _iso_of_local(text: pd.Series) -> pd.Series:
    """Convert local dates and times to ISO 8601; leave others, and ambiguous ones, unchanged.

    Whether 03/10 is in March or October shows where a date beyond the 12th stands in the column, or
    does not matter where it is the only date.
    """
    seen = _LOCAL.match(next(iter(text.dropna()), ""))
    if seen is None or not (seen["a"] or seen["half"]):
        return text
    parts = text.str.extract(_LOCAL)
    day, month = parts["a"], parts["b"]
    if seen["sep"] == "/":
        beyond = [pd.to_numeric(part, errors="coerce").max() > 12 for part in (day, month)]
        if not any(beyond) and len(parts.loc[day.notna(), ["a", "b"]].drop_duplicates()) > 1:
            return text
        day, month = (day, month) if beyond[0] else (month, day)
    numbers = {name: f"{n:02d}" for n, name in enumerate(_MONTHS, 1)}
    month = month.str.lower().replace(numbers)
    date = parts["year"] + "-" + month.str.zfill(2) + "-" + day.str.zfill(2)
    late = parts["half"].str.contains("[Pp]").fillna(False).astype(int) * 12
    hour = pd.to_numeric(parts["hour"]).astype("Int64")
    hour = hour.where(parts["half"].isna(), hour % 12 + late).astype("string").str.zfill(2)
    rest = parts["rest"].str.replace(r"(:\d\d:\d\d):", r"\1.", regex=True)
    whole = date.fillna("1970-01-01") + "T" + hour + rest
    return whole.where(parts["hour"].notna(), text)


def seconds(moments: np.ndarray) -> np.ndarray:
    """Seconds since the first of moments (T,), ns; NaN where missing; midnight is no step back."""
    missing = moments == np.iinfo(np.int64).min
    known = np.flatnonzero(~missing)
    if len(known) == 0:
        return np.full(len(moments), np.nan)
    if moments[known].min() >= 0 and moments[known].max() < _DAY:  # times of day, or of an hour
        period = _DAY if moments[known].max() >= _DAY // 24 else _DAY // 24
        passed = np.zeros(len(moments), dtype=np.int64)
        passed[known[1:]] = np.cumsum(np.diff(moments[known]) < -0.9 * period)
        moments = moments + passed * period
    # Whole numbers first: a double has no room for 1 us since 1970.
    since = (moments - moments[known[0]]) / NANOSECONDS
    return np.where(missing, np.nan, since)
