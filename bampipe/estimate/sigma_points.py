"""Scaled sigma points: how far apart they lie and what they weigh."""

from dataclasses import dataclass
from math import sqrt

BALANCED_ALPHA = sqrt(2.0 - sqrt(3.0))
"""Smallest spread for which, with beta = 2 and kappa = 0, no covariance weight is negative."""


@dataclass(frozen=True)
class SigmaPoints:
    """Scaled unscented transform of Van der Merwe (2004).

    The points lie ``sqrt(alpha^2 (n + kappa))`` standard deviations from the mean. With the
    default the weight of the central point in the covariance is zero, so that a covariance is a
    sum of positive terms; a smaller spread makes that weight negative, and with the usual
    ``alpha = 1e-3`` the weights are near 1e6 and rounding alone costs nine digits.

    Attributes:
        alpha: spread, greater than 0.
        beta: 2 is best where the distribution is Gaussian.
        kappa: second scaling, usually 0.
    """

    alpha: float = BALANCED_ALPHA
    beta: float = 2.0
    kappa: float = 0.0

    def weights(self, n: int) -> tuple[float, float, float, float]:
        """Return the numbers the kernels need for ``n`` dimensions, noise included.

        Returns:
            ``(spread, mean_0, covariance_0, other)``: the squared distance of the points in
            variances, the weight of the central point in the mean and in the covariance, and
            the weight of every other point in both.

        Raises:
            ValueError: the points would coincide with the mean or lie at an imaginary distance.
        """
        spread = self.alpha**2 * (n + self.kappa)
        if not spread > 0.0:
            raise ValueError(f"sigma points need alpha^2 (n + kappa) > 0, got {spread} for n = {n}")
        mean_0 = 1.0 - n / spread
        covariance_0 = mean_0 + 1.0 - self.alpha**2 + self.beta
        if self.beta == 2.0 and self.kappa == 0.0 and self.alpha == BALANCED_ALPHA:
            covariance_0 = 0.0  # exactly, not within rounding
        return spread, mean_0, covariance_0, 0.5 / spread
