"""The shape of a residual in words."""

from dataclasses import replace

from sessions import bam, fit_trials, made

from bampipe.diagnosis.description import describe
from bampipe.results.rounding import significant


def test_a_parameter_that_differs_between_trials_is_named_with_its_values():
    found = fit_trials(made(bam(), {}), bam())
    axis = found.system.coordinates.index("pitch")
    place = found.free.index(found.system.index("coulomb.pitch"))
    differs = [1.5, -0.5, 0.5, -1.5]
    rows = [by * x[:, :, place] for by, x in zip(differs, found.jacobian, strict=True)]
    changed = replace(found, residual=rows)
    middle = found.p[found.system.index("coulomb.pitch")]
    said = describe(changed, axis)
    low, high = (significant(middle + by, 2) for by in (-1.5, 1.5))
    ends = f"from {low} N.m in t01 to {high} N.m in t04"
    assert said.startswith(f"coulomb.pitch differs between trials, {ends}; this explains 100 %")
    same = replace(found, residual=[x[:, :, place] for x in found.jacobian])
    assert "differs" not in describe(same, axis)
    alone = [replace(motion, trial_id="t01") for motion in found.motions]
    assert "differs" not in describe(replace(changed, motions=alone), axis)
