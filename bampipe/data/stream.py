"""Samples as they come: lines of a growing text file or of a pipe, checked and in SI units."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.data.readers.trial import check_columns
from bampipe.data.refusals import refusal
from bampipe.data.session import Session
from bampipe.data.session.conversion import Conversion
from bampipe.errors import InputError

PORTION = 1 << 16
"""Bytes read at once, which bound the memory together with `LONGEST_LINE`."""
LONGEST_LINE = 1 << 20
DELIMITERS = ",;\t"
LARGEST = 1e15
"""No time, position or force in SI units is larger, except by a fault."""
MOST_COMPLAINTS = 3


def conversion_of_stream(session: Session) -> Conversion:
    """Conversion of a stream with the columns of a session's raw logs.

    Raises:
        InputError: time as dates, counted samples, or registers that wrap.
    """
    where = str(session.root / "session.toml")
    clock = session.clock
    if clock.unit == "datetime" or clock.nanoseconds or not clock.column:
        raise refusal("stream_time", f"{where}: time")
    for rate in (encoder.name for encoder in session.encoders if encoder.integrate):
        raise refusal("stream_velocity", where, axis=rate)
    registers = [encoder.name for encoder in session.encoders if encoder.sign_bit]
    registers += [c.name for c in session.channels if c.sign_bit or c.wrap_bits]
    for register in registers:
        raise refusal("stream_register", where, register=register)
    return Conversion.of_session(session)


@dataclass
class SampleStream:
    """Lines of text turned into samples; a partial last line waits for its end.

    Attributes:
        descriptor: of the open file or pipe; name: what messages call it.
        layouts: what its header may look like, the first that fits counts.
        strict: raise at the first bad line instead of skipping it.
        complain: called with each of the first few lines that are skipped.
        ended: whether the last read found no more bytes; bad_lines: how many were skipped.
    """

    descriptor: int
    name: str
    layouts: Sequence[Conversion]
    strict: bool
    complain: Callable[[str], None]
    ended: bool = False
    bad_lines: int = 0
    _layout: Conversion | None = None
    _rest: bytes = b""
    _line: int = 0
    _last_good: int = 0
    _delimiter: str = ","
    _width: int = 0
    _places: tuple[int, ...] = ()
    _last: float = -np.inf

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of `read`; empty before the header has come."""
        return self._layout.names if self._layout else ()

    @property
    def lines_without_sample(self) -> int:
        """Number of lines since the last one that held a sample."""
        return self._line - self._last_good

    def read(self, last: bool = False) -> Array:
        """Return the samples, (T, m), of what has come since; T may be 0.

        Args:
            last: whether an unfinished line at the end is taken as complete.

        Raises:
            InputError: the header lacks a column, a line has no end, or, where strict, is bad.
        """
        data = os.read(self.descriptor, PORTION)
        self.ended = not data
        text = self._rest + data
        if last and self.ended and text and not text.endswith(b"\n"):
            text += b"\n"
        cut = text.rfind(b"\n") + 1
        self._rest = text[cut:]
        if len(self._rest) > LONGEST_LINE:
            raise refusal("no_line_end", f"{self.name}: {self._line + 1}")
        rows: dict[int, list[float]] = {}
        for line in text[:cut].decode("utf-8", errors="replace").splitlines():
            self._line += 1
            plain = line if self._layout else line.lstrip("\ufeff")
            if not plain.strip() or plain.startswith("#"):
                continue
            if self._layout is None:
                self._take_header(plain)
            elif row := self._row(plain.split(self._delimiter), self._layout):
                rows[self._line] = row
        if self._layout is None or not rows:
            return np.empty((0, len(self.names)))
        return self._samples(rows, self._layout)

    def _take_header(self, line: str) -> None:
        self._delimiter = max(DELIMITERS, key=line.count)
        found = [cell.strip().strip("\"'") for cell in line.split(self._delimiter)]
        fitting = [layout for layout in self.layouts if set(layout.columns) <= set(found)]
        if not fitting:
            check_columns(found, self.layouts[0].columns, f"{self.name}: line {self._line}")
        self._layout, self._width, self._last_good = fitting[0], len(found), self._line
        self._places = tuple(found.index(name) for name in fitting[0].columns)

    def _samples(self, rows: Mapping[int, list[float]], layout: Conversion) -> Array:
        """The samples of rows of numbers, by number of the line."""
        raw, numbers = np.array([*rows.values()]), [*rows]
        lost = np.isnan(raw)
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.where(lost, 0.0, raw) @ layout.gain + layout.offset
            large = ~(np.abs(values) <= LARGEST)
        values[lost @ (layout.gain != 0.0)] = np.nan  # and spoils nothing else
        good = ~large.any(axis=1)
        time = np.where(good, raw[:, 0] * layout.gain[0, 0], -np.inf)
        before = np.maximum.accumulate(np.append(self._last, time))
        late = good & ~(time > before[:-1])
        for at in np.flatnonzero(~good | late):
            if late[at]:
                self._skip(numbers[at], layout.columns[0], "the time does not increase")
            else:
                name = layout.names[int(np.argmax(large[at]))]
                self._skip(numbers[at], "", f"{name} is larger than {LARGEST:g}")
        keep = good & ~late
        self._last = float(before[-1])
        if keep.any():
            self._last_good = numbers[int(np.flatnonzero(keep)[-1])]
        return np.asarray(values[keep])

    def _row(self, cells: list[str], layout: Conversion) -> list[float]:
        """The numbers of a line; none where it is bad, which is said."""
        if len(cells) != self._width:
            self._skip(self._line, "", f"{len(cells)} cells where the header has {self._width}")
            return []
        row = []
        for at, column, may_lack in zip(self._places, layout.columns, layout.may_lack, strict=True):
            text = cells[at].strip().strip("\"'")
            try:
                row.append(float(text or "nan"))
                known = math.isfinite(row[-1]) or (may_lack and math.isnan(row[-1]))
                # float() also reads 1_0 and the digits of other scripts, which no logger writes.
                if not known or "_" in text or not text.isascii():
                    raise ValueError
            except ValueError:
                self._skip(self._line, column, f"{text[:40]!r} is no number")
                return []
        return row

    def _skip(self, number: int, column: str, what: str) -> None:
        where = f"{self.name}: line {number}" + (f", column {column}" if column else "")
        if self.strict:
            raise InputError(what, where=where)
        self.bad_lines += 1
        if self.bad_lines <= MOST_COMPLAINTS:
            more = "; further ones are only counted" if self.bad_lines == MOST_COMPLAINTS else ""
            self.complain(f"{where}: {what}: skipped{more}")
