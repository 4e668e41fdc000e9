"""How carefully the diagnosis looks, and what it takes for a finding.

Every threshold that decides a verdict, a draft or a sentence of them stands here; where an error is
at its floor is decided in `bampipe.results.standing`. The figures they rest on are in
docs/benchmarks_thresholds.md: by how much each could move before anything comes out otherwise
(benchmarks/margins.py), clean axes beside weak effects (benchmarks/thresholds.py). Hidden effects
(benchmarks/hidden_effects.py) are in docs/benchmarks_diagnosis.md.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How carefully to look; by how much each could move: docs/benchmarks_thresholds.md.

    Attributes:
        first_replicates: replays of the model for the chance level, enough where the best
            candidates stand far above it; replicates: else; closer: times as many where a decision
            is close, that is a p-value within a factor ``close`` of ``significance``.
        rival_replicates: replays of each rival when candidates come close.
        most_effects: the most effects tried, those dropped again among them.
        significance: chance of a false alarm in a session that is accepted.
        worth: least drop of log error beyond chance, on one axis, that is worth an effect.
        worth_at_floor: the same on an axis whose error is already at its noise floor: no replay
            is perfect, and changes of direction blurred by sampling invite spurious effects, up to
            a tenth of the error on a linear axis. Of that floor, what noise of the forces makes
            through play is no such blur, and does not count.
        least_force: share of the applied force, as a root mean square, that an effect must take off
            at least: a load cell is no more linear than that, nor is a torque by a current.
        still_share: least share of the mean square that it takes off which an effect must take off
            beyond what it does to replays that truly stand still.
        unmoved: change of log error on an axis up to which an effect has left it as it was: what is
            known of candidates that act on such axes alone is not found anew.
        least_slope: least share of what the applied force does that an effect must leave of it, as
            a geometric mean on every axis.
        carried: least share of the drop of log error by its score that an effect must show on
            trials that its fit has not seen at all.
        runs_away: held-out error with an effect over that without from which on its refits are said
            to run away: no figure that says anything of the effect.
        share: least share of what exceeds the floor on one axis, in the mean square, that an effect
            must remove in its turn: on a measured machine something always remains, and many
            effects take a little of it.
        above_floor_sd: standard deviations of replays by which an error must exceed the floor times
            `AT_FLOOR` for its axis to count as above it.
        shrunken: error over floor that an effect must not fall below: what leaves a small part of
            the sensors' noise makes both sides of the equation small; raised: nor may it raise the
            floor by this factor where the error then is implausibly far below it.
        worth_without_second: share of ``worth`` that must be left of an effect without the second
            that speaks most for it.
        held_out_weight: weight that a trial keeps when it is left out to score candidates. Where it
            alone holds what determines a parameter, as one wide motion among narrow ones does,
            leaving it out altogether would compare extrapolations; of what several trials determine
            it keeps a few hundredths of a degree of freedom.
        timing_sd: standard deviations by which a model with more effects must find another timing
            of the inputs for that to be taken; limit_sd: and by which it must lie beyond half a
            sample, the lateness of a drive that holds its command, to be a delay.
        predictable: least share of the residual of an axis above its floor that a flexible
            regressor must predict, beyond chance, for it to lack something.
        surely: error over floor beyond which it lacks something, predictable or not.
        explained: least share of the excess mean square that the effects found on an axis remove,
            else they are likely and not found: what resembles the missing effect takes some.
        resembles: below this share they are no more than resemblances, and the effect is unknown.
        likely: p-value up to which a candidate that does not beat chance is named as likely.
        decided: odds from which on an effect is found although others fit alike.
        clear_odds: odds of an effect found to one rival, below which a verdict names both: scores
            err by about that, and the name that stands alone is taken for sure.
        rival_score: share of an effect's score from which on another one is listed beside it.
        swap: relative gain in score from which on another effect takes the place of one found.
        replay_error: how far the log error of a replay may be off because no replay is perfect.
        worth_searching: least gain in log likelihood in the fit for a search of its shape to go on.
        rival_share: share of the best candidate's gain beyond chance from which on another one is
            a rival; most_rivals: at most so many are replayed.
        rival_misfit: mean squared z up to which the pattern of scores looks like the measured
            one; rival_margin: or up to so much more than that of the best.
        score_error: relative error of a replayed score, and score_sd: its least scatter, in log
            likelihood, both because no replay is perfect.
        other_band_replicates: replays in another band; other_band_ratio: of its cut-off to that of
            the session, or the inverse.
        variable_share: least share of a residual's variance that a variable carries to be named;
            mentioned_share: to be mentioned where the residual is scattered.
        ripple_share: least share of that which a sine carries to be called a ripple.
        direction_likeness: correlation of the residual in both directions from which on it is
            called the same, as of a spring, or opposite, as of friction.
        bump_height: share of the largest mean residual from which on a place belongs to a bump;
            bump_width: share of the range up to which it is one, and not a broad change.
        idle: share of what an effect adds, as a root mean square, that must be more than its offset
            for it to be a rival of effects that add a constant.
        most_alike: the most effects that are said to be no different from the one found.
        draft_replicates: replays on which a formula is searched as on the measurement, twice as
            many more where the decision is close; draft_significance: chance of a formula where
            nothing is missing.
        draft_close: as ``close``, for a formula.
        draft_worth: least drop of log error on held-out trials for each constant of a formula.
        draft_rival_share: share of the best form's gain from which on another one is refitted.
        confused: chance of confusing two effects below which these trials distinguish them;
            confusion_left: share of it that a suggested trial may leave at most.
        lowered: share of a chance of confusion, or of a smallest strength, from which on a
            proposed trial is not said to lower it.
        least_odds: odds below which a rival is not worth a trial.
        jobs: worker processes.
        seed: of all noise.
    """

    first_replicates: int = 4
    replicates: int = 10
    closer: float = 3.0
    close: float = 30.0
    rival_replicates: int = 4
    most_effects: int = 8
    significance: float = 0.01
    worth: float = 0.03
    worth_at_floor: float = 0.16
    least_force: float = 5e-4
    still_share: float = 2.0 / 3.0
    unmoved: float = 0.01
    least_slope: float = 0.2
    carried: float = 0.25
    runs_away: float = 10.0
    share: float = 0.15
    above_floor_sd: float = 2.0
    shrunken: float = 0.4
    raised: float = 2.0
    worth_without_second: float = 0.5
    held_out_weight: float = 0.05
    timing_sd: float = 3.0
    limit_sd: float = 2.0
    predictable: float = 0.05
    surely: float = 2.0
    explained: float = 0.5
    resembles: float = 0.35
    likely: float = 0.5
    decided: float = 0.9
    clear_odds: float = 2.0
    rival_score: float = 0.9
    swap: float = 0.05
    replay_error: float = 0.01
    worth_searching: float = 4.0
    rival_share: float = 0.6
    most_rivals: int = 4
    rival_misfit: float = 2.0
    rival_margin: float = 1.0
    score_error: float = 0.1
    score_sd: float = 2.0
    other_band_replicates: int = 3
    other_band_ratio: float = 2.0
    variable_share: float = 0.2
    ripple_share: float = 0.5
    direction_likeness: float = 0.6
    mentioned_share: float = 0.005
    bump_height: float = 0.5
    bump_width: float = 1.0 / 3.0
    idle: float = 0.1
    most_alike: int = 2
    draft_replicates: int = 6
    draft_significance: float = 0.01
    draft_close: float = 6.0
    draft_worth: float = 0.03
    draft_rival_share: float = 0.5
    confused: float = 0.01
    confusion_left: float = 0.5
    lowered: float = 0.8
    least_odds: float = 0.02
    jobs: int = 2
    seed: int = 0

    @property
    def most_replicates(self) -> int:
        """Replays of the model for the chance level where a decision is close."""
        return round(self.closer * self.replicates)
