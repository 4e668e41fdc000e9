"""``models/<model>/identify.json``: parameters of a model with uncertainties."""

from typing import Annotated, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count

Method = Literal["ukf", "least-squares"]
"""How parameters are estimated."""


class ParameterEstimate(Record):
    """One parameter."""

    estimate: float
    sd: Size = Field(description="Standard deviation: block-wise sandwich, and the parts below")
    unit: str
    at_bound: bool = Field(description="Within one sd of its physical bound")
    filter_sd: Size | None = None
    """Standard deviation of the filter alone, valid for white noise only"""
    smoothing_sd: Size | None = None
    """Part of sd due to the smoothed sign of a velocity; 0 if the machine creeps as the model does,
    null if the method excludes standstill"""
    calibration_sd: Size | None = None
    """Part of sd from the stated uncertainty of sensors and constants, and from encoder zeros that
    are known to one step; null without any"""
    statistical_sd: Size | None = None
    """The rest of sd; null if all of it is statistical"""
    least_squares_bias: float | None = None
    """Bias of least squares by filters and friction at standstill, subtracted"""
    bound_sd: Size | None
    """Cramer-Rao bound: least sd that the sensors allow; null without one"""


class Covariance(Record):
    """Covariance of the estimates, in products of their units."""

    names: Names
    matrix: tuple[tuple[float, ...], ...]


class MethodValue(Record):
    """A parameter by one method, with the uncertainty by that method alone."""

    estimate: float
    sd: Size


class MethodTried(Record):
    """Parameters by one method, and their error on held-out trials."""

    held_out_rmse: dict[str, Size] = Field(default={})
    """By axis, N.m or N; empty without parameters"""
    parameters: dict[str, MethodValue] = Field(default={}, description="By name")
    doubts: Names = Field(default=(), description="Reasons to distrust it")


class WorstSecond(Record):
    """The second with the largest influence on a parameter of the least-squares fit."""

    trial: str
    start_s: Size = Field(description="Since the start of the trial, s")
    parameter: str
    move: float
    """Change of that parameter without this second, in its standard deviations"""
    sentence: str = Field(default="", description="Explanation of a transient or an outlier")


class Influence(Record):
    """Influence of parts of the data on the parameters."""

    trials: dict[str, dict[str, float]]
    """By trial, or block of a single one, then by parameter and `input_timing`: change of the
    least-squares estimate without it, in published standard deviations. More than ten trials form
    ten groups"""
    worst_second: WorstSecond


class EffectEstimate(Record):
    """Whether the trials determine an effect of the model."""

    has_strength: bool = True
    """Whether its strengths, taken together, differ from zero at 95 %"""
    identified: bool
    reasons: Names = Field(default=(), description="Reasons why it does not count as identified")


NEAR_LIMIT = 0.95
"""A timing is at its limit from this share of it on."""


class InputTiming(Record):
    """Delay of the force samples behind the positions, at most half a sample."""

    estimate: float
    sd: Size = Field(description="0 if it was not estimated")
    unit: Literal["s"]
    limit: Size = 0.0
    """Largest value, half a sample; 0 if it was not estimated"""
    of_residual: float = 0.0
    """Timing with the least residual within the limit, s, including the bias of filters at
    reversals; for a robot the one on which most drives agree away from reversals; 0 if the trials
    show none. Residuals are compared at this timing"""

    @property
    def is_at_limit(self) -> bool:
        """Whether the estimate is within 5 % of its limit."""
        return 0.0 < NEAR_LIMIT * self.limit <= abs(self.estimate)


class StateBound(Record):
    """Three standard deviations of one axis, median over time, rad or m and per s."""

    position: Size | None = None
    velocity: Size | None = None


class Consistency(Record):
    """Normalised innovation squared; 1 if the noise levels are right."""

    mean: Size
    by_trial: dict[str, Size]


class InnovationTestResult(Record):
    """A test of the innovations: Ljung-Box, or F."""

    p_value: Share
    share: Share


class Whiteness(InnovationTestResult):
    """Whether the past does not predict the innovations."""

    white: bool


class Independence(InnovationTestResult):
    """Whether the inputs predict the innovations."""

    independent: bool


class InnovationTests(Record):
    """Both tests of one axis."""

    sentence: str
    whiteness: Whiteness | None = None
    inputs: Independence | None = None


class NoiseLevels(Record):
    """Standard deviations used, tuned by likelihood, and those of the sensors."""

    reading_sd: dict[str, float]
    process_sd: dict[str, float]
    sensor_sd: dict[str, float]


