"""Ranking of designs, as followed exactly, in other surroundings, and roughly by people."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.next_trial.primitives import Primitive, find_beyond, list_primitives, vary_surroundings
from bampipe.next_trial.rehearsal import HASTY, Rehearsal
from bampipe.trials.motion import Motion

_VERSIONS = (1, 2, 3, 4, HASTY)
"""Versions of a design as different people follow it."""
_MOST_WORK = 2.5e7
"""Samples times parameters of all designs that are tried exactly. For a robot with 80 parameters
each design takes seconds, so that some are left out."""
_FEWEST_DESIGNS = 12
_MOST_FINALISTS, _FEWER_FINALISTS = 5, 2
_FOLLOWED_HASTILY = 4
"""Number of designs, for each finalist, that are also tried as somebody hasty follows them."""
_MOST_VARIED = 2
"""Number of the best designs that are tried in other surroundings."""
_QUANTILE = 0.1
"""Quantile of the utility over versions that ranks designs: a bad day must still be useful."""
_PREMIUM_BEYOND = 0.05
"""Relative utility by which a design beyond the range of the trials must exceed one within it: a
smaller gain is lost in the scatter between people and not worth the risk."""

Utility = Callable[[Motion], float]
"""Utility of a motion: larger is better."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class DesignSpace:
    """The designs that are tried.

    Attributes:
        seconds: length of each.
        axes: the axes that they excite; none where drives follow the examples alone.
        examples: further designs beside the primitives.
        with_rests: whether an axis may rest at the turns; with_brakes: whether brakes may be on.
    """

    rehearsal: Rehearsal
    seconds: float
    axes: Sequence[int]
    examples: Sequence[Primitive] = ()
    with_rests: bool = False
    with_brakes: bool = False

    def list_designs(self) -> tuple[list[Primitive], bool]:
        """Return the designs to try, and whether all of them can be afforded."""
        rehearsal, most = self.rehearsal, count_affordable(self.rehearsal, self.seconds)
        if not self.axes:
            return list(self.examples), len(self.examples) < most
        designs = list_primitives(rehearsal.seen, self.seconds, self.axes, self.with_rests)
        return [*designs[:: -(-len(designs) // most)], *self.examples], len(designs) <= most

    def vary(self, design: Primitive) -> Iterator[Primitive]:
        """Yield the same design in other surroundings."""
        every = vary_surroundings(self.rehearsal.seen, design)
        return (other for other in every if self.with_brakes or not other.field)

    def goes_beyond(self, design: Primitive) -> bool:
        """Return whether a design exceeds the range or speed of the trials at hand."""
        return any(find_beyond(design, self.rehearsal.seen))

    def follow(self, design: Primitive) -> tuple[Motion, ...]:
        """Return a design as different people follow it, somebody hasty last."""
        return tuple(self.rehearsal.record(design, version) for version in _VERSIONS)


def count_affordable(rehearsal: Rehearsal, seconds: float) -> int:
    """Return how many designs of this length may be tried exactly."""
    work = seconds * rehearsal.sensors.rate_hz * len(rehearsal.system.parameters)
    return max(_FEWEST_DESIGNS, int(_MOST_WORK / work))


@dataclass(frozen=True)
class RankedDesign:
    """A design that has been tried, with the quantile of the utility over its versions.

    The last of the motions is the hasty one.
    """

    design: Primitive
    utility: float
    motions: tuple[Motion, ...]

    @property
    def expected_motions(self) -> tuple[Motion, ...]:
        """The expected versions: all but the hasty one."""
        return self.motions[:-1]


def rank_designs(
    space: DesignSpace,
    utility: Utility,
    progress: Progress = lambda fraction, message: None,
    least: float = -np.inf,
) -> list[RankedDesign]:
    """Try the designs of a space, then the best ones as people follow them; best first.

    The best design when followed exactly may be useless when followed hastily: finalists are good
    both ways, and at least one stays within the range of the trials at hand. The list is empty if
    no design reaches the utility ``least`` when followed exactly.
    """
    rehearsal = space.rehearsal

    def try_design(design: Primitive) -> float:
        return utility(rehearsal.record(design, 0))

    def follow_hastily(value: float, design: Primitive) -> tuple[float, Primitive]:
        return _take_low([value, utility(rehearsal.record(design, HASTY))]), design

    designs, is_quick = space.list_designs()
    finalists, varied = (_MOST_FINALISTS, _MOST_VARIED) if is_quick else (_FEWER_FINALISTS, 0)
    exact = []
    for k, design in enumerate(designs):
        progress(0.5 * k / len(designs), f"trying {len(designs)} designs")
        exact.append((try_design(design), design))
    exact.sort(key=lambda pair: -pair[0])
    if exact[0][0] < least:
        others = (other for _, design in exact[:varied] for other in space.vary(design))
        if all(try_design(other) < least for other in others):
            return []
    progress(0.5, "following them hastily")
    ahead = exact[: _FOLLOWED_HASTILY * finalists]
    if all(space.goes_beyond(design) for _, design in ahead):
        ahead += [pair for pair in exact if not space.goes_beyond(pair[1])][:1]
    best = sorted((follow_hastily(*pair) for pair in ahead), key=lambda pair: -pair[0])
    inside = next((design for _, design in best if not space.goes_beyond(design)), None)
    others = (other for _, design in best[:varied] for other in space.vary(design))
    best += [follow_hastily(try_design(other), other) for other in others]
    best.sort(key=lambda pair: -pair[0])
    chosen = [design for _, design in best[:finalists]]
    if inside is not None and all(space.goes_beyond(design) for design in chosen):
        chosen[-1] = inside
    ranked = []
    for k, design in enumerate(chosen):
        progress(0.75 + 0.25 * k / finalists, "simulating people who follow the best ones roughly")
        motions = space.follow(design)
        ranked.append(RankedDesign(design, _take_low([utility(m) for m in motions]), motions))
    ranked.sort(key=lambda one: -one.utility)
    most = ranked[0].utility
    good = (one for one in ranked if one.utility >= most - _PREMIUM_BEYOND * abs(most))
    first = next((one for one in good if not space.goes_beyond(one.design)), ranked[0])
    return [first, *(one for one in ranked if one is not first)]


def find_best_of_each(
    space: DesignSpace,
    inform: Callable[[Motion], Array],
    utilities: Sequence[Callable[[Array], float]],
) -> list[RankedDesign]:
    """Return the best design for each of several utilities, without repetition.

    ``inform`` gives the information (m, m) of a motion; of the utilities of that, larger is better.
    """
    designs, is_quick = space.list_designs()
    informed = [inform(space.rehearsal.record(design, 0)) for design in designs]
    counted = Counter(
        k
        for utility in utilities
        for k in sorted(range(len(designs)), key=lambda k: -utility(informed[k]))[:_FEWER_FINALISTS]
    )
    # If that takes long, only the designs that are good by most utilities are followed.
    chosen = [k for k, _ in counted.most_common(None if is_quick else _FEWER_FINALISTS)]
    motions = {k: space.follow(designs[k]) for k in chosen}
    versions = {k: [inform(motion) for motion in motions[k]] for k in chosen}
    found: dict[int, RankedDesign] = {}
    for utility in utilities:
        values = {k: _take_low([utility(one) for one in versions[k]]) for k in chosen}
        best = max(chosen, key=lambda k: values[k])
        found.setdefault(best, RankedDesign(designs[best], values[best], motions[best]))
    return list(found.values())


def _take_low(utilities: Sequence[float]) -> float:
    """Return the utility of a design on a bad day."""
    return float(np.quantile(utilities, _QUANTILE))
