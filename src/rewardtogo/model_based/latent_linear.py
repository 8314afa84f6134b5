r"""Latent state-space models in the one case where everything is known exactly: linear dynamics and sensors, Gaussian noise (notes 8.3.4).

$$\log p(o_{1:T} \mid a) \ge \mathcal{L}(q) = \underbrace{E_q\Big[\log p(s_1) + \sum_{t=1}^{T-1} \log p(s_{t+1} \mid s_t, a_t)
+ \sum_{t=1}^{T} \log p(o_t \mid s_t)\Big]}_{\text{what the notes maximise}} + H(q),$$

with equality for the posterior $q = p(s_{1:T} \mid o_{1:T}, a_{1:T})$, which is the smoother's and not the filter's (erratum E8.18).
The notes leave the entropy $H(q)$ out: with a posterior that is computed it does not depend on the model and may be left out of the M-step,
with an encoder that is learned it may not (erratum E8.17: a deterministic one makes the objective unbounded).

Encoders, from crude to exact: of one frame $q(s_t \mid o_t)$, the filter's $q(s_t \mid o_{1:t}, a_{1:t-1})$, and the smoother's pairs
$q(s_t, s_{t+1} \mid o_{1:T}, a_{1:T})$. `fit_linear_gaussian` alternates the last with the maximum of the objective in closed form, which
is expectation maximisation (Shumway and Stoffer 1982) and raises the likelihood in every iteration.

Rewards that depend on the state are entries of the observation here. Source: notes 8.3.4 with errata E8.17 and E8.18; items 8.63 to 8.67.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from ..core import Solution
from ..ops.kalman import LinearGaussian, Smoothed, gaussian_log_prob, kalman_filter, kalman_gain, kalman_smoother


def fully_observed_objective(
    system: LinearGaussian, states: Float[Array, "T X"], actions: Float[Array, "S U"]
) -> Float[Array, ""]:
    """1/(T - 1) sum_t log p(s_{t+1} | s_t, a_t), where the states are seen (item 8.65)."""

    def one(state: Array, action: Array, following: Array, t: Array) -> Array:
        F, f, noise = system.dynamics_at(t)
        return gaussian_log_prob(following - F @ jnp.concatenate([state, action]) - f, noise)

    return jax.vmap(one)(states[:-1], actions, states[1:], jnp.arange(len(actions))).mean()


def fit_dynamics(
    states: Float[Array, "N X"], actions: Float[Array, "N U"], following: Float[Array, "N X"]
) -> tuple[Float[Array, "X Z"], Float[Array, "X"], Float[Array, "X X"]]:
    """F, f and noise that maximise the fully observed objective: least squares, and the mean square of what is left."""
    inputs = jnp.concatenate([states, actions, jnp.ones((len(states), 1), states.dtype)], 1)
    return _regressed(inputs.T @ inputs, inputs.T @ following, following.T @ following, len(states))


def _regressed(
    inputs: Float[Array, "I I"], cross: Float[Array, "I D"], outputs: Float[Array, "D D"], count: int | Array
) -> tuple[Float[Array, "D J"], Float[Array, "D"], Float[Array, "D D"]]:
    """Weights, offset (of the last input, which is 1) and covariance of a Gaussian regression, from sums of products."""
    weights = cho_solve(cho_factor(inputs, lower=True), cross).T
    left = outputs - weights @ cross
    return weights[:, :-1], weights[:, -1], 0.5 * (left + left.T) / count


def expected_objective(
    system: LinearGaussian, posterior: Smoothed, observations: Float[Array, "T O"], actions: Float[Array, "S U"]
) -> Float[Array, ""]:
    """E_q[log p(s_1) + sum log p(s_{t+1} | s_t, a_t) + sum log p(o_t | s_t)] of one sequence, exactly (item 8.66, without H(q))."""

    def mean_log_prob(error: Array, spread: Array, covariance: Array) -> Array:
        """E[log N(e; 0, covariance)] of an e with this mean and spread."""
        return gaussian_log_prob(error, covariance) - 0.5 * jnp.trace(
            cho_solve(cho_factor(covariance, lower=True), spread)
        )

    mean, covariance, cross = posterior.mean, posterior.covariance, posterior.cross
    x = mean.shape[1]

    def moved(t: Array) -> Array:
        F, f, noise = system.dynamics_at(t)
        A = F[:, :x]
        error = mean[t + 1] - F @ jnp.concatenate([mean[t], actions[t]]) - f
        both = A @ cross[t]
        spread = covariance[t + 1] - both - both.T + A @ covariance[t] @ A.T
        return mean_log_prob(error, spread, noise)

    def seen(t: Array) -> Array:
        G, g, noise = system.sensor_at(t)
        return mean_log_prob(observations[t] - G @ mean[t] - g, G @ covariance[t] @ G.T, noise)

    times = jnp.arange(len(observations))
    first = mean_log_prob(mean[0] - system.mean, covariance[0], system.covariance)
    return first + jax.vmap(moved)(times[:-1]).sum() + jax.vmap(seen)(times).sum()


def posterior_entropy(posterior: Smoothed) -> Float[Array, ""]:
    """H(q) of a Gaussian Markov chain: that of the pairs less that of the states between them."""
    entropy = lambda S: 0.5 * (jnp.linalg.slogdet(S)[1] + len(S) * math.log(2.0 * math.pi * math.e))  # noqa: E731

    def pair(before: Array, after: Array, cross: Array) -> Array:
        return entropy(jnp.block([[before, cross], [cross.T, after]]))

    covariance = posterior.covariance
    if len(covariance) == 1:
        return entropy(covariance[0])
    pairs = jax.vmap(pair)(covariance[:-1], covariance[1:], posterior.cross)
    between = jax.vmap(entropy)(covariance[1:-1]) if len(covariance) > 2 else jnp.zeros(1)
    return pairs.sum() - between.sum()


def evidence_bound(
    system: LinearGaussian, posterior: Smoothed, observations: Float[Array, "T O"], actions: Float[Array, "S U"]
) -> Float[Array, ""]:
    """L(q), at most log p(o_{1:T} | a), and equal to it for the posterior."""
    return expected_objective(system, posterior, observations, actions) + posterior_entropy(posterior)


def single_frame_encoder(system: LinearGaussian, prior: Smoothed, observations: Float[Array, "T O"]) -> Smoothed:
    """q(s_t | o_t): the prior of each time conditioned on its own observation alone, independent from time to time.

    - `prior`: means and covariances of the states before anything was seen, as `prior_states` gives them.
    """

    def one(mean: Array, covariance: Array, o: Array, t: Array) -> tuple[Array, Array]:
        G, g, R = system.sensor_at(t)
        gain, after, _ = kalman_gain(covariance, G, R)
        return mean + gain @ (o - G @ mean - g), after

    means, covariances = jax.vmap(one)(prior.mean, prior.covariance, observations, jnp.arange(len(observations)))
    return Smoothed(means, covariances, jnp.zeros_like(prior.cross))


def filter_encoder(system: LinearGaussian, observations: Float[Array, "T O"], actions: Float[Array, "S U"]) -> Smoothed:
    """q(s_t | o_{1:t}, a_{1:t-1}) of each time, independent from time to time: the best that can be known when acting."""
    known = kalman_filter(system, observations, actions)
    size = system.mean.shape[0]
    return Smoothed(known.mean, known.covariance, jnp.zeros((len(observations) - 1, size, size), known.mean.dtype))


def pairwise_encoder(
    system: LinearGaussian, observations: Float[Array, "T O"], actions: Float[Array, "S U"]
) -> Smoothed:
    """q(s_t, s_{t+1} | o_{1:T}, a_{1:T}): the posterior."""
    return kalman_smoother(system, observations, actions)[0]


def prior_states(system: LinearGaussian, actions: Float[Array, "S U"]) -> Smoothed:
    """Means and covariances of all states before anything is seen."""
    size = system.mean.shape[0]

    def step(before: tuple[Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        (mean, covariance), (u, t) = before, now
        F, f, noise = system.dynamics_at(t)
        A = F[:, :size]
        after = (F @ jnp.concatenate([mean, u]) + f, A @ covariance @ A.T + noise)
        return after, (*after, covariance @ A.T)

    first = (system.mean, system.covariance)
    _, (means, covariances, cross) = jax.lax.scan(step, first, (actions, jnp.arange(len(actions))))
    join = lambda start, rest: jnp.concatenate([start[None], rest])  # noqa: E731
    return Smoothed(join(first[0], means), join(first[1], covariances), cross)


def expectation_maximisation(
    system: LinearGaussian, observations: Float[Array, "N T O"], actions: Float[Array, "N S U"]
) -> tuple[LinearGaussian, Float[Array, ""]]:
    """One round: posteriors of all sequences, and the system that maximises the expected objective under them.

    Returns it with the log-likelihood of the system that was given, per observation. The system must not change with time.
    """
    x = system.mean.shape[0]
    smoothed, likelihood = jax.vmap(lambda o, u: kalman_smoother(system, o, u))(observations, actions)
    mean, covariance, cross = smoothed.mean, smoothed.covariance, smoothed.cross
    count, length = observations.shape[:2]
    flat = lambda a: a.reshape(-1, *a.shape[2:])  # noqa: E731

    def moments(m: Array, extra: Array, S: Array) -> Array:
        """Sum of E[y y'] of y = (s, extra, 1)."""
        y = jnp.concatenate([m, extra, jnp.ones((len(m), 1), m.dtype)], 1)
        return (y.T @ y).at[:x, :x].add(S.sum(0))

    before, after, u = flat(mean[:, :-1]), flat(mean[:, 1:]), flat(actions)
    inputs = moments(before, u, flat(covariance[:, :-1]))
    y = jnp.concatenate([before, u, jnp.ones((len(u), 1), u.dtype)], 1)
    between = (y.T @ after).at[:x].add(flat(cross).sum(0))
    moved = after.T @ after + flat(covariance[:, 1:]).sum(0)
    F, f, noise = _regressed(inputs, between, moved, len(u))

    m, o = flat(mean), flat(observations)
    none = jnp.zeros((len(m), 0), m.dtype)
    y = jnp.concatenate([m, jnp.ones((len(m), 1), m.dtype)], 1)
    G, g, sensor_noise = _regressed(moments(m, none, flat(covariance)), y.T @ o, o.T @ o, len(o))

    centre = mean[:, 0].mean(0)
    gap = mean[:, 0] - centre[None]
    first = covariance[:, 0].mean(0) + gap.T @ gap / count
    fitted = LinearGaussian(F, noise, G, sensor_noise, centre, first, f, g)
    return fitted, likelihood.sum() / (count * length)


def fit_linear_gaussian(
    system: LinearGaussian,
    observations: Float[Array, "N T O"],
    actions: Float[Array, "N S U"],
    iterations: int = 100,
) -> Solution:
    """A latent linear-Gaussian model learned from sequences of observations and actions, by expectation maximisation (item 8.63).

    - `system`: where to start; its state's size is the model's. Sensor and dynamics must not start at zero.

    `value` is the system, `stats["log_likelihood"]` `[iterations]` that of the data before each iteration, per observation. The state
    is found up to a change of its basis. Raises `ValueError` for no iteration, and for a system that changes with time.
    """
    if iterations < 1:
        raise ValueError(f"expectation maximisation takes at least one iteration, not {iterations}")
    if system.F.ndim > 2 or system.G.ndim > 2:
        raise ValueError(
            "one system is fitted to all times, and this one changes with time: give F and G without that axis"
        )
    fitted, history = _fit(system, observations, actions, iterations)
    settled = jnp.abs(history[-1] - history[-2]) < 1e-4 if iterations > 1 else jnp.zeros((), bool)
    return Solution(fitted, settled, {"log_likelihood": history, "iterations": jnp.asarray(iterations)})


@partial(jax.jit, static_argnames="iterations")
def _fit(
    system: LinearGaussian, observations: Float[Array, "N T O"], actions: Float[Array, "N S U"], iterations: int
) -> tuple[LinearGaussian, Float[Array, "K"]]:
    def step(now: LinearGaussian, _: None) -> tuple[LinearGaussian, Array]:
        return expectation_maximisation(now, observations, actions)

    return jax.lax.scan(step, system, None, length=iterations)
