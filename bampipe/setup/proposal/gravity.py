"""Whether an axis carries weight, by its log and by what it is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bampipe.data.angle_torque import Reading
from bampipe.data.guesses import Driven
from bampipe.data.survey import Survey, SurveyedColumn, words
from bampipe.setup.hypotheses import MOST_TRAVEL
from bampipe.setup.proposal.positions import in_counts

_ANGLES = frozenset(
    ["angle", "theta", "phi", "psi", "winkel", "joint", "rotation", "deg", "rad", "degrees"]
)
_UPRIGHT = frozenset(["yaw", "pan", "azimuth", "heading"])
"""What an axis that stands upright, and carries no weight, is called."""
_DOUBTS: dict[Reading, str] = {
    "either": "a torque follows the angle, and over so short a travel a spring's looks alike",
    "both": "a torque follows the angle, and neither weight nor a spring alone explains it; what is"
    " beside it, a cable, a spring, a ripple, is for diagnose to name",
}
_LEAST = 1e-3
"""Of what friction gives, N.m, as the spread of a weight of which nothing shows."""


@dataclass(frozen=True)
class Weight:
    """Gravity on an axis, for its device file.

    Attributes:
        moments: guesses of what multiplies sine and cosine of the angle, in the drive's unit.
        sd: of both.
        doubt: what else it may be, a clause; "" where there is no doubt.
    """

    moments: tuple[float, float]
    sd: float
    doubt: str = ""


def weight_of(
    position: SurveyedColumn, fit: Driven, linear: bool, found: Survey
) -> tuple[Weight | None, str]:
    """Gravity for the device file of an axis, None where it has none, and a sentence on it.

    A joint whose mounting is not known is more likely to carry weight than not, and an axis
    whose model lacks gravity has its weight explained by springs and unbalance.

    Args:
        position: of the axis; fit: of its drive; linear: whether it slides; found: the log.
    """
    if linear:
        return None, ""
    reading = fit.pose.reading if fit.pose is not None else "nothing"
    if fit.pose is not None and reading == "spring":
        return None, (
            "no gravity: a torque follows the position as that of a spring does, not as weight"
            " does; diagnose has a name for it"
        )
    if fit.pose is not None and fit.pose.is_gravity:
        doubt = _DOUBTS.get(reading, "")
        said = f"gravity: {doubt}" if doubt else "gravity, since the motion shows it"
        return Weight(fit.pose.moments, max(map(abs, fit.pose.moments)), doubt), said
    if not _may_carry(position, found):
        return None, ""
    moments = fit.pose.moments if fit.pose is not None else (0.0, 0.0)
    size = max(*map(abs, moments), fit.coulomb, _LEAST)
    doubt = "assumed, as of any joint: the motion does not show it"
    return Weight((0.0, 0.0), size, doubt), f"gravity is {doubt}"


def _may_carry(position: SurveyedColumn, found: Survey) -> bool:
    """Whether an axis whose drive shows no weight is a joint all the same."""
    said, known = set(words(position.name)), position.conversion
    torque = any(c.conversion is not None and c.conversion.si == "N.m" for c in found.of("force"))
    is_angle = (known is not None and known.si == "rad") or bool(said & _ANGLES) or torque
    if not is_angle or said & _UPRIGHT:
        return False
    scale = known.scale if known is not None and known.si == "rad" else 1.0
    return in_counts(position) or float(np.ptp(position.values)) * scale <= MOST_TRAVEL
