"""Energy and inverse dynamics of simulated motions."""

import numpy as np
import pytest
from motions import conservative_bam, energies, made_up_effect, typical_parameters
from scipy.integrate import solve_ivp

from bampipe.physics import Model, compile_model, registry

BAM = registry.device("bam")
# A rubber band keeps the rod within reach.
RUBBER = made_up_effect(
    "device", "energy", {"stiffness": ("N/m", 400.0, 0.0)},
    potential="stiffness*(extension - 1)**2/2",
)  # fmt: skip


def fly(system, x0, p, u=None, seconds=10.0):
    """Motion under a constant or given input u(t) without process noise; tight DOP853."""
    w, rate = np.zeros(len(system.noise)), np.empty(len(system.states))
    constant = np.zeros(len(system.inputs))

    def derivative(t, x):
        system.derivative(x, constant if u is None else u(t), p, w, rate)
        return rate.copy()

    t = np.linspace(0.0, seconds, 500)
    done = solve_ivp(
        derivative, (0.0, seconds), x0, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-13
    )
    assert done.success
    return t, done.y.T


@pytest.mark.parametrize(
    "effects",
    [(), ("handle_payload", "base_tilt", "inertia_mismatch:yaw", "inertia_mismatch:extension")],
    ids=["device", "effects of kind energy"],
)
def test_energy_is_conserved_without_friction(effects):
    device = conservative_bam()
    system = compile_model(Model(device, ("made_up", *effects), (RUBBER,)))
    p = typical_parameters(system)
    _, x = fly(system, np.array([0.2, 0.4, 1.0, 1.5, -0.8, 0.3]), p)
    kinetic, potential = energies(system, x[:, :3], x[:, 3:], p)
    total = kinetic + potential
    assert np.ptp(kinetic) > 1.0
    assert np.abs(total - total[0]).max() / kinetic.max() < 1e-8
