r"""LQG: linear dynamics and quadratic cost, seen through noise (item 8.36).

The regulator of Algorithm 17 acts on the estimate of the Kalman filter, $u_t = K_t \hat x_{t|t} + k_t$. Estimating and controlling come
apart: the gains are those of the regulator that sees the state, the filter's those of a system that nobody controls. Because

$$Q_t(x, u) = V_t(x) + \tfrac12 (u - K_t x - k_t)^\top Q_{uu,t} (u - K_t x - k_t),$$

not seeing the state costs $\tfrac12 \mathrm{tr}(K_t^\top Q_{uu,t} K_t P_{t|t})$ at each step, and in all

$$J = \tfrac12 m^\top V_0 m + v_0^\top m + \tfrac12 \mathrm{tr}(V_0 P) + n_0
+ \sum_t \tfrac12 \mathrm{tr}\big(K_t^\top Q_{uu,t} K_t P_{t|t}\big),$$

where $n_0$ holds what the noise of the dynamics costs ($\sum_t \tfrac12 \mathrm{tr}\, V_{t+1} \Sigma_t$).

Source: notes 8.2.7 and 8.3.4; Joseph and Tou 1961 (separation).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Action, Carry, Observation, Policy, PRNGKey, Solution
from ..ops.kalman import LinearGaussian, kalman_gain
from .linear_quadratic import LQProblem, Regulator, riccati


class Estimating(Policy):
    """The regulator's gains on a filtered state. Its memory is the time and the state expected before the next look.

    After the last step it goes on with the last gains.

    - `K` `[H, U, X]`, `k` `[H, U]`: of the regulator. `L` `[H, X, O]`: of the filter.
    """

    K: Float[Array, "H U X"]
    k: Float[Array, "H U"]
    L: Float[Array, "H X O"]
    system: LinearGaussian

    def init(self, key: PRNGKey) -> Carry:
        del key
        return jnp.zeros((), jnp.int32), self.system.mean

    def estimate(self, carry: Carry, observation: Observation) -> Float[Array, "X"]:
        """The mean of the state after a look."""
        time, expected = carry
        t = jnp.minimum(time, len(self.K) - 1)
        G, g, _ = self.system.sensor_at(t)
        return expected + self.L[t] @ (observation - G @ expected - g)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        time, _ = carry
        t = jnp.minimum(time, len(self.K) - 1)
        state = self.estimate(carry, observation)
        action = self.K[t] @ state + self.k[t]
        F, f, _ = self.system.dynamics_at(t)
        return (time + 1, F @ jnp.concatenate([state, action]) + f), action, {}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return {
            "mean": self(carry, observation, jax.random.key(0))[1],
            "estimate": self.estimate(carry, observation),
        }


def lqg(problem: LQProblem, G: Any, sensor_noise: Any, mean: Any, covariance: Any, g: Any = None) -> Solution:
    """The best controller of a linear system that is seen as o = G x + g + noise, before each action.

    - `problem`: dynamics with their noise, and cost. `G` `[O, X]`, `g` `[O]`, `sensor_noise` `[O, O]`, or with a leading axis of time.
    - `mean` `[X]`, `covariance` `[X, X]`: of the first state.

    `value` is a `Policy` (`Estimating`). `stats`: `cost`, the expected cost; `seen`, what the same system costs whoever sees its state;
    `regulator`; `covariances` `[H, X, X]` of the estimates. Errors as in `riccati`, and `ValueError` for shapes that do not fit.
    """
    x = problem.state_size
    noise = jnp.zeros((x, x), problem.F.dtype) if problem.noise is None else problem.noise
    system = LinearGaussian(problem.F, noise, G, sensor_noise, mean, covariance, problem.f, g)
    solution = riccati(problem)
    regulator: Regulator = solution.value
    gains, covariances, blind = _filter_gains(system, regulator)
    m = system.mean
    seen = regulator.cost_to_go(m) + 0.5 * (regulator.V[0] * system.covariance).sum()
    stats = solution.stats | {
        "cost": seen + blind,
        "seen": seen,
        "regulator": regulator,
        "covariances": covariances,
    }
    return Solution(Estimating(regulator.K, regulator.k, gains, system), solution.converged, stats)


@jax.jit
def _filter_gains(
    system: LinearGaussian, regulator: Regulator
) -> tuple[Float[Array, "H X O"], Float[Array, "H X X"], Float[Array, ""]]:
    """Gains and covariances of the filter, which depend on nothing that is seen or done, and what not seeing the state costs."""
    x = system.mean.shape[0]

    def step(covariance: Array, now: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array, Array]]:
        K, Q, t = now
        G, _, R = system.sensor_at(t)
        gain, after, _ = kalman_gain(covariance, G, R)
        F, _, noise = system.dynamics_at(t)
        A = F[:, :x]
        return A @ after @ A.T + noise, (gain, after, 0.5 * ((K.T @ Q[x:, x:] @ K) * after).sum())

    times = jnp.arange(len(regulator.K))
    dtype = jnp.result_type(system.covariance, system.F)
    _, (gains, covariances, costs) = jax.lax.scan(
        step, system.covariance.astype(dtype), (regulator.K, regulator.Q, times)
    )
    return gains, covariances, costs.sum()
