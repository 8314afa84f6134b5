r"""A linear-Gaussian system that is seen through noise: the filter of Kalman (1960) and the smoother of Rauch, Tung and Striebel (1965).

$$x_0 \sim N(m, P), \qquad x_{t+1} = F_t \binom{x_t}{u_t} + f_t + w_t, \quad w_t \sim N(0, \Sigma_t), \qquad
o_t = G_t x_t + g_t + \epsilon_t, \quad \epsilon_t \sim N(0, R_t).$$

The filter gives $p(x_t \mid o_{0:t}, u_{0:t-1})$, forwards; the smoother $p(x_t, x_{t+1} \mid o_{0:T-1}, u_{0:T-2})$, backwards from the
last of the filter. Only the smoother's is the posterior that a sequence's likelihood is made of (erratum E8.18). The likelihood comes from
the filter's predictions, $\log p(o_{0:T-1} \mid u) = \sum_t \log N(o_t; G \hat x_{t|t-1} + g, S_t)$ with $S_t = G P_{t|t-1} G^\top + R$.

Covariances are updated in Joseph's form, which stays symmetric and positive under rounding.

Source: notes 8.3.4 and 8.2.7; items 8.36 and 8.63 to 8.67.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from ..core import PRNGKey


class LinearGaussian(eqx.Module):
    """Dynamics, sensor and first state of a linear system with Gaussian noise.

    - `F` `[X, X + U]`, `f` `[X]`, `noise` `[X, X]`: the next state; U may be 0.
    - `G` `[O, X]`, `g` `[O]`, `sensor_noise` `[O, O]`: what is seen of a state.
    - `mean` `[X]`, `covariance` `[X, X]`: of the first state.

    What is seen must be uncertain beforehand: G P G' + `sensor_noise` positive definite.

    The first six may have a leading axis of time; entry t of the dynamics leads from t to t + 1. Offsets left out are zeros.
    Raises `ValueError` for shapes that do not fit each other.
    """

    F: Float[Array, "*T X Z"]
    f: Float[Array, "*T X"]
    noise: Float[Array, "*T X X"]
    G: Float[Array, "*T O X"]
    g: Float[Array, "*T O"]
    sensor_noise: Float[Array, "*T O O"]
    mean: Float[Array, "X"]
    covariance: Float[Array, "X X"]

    def __init__(
        self,
        F: Any,
        noise: Any,
        G: Any,
        sensor_noise: Any,
        mean: Any,
        covariance: Any,
        f: Any = None,
        g: Any = None,
    ):
        if len(np.shape(F)) not in (2, 3) or len(np.shape(G)) not in (2, 3):
            raise ValueError(f"F is [X, X + U] and G [O, X], not {np.shape(F)} and {np.shape(G)}")
        (x, z), (o, _) = np.shape(F)[-2:], np.shape(G)[-2:]
        parts = {
            "F": (F, (x, z)),
            "f": (jnp.zeros(x) if f is None else f, (x,)),
            "noise": (noise, (x, x)),
            "G": (G, (o, x)),
            "g": (jnp.zeros(o) if g is None else g, (o,)),
            "sensor_noise": (sensor_noise, (o, o)),
            "mean": (mean, (x,)),
            "covariance": (covariance, (x, x)),
        }
        if z < x:
            raise ValueError(f"F maps a state and an action to a state, so it is [X, X + U], not {np.shape(F)}")
        for name, (value, shape) in parts.items():
            array = jnp.asarray(value)
            array = array if jnp.issubdtype(array.dtype, jnp.inexact) else array.astype(float)
            timed = name not in ("mean", "covariance") and array.ndim == len(shape) + 1
            if array.shape[timed:] != shape:
                raise ValueError(f"{name} has shape {array.shape}: with these F and G it must be {shape}")
            object.__setattr__(self, name, array)

    def dynamics_at(self, t: Array | int) -> tuple[Array, Array, Array]:
        """F, f and Sigma of a step."""
        return _at(self.F, 2, t), _at(self.f, 1, t), _at(self.noise, 2, t)

    def sensor_at(self, t: Array | int) -> tuple[Array, Array, Array]:
        """G, g and R of a time."""
        return _at(self.G, 2, t), _at(self.g, 1, t), _at(self.sensor_noise, 2, t)


class Filtered(eqx.Module):
    """What the filter knows: `predicted_*` before and `mean`, `covariance` after each observation, the gains, and log p(o_t | the past)."""

    predicted_mean: Float[Array, "T X"]
    predicted_covariance: Float[Array, "T X X"]
    mean: Float[Array, "T X"]
    covariance: Float[Array, "T X X"]
    gain: Float[Array, "T X O"]
    log_likelihood: Float[Array, "T"]


class Smoothed(eqx.Module):
    """The posterior of all states given everything: mean, covariance, and Cov(x_t, x_{t+1}) `[T - 1, X, X]`."""

    mean: Float[Array, "T X"]
    covariance: Float[Array, "T X X"]
    cross: Float[Array, "S X X"]


def _at(value: Array, rank: int, t: Array | int) -> Array:
    return value[t] if value.ndim > rank else value


def gaussian_log_prob(error: Float[Array, "D"], covariance: Float[Array, "D D"]) -> Float[Array, ""]:
    """Density of N(0, covariance) at `error`, its logarithm."""
    factor = cho_factor(covariance, lower=True)
    log_det = 2.0 * jnp.log(jnp.diagonal(factor[0])).sum()
    return -0.5 * (error @ cho_solve(factor, error) + log_det + len(error) * math.log(2.0 * math.pi))


def predict(
    mean: Float[Array, "X"],
    covariance: Float[Array, "X X"],
    action: Float[Array, "U"],
    F: Float[Array, "X Z"],
    f: Float[Array, "X"],
    noise: Float[Array, "X X"],
) -> tuple[Float[Array, "X"], Float[Array, "X X"]]:
    """One step of the dynamics."""
    A = F[:, : len(mean)]
    return F @ jnp.concatenate([mean, action]) + f, A @ covariance @ A.T + noise


def kalman_gain(
    covariance: Float[Array, "X X"], G: Float[Array, "O X"], sensor_noise: Float[Array, "O O"]
) -> tuple[Float[Array, "X O"], Float[Array, "X X"], Float[Array, "O O"]]:
    """The gain, the covariance after the observation, and that of the observation itself."""
    spread = G @ covariance @ G.T + sensor_noise
    gain = cho_solve(cho_factor(spread, lower=True), G @ covariance).T
    kept = jnp.eye(len(covariance), dtype=covariance.dtype) - gain @ G
    after = kept @ covariance @ kept.T + gain @ sensor_noise @ gain.T
    return gain, 0.5 * (after + after.T), spread


def _padded(actions: Float[Array, "S U"], count: int) -> Float[Array, "T U"]:
    """One action for each observation; the last leads to nothing that is seen."""
    if len(actions) not in (count - 1, count):
        raise ValueError(f"{count} observations have {count - 1} actions between them, not {len(actions)}")
    last = jnp.zeros((1, actions.shape[1]), actions.dtype)
    return actions if len(actions) == count else jnp.concatenate([actions, last])


@jax.jit
def kalman_filter(system: LinearGaussian, observations: Float[Array, "T O"], actions: Float[Array, "S U"]) -> Filtered:
    """p(x_t | o_{0:t}, u_{0:t-1}) for all t. `actions` are the T - 1 between the observations (a last one more is not used).

    Raises `ValueError` for another number of actions.
    """
    count = len(observations)

    def step(
        prior: tuple[Array, Array], now: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        (mean, covariance), (o, u, t) = prior, now
        G, g, R = system.sensor_at(t)
        gain, after, spread = kalman_gain(covariance, G, R)
        error = o - G @ mean - g
        seen = mean + gain @ error
        known = (mean, covariance, seen, after, gain, gaussian_log_prob(error, spread))
        return predict(seen, after, u, *system.dynamics_at(t)), known

    start = (system.mean, system.covariance)
    return Filtered(*jax.lax.scan(step, start, (observations, _padded(actions, count), jnp.arange(count)))[1])


@jax.jit
def kalman_smoother(
    system: LinearGaussian, observations: Float[Array, "T O"], actions: Float[Array, "S U"]
) -> tuple[Smoothed, Float[Array, ""]]:
    """p(x_t, x_{t+1} | o_{0:T-1}, u_{0:T-2}) for all t, and the log-likelihood of the observations."""
    known = kalman_filter(system, observations, actions)
    x = system.mean.shape[0]

    def step(later: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        (mean, covariance), (m, P, m_next, P_next, t) = later, now
        A = system.dynamics_at(t)[0][:, :x]
        J = cho_solve(cho_factor(P_next, lower=True), A @ P).T
        smooth = P + J @ (covariance - P_next) @ J.T
        smooth = 0.5 * (smooth + smooth.T)
        mean = m + J @ (mean - m_next)
        return (mean, smooth), (mean, smooth, J @ covariance)

    last = (known.mean[-1], known.covariance[-1])
    steps = (known.mean[:-1], known.covariance[:-1], known.predicted_mean[1:], known.predicted_covariance[1:])
    _, (means, covariances, cross) = jax.lax.scan(step, last, (*steps, jnp.arange(len(observations) - 1)), reverse=True)
    join = lambda rest, end: jnp.concatenate([rest, end[None]])  # noqa: E731
    return Smoothed(join(means, last[0]), join(covariances, last[1]), cross), known.log_likelihood.sum()


@jax.jit
def simulate_linear(
    system: LinearGaussian, actions: Float[Array, "S U"], key: PRNGKey
) -> tuple[Float[Array, "T X"], Float[Array, "T O"]]:
    """States and observations of one episode, one more than there are actions."""
    first_key, state_key, sensor_key = jax.random.split(key, 3)
    x = system.mean.shape[0]
    draw = lambda k, S: jax.random.multivariate_normal(  # noqa: E731
        k, jnp.zeros(len(S), S.dtype), S, method="eigh"
    )

    def step(state: Array, now: tuple[Array, Array, PRNGKey]) -> tuple[Array, Array]:
        u, t, k = now
        F, f, noise = system.dynamics_at(t)
        following = F @ jnp.concatenate([state, u]) + f + draw(k, noise)
        return following, following

    first = system.mean + draw(first_key, system.covariance)
    times = jnp.arange(len(actions))
    _, states = jax.lax.scan(step, first, (actions, times, jax.random.split(state_key, len(actions))))
    states = jnp.concatenate([first[None], states]).reshape(-1, x)

    def look(state: Array, t: Array, k: PRNGKey) -> Array:
        G, g, R = system.sensor_at(t)
        return G @ state + g + draw(k, R)

    seen = jax.vmap(look)(states, jnp.arange(len(states)), jax.random.split(sensor_key, len(states)))
    return states, seen
