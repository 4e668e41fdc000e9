"""Columns of numbers as short text: 16 bits a sample, differences, deflated, base64.

A channel keeps every sample, each to 1/65534 of the channel's range; times keep microseconds.
`assets/data.js` unpacks.
"""

import base64
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_LARGEST_CODE = 65534
_GAP_CODE = 65535
_COMPRESSION = 6


@dataclass
class Packer:
    """Packs columns and holds their text.

    Attributes:
        blocks: base64 text, by number.
    """

    blocks: list[str] = field(default_factory=list)
    _known: dict[bytes, int] = field(default_factory=dict, repr=False)

    def pack(self, values: NDArray[np.float64]) -> dict[str, float]:
        """Return ``values``, NaN where a sample is missing, as the page reads them.

        They are ``low + step * code`` in the column's unit, code 65535 for a gap. ``block`` is the
        number of the block of text with the codes, which equal columns share, ``order`` how many
        times differences of them were taken.
        """
        finite = np.isfinite(values)
        low = float(values[finite].min()) if finite.any() else 0.0
        high = float(values[finite].max()) if finite.any() else 0.0
        step = (high - low) / _LARGEST_CODE or 1.0
        codes = np.full(len(values), _GAP_CODE, dtype=np.uint16)
        codes[finite] = np.rint((values[finite] - low) / step).astype(np.uint16)
        once = np.diff(codes, prepend=codes.dtype.type(0))
        twice = np.diff(once, prepend=once.dtype.type(0))
        both = [steps.view(np.int16) for steps in (once, twice)]
        order = int(np.argmin([np.abs(steps.astype(np.float64)).sum() for steps in both]))
        block = self._add(_fold_bytes(both[order]))
        return {"block": block, "order": order + 1, "low": low, "step": step}

    def pack_times(self, seconds: NDArray[np.float64]) -> int:
        """Return the number of the block of ``seconds``: microseconds, differences taken twice."""
        ticks = np.rint(1e6 * seconds).astype(np.int64)
        twice = np.diff(np.diff(ticks, prepend=0), prepend=0)
        return self._add(_fold_bytes(twice))

    def _add(self, raw: bytes) -> int:
        if raw not in self._known:
            packed = zlib.compress(raw, _COMPRESSION)
            self._known[raw] = len(self.blocks)
            self.blocks.append(base64.b64encode(packed).decode("ascii"))
        return self._known[raw]


def _fold_bytes(steps: NDArray[np.signedinteger]) -> bytes:
    """Return small numbers of either sign with their zero bytes side by side."""
    size = steps.dtype.itemsize
    folded = ((steps << 1) ^ (steps >> (8 * size - 1))).astype(f"<i{size}")
    return folded.view(np.uint8).reshape(-1, size).T.tobytes()
