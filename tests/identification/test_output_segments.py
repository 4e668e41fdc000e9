"""The pieces that output error simulates start where the mechanism was."""

import numpy as np
import pytest
from diagnosis.sessions import bam, made

from bampipe.diagnosis.session import system_of
from bampipe.estimate.unscented import Trial
from bampipe.identification.output_estimate import cut_segments


@pytest.mark.parametrize("effects", [(), ("transmission_compliance:yaw",)])
def test_a_segment_starts_at_what_its_encoders_read(effects) -> None:
    """With wind-up, too: at its start the simulation reads what was measured, to a few counts."""
    recipe = bam(effects)
    system = system_of(recipe)
    values = {"transmission_compliance.yaw.compliance": 1e-3}
    session = made(recipe, values, trials=1)
    motion = session.motions[0]
    p = np.array([values.get(item.name, item.prior) for item in system.parameters])
    u, none = motion.inputs(system.inputs), np.zeros(len(system.states))
    segments = cut_segments(system, motion, Trial(motion.t, u, motion.q, none, none), p)
    assert len(segments) > 3
    for segment in segments:
        assert segment.x0.shape == (len(system.states),)
        read = segment.simulate(segment.x0, np.append(p, 0.0))
        assert np.abs(read[0] - segment.q[0]).max() < 2e-4
