"""The columns of a log in SI units, for whole logs and for samples as they come."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from bampipe.arrays import Array
from bampipe.data.refusals import refusal
from bampipe.data.session import Session
from bampipe.data.session.channels import LARGEST_CONDITION


@dataclass(frozen=True)
class Conversion:
    """What the columns of a log become: SI values = raw @ gain + offset, time first.

    Attributes:
        columns: (k,) columns needed, the time first.
        names: (m,) what they become: ``t`` (s), ``q_<axis>``, ``force_<c>``, ``brake_<axis>``, ...
        gain: (k, m); offset: (m,).
    """

    columns: tuple[str, ...]
    names: tuple[str, ...]
    gain: Array
    offset: Array

    @cached_property
    def may_lack(self) -> NDArray[np.bool_]:
        """Columns (k,) that may be empty: positions, which the filter bridges."""
        others = [not name.startswith("q_") for name in self.names]
        return np.asarray(~self.gain[:, others].any(axis=1))

    @staticmethod
    def in_si(names: Sequence[str]) -> "Conversion":
        """Columns that are named and measured as in ``ingest/samples.parquet``."""
        columns = ("t", *names)
        return Conversion(columns, columns, np.eye(len(columns)), np.zeros(len(columns)))

    @staticmethod
    def of_session(session: Session) -> "Conversion":
        """Columns as a session file describes its raw logs; registers hold what they stand for.

        Raises:
            InputError: some motion shows in no reading of motors that several joints turn.
        """
        encoders, force = session.encoders, session.force
        brakes, channels = session.brakes, session.channels
        axes = [e.name for e in encoders]
        columns = [session.clock.column, *(e.column for e in encoders)]
        columns += [*(force.columns if force else ()), *(b.column for b in brakes)]
        columns += [c.column for c in channels]
        names = ["t", *(f"q_{axis}" for axis in axes), *(force.names if force else ())]
        names += [*(f"brake_{b.axis}" for b in brakes), *(c.name for c in channels)]
        reads = np.eye(len(encoders))
        for row, encoder in zip(reads, encoders, strict=True):
            for other, share in encoder.also_reads.items():
                row[axes.index(other)] = share
        if not np.linalg.cond(reads) < LARGEST_CONDITION:
            raise refusal("hidden_motion")
        readings = np.diag([e.scale for e in encoders]) @ np.linalg.inv(reads).T
        matrix = np.array(force.calibration).T if force else np.empty((0, 0))
        scales = [1.0] * len(brakes) + [c.scale for c in channels]
        offsets = (
            -np.array([e.zero for e in encoders]) @ readings,
            -np.array(force.zero if force else ()) @ matrix,
            [0.0] * len(brakes) + [c.offset for c in channels],
        )
        gain = block_diag([[session.tick]], readings, matrix, np.diag(scales))
        return Conversion((*columns,), (*names,), gain, np.concatenate([[0.0], *offsets]))