class Convergence(Record):
    """Whether the search, or the filter along the data, converged."""

    converged: bool
    settled_s: dict[str, Size] | None = None
    """Time after which each estimate stays within 2 % or 3 sd of its final value, s from the start
    of the first run"""
    total_s: Size | None = Field(default=None, description="Of the first run and the last")


class ParameterBound(Record):
    """bound_sd; alone_sd if all others were known; partner with the most correlated error."""

    bound_sd: Size | None
    alone_sd: Size | None
    partner: str | None = None
    correlation: float | None = Field(default=None, ge=-1.001, le=1.001)


class WeakDirection(Record):
    """Parameters that move together, and the share of information that separates them."""

    members: Names
    parts: tuple[float, ...]
    strength: Size


class DeviceNumber(Record):
    """A constant of the device file, or a sum of them, as if it were estimated too."""

    name: str
    value: float
    unit: str
    bound_sd: Size | None
    partner: str | None
    correlation: float
    moves_percent: dict[str, float]
    """Change of each estimate that is known to 10 % for an error of 1 % in this number, per cent"""


class Combined(Record):
    """Numbers that enter the equations only through combinations of each other."""

    members: Names
    combinations: Names


class TrialGrowth(Record):
    """Largest relative growth of a parameter's bound without the trial."""

    growth: float
    parameter: str


class IdentifiabilityReport(Record):
    """The least uncertainty of each number that these trials allow."""

    parameters: dict[str, ParameterBound]
    weak_directions: tuple[WeakDirection, ...]
    numbers: tuple[DeviceNumber, ...]
    together: tuple[Combined, ...]
    trials: dict[str, TrialGrowth]
    sentences: Names


class BaseEstimate(Record):
    """A base parameter: inertial numbers that motion determines only as a combination."""

    combination: str = Field(description="Names of parameters, with factors")
    members: Names
    estimate: float
    sd: Size
    drawn: float = Field(description="Value from the drawing")
    drawn_sd: Size
    unit: str
    shown: bool = Field(description="Whether the trials determine it better than the drawing does")


class IdentifyResult(Result, file="models/{model}/identify.json", stage="identify"):
    """Parameters of a model with uncertainties."""

    model: str
    headline: str
    method: Method = Field(description="Method of the published parameters")
    methods: dict[Method, MethodTried] = Field(description="Every method tried, published first")
    engine: Literal["compiled", "filterpy"]
    trials: Names = Field(description="Free trials used")
    parameters: dict[str, ParameterEstimate]
    """By name: viscous.<axis>, coulomb.<axis>, mass, <effect>[.<axis>].<parameter>"""
    effects: dict[str, EffectEstimate] = Field(default={})
    """By effect of the model. An effect does not count as identified if its strength or shape is at
    a bound or has an interval larger than itself"""
    influence: Influence
    covariance: Covariance
    input_timing: InputTiming
    state_3sigma: dict[str, StateBound] = Field(description="By axis")
    convergence: Convergence
    identifiability: IdentifiabilityReport | None = None
    base_parameters: tuple[BaseEstimate, ...] | None = None
    """Base parameters of a robot, from the base to the tip"""
    sign_width_factor: Annotated[float, Field(gt=0, le=1)] = Field(
        default=1.0,
        description="Width of the smoothed sign of the velocities over the device's `sign_width`;"
        " below 1 if trials of a test bench are more likely with it. Later stages use it too",
    )
    notes: Names = Field(default=(), description="Limits of the estimates")
    nis: Consistency | None = None
    innovations: dict[str, InnovationTests] | None = Field(default=None, description="By axis")
    noise: NoiseLevels | None = None
    residual_sd: dict[str, Size] | None = None
    """Least squares: low-passed residual by axis, N.m or N"""
    blocks: Annotated[int, Field(ge=1)] | None = None
    """Independent blocks of time"""
    restarts: Count | None = Field(default=None, description="Attempts until the filter followed")

    def moves_without(self, trial: str) -> dict[str, float]:
        """Change of each parameter and of ``input_timing`` without a trial, or block of one.

        It is zero for a trial that was not fitted.
        """
        sd = {name: entry.sd for name, entry in self.parameters.items()}
        sd["input_timing"] = self.input_timing.sd
        moves = self.influence.trials.get(trial, {})
        return {name: move * sd[name] for name, move in moves.items()}

    @property
    def inertial(self) -> frozenset[str]:
        """Inertial numbers of a robot's bodies: motion determines only combinations of them."""
        return frozenset(name for base in self.base_parameters or () for name in base.members)

    repeats: Count | None = None
    """Further runs of the filter around its answer; the states are of the last run, the trace of
    the first and the last"""
