"""A residual fitted by columns: what these explain beside the model, on trials left out too."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.settings import Settings

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-9


class LinearFit:
    """A residual and its slopes by the model's own parameters, to be fitted with more columns."""

    def __init__(
        self, residual: Array, slopes: Array, group: NDArray[np.int64], independent: float
    ) -> None:
        """Take the samples of an axis.

        Args:
            residual: (n,); slopes: (n, P).
            group: which samples are left out together, (n,).
            independent: how many of them are.
        """
        self._residual, self._slopes = residual, slopes
        self._group, self.independent = group, independent

    @cached_property
    def _basis(self) -> Array:
        """Orthonormal columns that span what the model's own parameters can do, (n, r)."""
        return orthonormal(self._slopes)

    @cached_property
    def left(self) -> Array:
        """What they leave of the residual, (n,)."""
        return np.asarray(self._residual - self.taken(self._residual))

    def taken(self, values: Array) -> Array:
        """What the model's own parameters can do of ``values`` where the residual is, (n,)."""
        return np.asarray(self._basis @ (self._basis.T @ values))

    def explained(self, columns: Array) -> tuple[Array, Array]:
        """Sum of squares that columns (m, n, G) take beside the model, (G,), and strengths."""
        m, _, count = columns.shape
        inside = [self._basis.T @ column for column in columns]
        normal, size = np.empty((count, m, m)), np.empty((count, m))
        for a in range(m):
            size[:, a] = np.einsum("ng,ng->g", columns[a], columns[a])
            for b in range(a, m):
                full = size[:, a] if a == b else np.einsum("ng,ng->g", columns[a], columns[b])
                normal[:, a, b] = normal[:, b, a] = full - np.sum(inside[a] * inside[b], axis=0)
        # What the model's own parameters can do as well is no explanation.
        scale = np.sqrt(np.maximum(size, 1e-30))
        normal = normal / scale[:, :, None] / scale[:, None, :] + _NEGLIGIBLE * np.eye(m)
        moment = -np.stack([self.left @ column for column in columns], axis=1) / scale
        strengths = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
        return np.sum(strengths * moment, axis=1), strengths / scale

    @cached_property
    def _alone(self) -> float:
        """Sum of squares on the trials left out, of the model alone."""
        return self._held_out(self._basis)

    def gain(self, columns: Array) -> float:
        """Log likelihood ratio, on trials left out, of columns (n, m) beside the model's own."""
        after = self._held_out(np.column_stack([self._basis, columns]))
        return 0.5 * self.independent * float(np.log(self._alone / after))

    def share_left(self, columns: Array) -> float:
        """Share of the error on trials left out that columns (n, m) leave."""
        after = self._held_out(np.column_stack([self._basis, columns]))
        return float(np.sqrt(after / self._alone))

    def _held_out(self, columns: Array) -> float:
        """Sum of squares on each group of trials, fitted by the columns to all others."""
        total = 0.0
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-30)
        z = columns / size
        for group in np.unique(self._group):
            own = self._group == group
            weight = np.where(own, Settings().held_out_weight, 1.0)[:, None] * z
            normal = weight.T @ z + _NEGLIGIBLE * np.eye(z.shape[1])
            step = np.linalg.solve(normal, weight.T @ self._residual)
            total += float(np.sum((self._residual[own] - z[own] @ step) ** 2))
        return max(total, 1e-300)


def orthonormal(columns: Array) -> Array:
    """Orthonormal columns that span those given, (n, r), whatever their units."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0.0] / norm[norm > 0.0]
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size.max(initial=0.0)])
