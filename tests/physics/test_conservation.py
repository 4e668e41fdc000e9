"""Energy along a simulated motion."""

import numpy as np
from motions import conservative_bam, energies, made_up_effect, typical_parameters
from scipy.integrate import solve_ivp

from bampipe.physics import Model, compile_model

# A rubber band keeps the rod within reach.
RUBBER = made_up_effect(
    "device", "energy", {"stiffness": ("N/m", 400.0, 0.0)},
    potential="stiffness*(extension - 1)**2/2",
)  # fmt: skip


EFFECTS = ("handle_payload", "base_tilt", "inertia_mismatch:yaw", "inertia_mismatch:extension")


def test_energy_is_conserved_without_friction():
    """With effects of kind energy; those of the device are held against equations by hand."""
    device = conservative_bam()
    system = compile_model(Model(device, ("made_up", *EFFECTS), (RUBBER,)))
    p, u, w = typical_parameters(system), np.zeros(len(system.inputs)), np.zeros(len(system.noise))

    def derivative(_, x):
        rate = np.empty(len(x))
        system.derivative(x, u, p, w, rate)
        return rate

    start = np.array([0.2, 0.4, 1.0, 1.5, -0.8, 0.3])
    done = solve_ivp(derivative, (0.0, 10.0), start, "DOP853", rtol=1e-12, atol=1e-13)
    assert done.success
    x = done.y.T
    kinetic, potential = energies(system, x[:, :3], x[:, 3:], p)
    total = kinetic + potential
    assert np.ptp(kinetic) > 1.0
    assert np.abs(total - total[0]).max() / kinetic.max() < 1e-8
