"""The identification filter by dynamax: run by filter_speed.py, also in another environment.

``python by_dynamax.py PROBLEM.npz DERIVATIVE.py``: the record and settings, and the text of the
model's state derivative; prints JSON with the filtered parameters and the seconds of each repeat.
"""

from __future__ import annotations

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from dynamax.nonlinear_gaussian_ssm import (  # noqa: E402
    ParamsNLGSSM,
    UKFHyperParams,
    unscented_kalman_filter,
)

READING_UNIT = 1e-8  # rad, m: dynamax adds 1e-9 to the innovation's covariance


def main() -> None:
    """Filter the record several times over and print what came of it."""
    problem = np.load(sys.argv[1])
    names = {"sin": jnp.sin, "cos": jnp.cos, "tanh": jnp.tanh, "exp": jnp.exp}
    with open(sys.argv[2], encoding="utf-8") as file:
        exec(file.read(), names)  # written by filter_speed.py from the generated model
    derivative = names["derivative"]
    u, y, p = problem["u"], problem["y"], problem["p"]
    nx, nt, nw = int(problem["nx"]), p.size, problem["noise_sd"].size
    n, nu = nx + nt, u.shape[1]
    dt, steps = problem["dt"], int(problem["steps"])
    log = int(problem["logarithmic"])

    def rates(x, inputs, parameters, w):
        out = [0.0] * nx
        derivative(x, inputs, parameters, w, out)
        return jnp.stack(out)

    def move(state, both):
        x, theta, w = state[:nx], state[nx:n], state[n:]
        parameters = theta.at[log].set(jnp.exp(theta[log]))
        u0, u1 = both[:nu], both[nu : 2 * nu]
        delta = both[-1] / steps
        for k in range(steps):
            ends = [u0 + (u1 - u0) * ((k + share) / steps) for share in (0.0, 0.5, 1.0)]
            k1 = rates(x, ends[0], parameters, w)
            k2 = rates(x + 0.5 * delta * k1, ends[1], parameters, w)
            k3 = rates(x + 0.5 * delta * k2, ends[1], parameters, w)
            k4 = rates(x + delta * k3, ends[2], parameters, w)
            x = x + delta / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return jnp.concatenate([x, theta, jnp.zeros(nw)])

    ny = y.shape[1]
    process = np.diag(np.concatenate([np.zeros(n), np.square(problem["noise_sd"])]))
    covariance = process.copy()
    covariance[:n, :n] = problem["covariance"]
    model = ParamsNLGSSM(
        initial_mean=jnp.concatenate([jnp.asarray(problem["mean"]), jnp.zeros(nw)]),
        initial_covariance=jnp.asarray(covariance),
        dynamics_function=move,
        dynamics_covariance=jnp.asarray(process),
        emission_function=lambda state, _: state[:ny] / READING_UNIT,
        emission_covariance=jnp.diag(jnp.asarray(np.square(problem["reading_sd"] / READING_UNIT))),
    )
    # Since 1.0 dynamax carries the state to a sample with the inputs of that sample.
    inputs = jnp.asarray(np.hstack([u[:-1], u[1:], dt[:, None]]))
    readings = jnp.asarray(y[1:] / READING_UNIT)
    chosen = UKFHyperParams(alpha=float(problem["alpha"]), beta=2.0, kappa=0.0)

    @jax.jit
    def run(emissions, both):
        return unscented_kalman_filter(
            model, emissions, chosen, both, ["filtered_means"]
        ).filtered_means

    means = np.asarray(run(readings, inputs))
    seconds = []
    for _ in range(int(problem["repeats"])):
        begun = time.process_time()
        run(readings, inputs).block_until_ready()
        seconds.append(time.process_time() - begun)
    print(json.dumps({"theta": means[:, nx:n].tolist()[-1], "seconds": seconds}))


if __name__ == "__main__":
    main()
