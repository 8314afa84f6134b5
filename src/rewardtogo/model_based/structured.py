r"""Structured inference in a chain of unknown linear dynamics: Gaussian potentials from a network, and the rest in closed form.

$$(W, \Sigma) \sim \mathrm{MNIW}, \qquad s_0 \sim N(0, I), \qquad s_{t+1} \sim N(W x_t, \Sigma), \quad x_t = (s_t, a_t, 1), \qquad
\psi(s_t; o_t) = \log N(s_t; \mu(o_t), \sigma^2(o_t)).$$

What is wanted of the states is the best $q(s_{0:T}) q(W, \Sigma)$ for the potentials in the place of the observations' likelihoods. Each
half is in closed form given the other (Johnson et al. 2016):

- $q(s) \propto p(s_0) \prod_t \exp\big(E_{q(W, \Sigma)} \log p(s_{t+1} \mid x_t) + \psi(s_t)\big)$ is a chain, to be smoothed by Kalman's
  filter: $E[\log N(y; W x, \Sigma)]$ is the density of $N(M x, \Psi / \nu)$ less $\tfrac12 D\, x^\top \Lambda^{-1} x$, one more potential.
- $q(W, \Sigma)$ is the prior with the expected moments of $(x_t, s_{t+1})$ under q(s) added.

With one law for all times this is a global model; with one law for each time, whose prior is the global one, it is a local one, linear and
changing with time.

Sources: notes 8.3.4 with errata E8.17 and E8.18; Johnson et al. 2016 (structured variational autoencoders); Zhang et al. 2019 (SOLAR).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, ScalarLike

from ..ops.bayesian import MatrixNormalInverseWishart, RegressionMoments
from ..ops.distributions import DiagGaussian
from ..ops.kalman import LinearGaussian, Smoothed, kalman_smoother

Laws = MatrixNormalInverseWishart
"""With an axis of time where each step has its own."""


class ExpectedDynamics(eqx.Module):
    """All that E[log p(s_{t+1} | s_t, a_t)] is made of, for each step.

    - `weights` M, `noise` Psi / nu, `unsure` D Lambda^-1.
    - `gap`: E[log |Sigma|] less the logarithm of the determinant of `noise`.
    """

    weights: Float[Array, "*H X Z"]
    noise: Float[Array, "*H X X"]
    unsure: Float[Array, "*H Z Z"]
    gap: Float[Array, "*H"]

    @staticmethod
    def of(laws: Laws, horizon: int) -> "ExpectedDynamics":
        """Of one law for all steps, or of one for each."""

        def one(law: Laws) -> "ExpectedDynamics":
            features = len(law.seen.xx)
            inverse = cho_solve((jnp.linalg.cholesky(law.seen.xx), True), jnp.eye(features, dtype=law.seen.xx.dtype))
            noise = law.noise
            log_det = 2.0 * jnp.log(jnp.diagonal(jnp.linalg.cholesky(noise))).sum()
            return ExpectedDynamics(
                law.mean, noise, len(noise) * 0.5 * (inverse + inverse.T), law.expected_log_det() - log_det
            )

        if laws.seen.count.ndim == 1:
            return jax.vmap(one)(laws)
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (horizon, *a.shape)), one(laws))

    def system(self, potentials: DiagGaussian) -> LinearGaussian:
        """The chain with the expected dynamics for the true ones, potentials as what is seen: `kalman_filter`'s states for acting."""
        size = self.noise.shape[-1]
        return LinearGaussian(
            self.weights[..., :-1], self.noise, jnp.eye(size), jax.vmap(jnp.diag)(potentials.std**2),
            jnp.zeros(size), jnp.eye(size), self.weights[..., -1],
        )  # fmt: skip


def smoothed_states(
    dynamics: ExpectedDynamics, potentials: DiagGaussian, actions: Float[Array, "H U"]
) -> tuple[Smoothed, Float[Array, ""]]:
    """q(s_{0:H}) of one sequence, from potentials `[H + 1, X]`, and the logarithm of what it is normalised by."""
    size = dynamics.noise.shape[-1]
    known = jnp.concatenate([actions, jnp.ones((len(actions), 1), actions.dtype)], 1)
    precision = 1.0 / potentials.std**2
    # The last state leads nowhere, so that nothing is unsure about it.
    last = lambda a: jnp.concatenate([a, jnp.zeros((1, *a.shape[1:]), a.dtype)])  # noqa: E731
    unsure = dynamics.unsure
    J = jax.vmap(jnp.diag)(precision) + last(unsure[:, :size, :size])
    h = precision * potentials.mean - last(jnp.einsum("tsv,tv->ts", unsure[:, :size, size:], known))
    factor = jnp.linalg.cholesky(J)
    eye = jnp.eye(size, dtype=J.dtype)
    R = jax.vmap(lambda L: cho_solve((L, True), eye))(factor)
    R = 0.5 * (R + jnp.swapaxes(R, 1, 2))
    seen = jnp.einsum("tij,tj->ti", R, h)
    moved = jnp.einsum("txv,tv->tx", dynamics.weights[..., size:], known)
    system = LinearGaussian(dynamics.weights[..., :size], dynamics.noise, eye, R, jnp.zeros(size), jnp.eye(size), moved)
    posterior, likelihood = kalman_smoother(system, seen, jnp.zeros((len(actions), 0), actions.dtype))
    log_det = 2.0 * jnp.log(jax.vmap(jnp.diagonal)(factor)).sum()
    paid = jnp.einsum("tv,tvw,tw->", known, unsure[:, size:, size:], known)
    constant = (
        -0.5 * (precision * potentials.mean**2).sum() + 0.5 * jnp.log(precision).sum() - 0.5 * paid
        + 0.5 * (h * seen).sum() - 0.5 * log_det - 0.5 * dynamics.gap.sum()
    )  # fmt: skip
    return posterior, likelihood + constant


def chain_kl(posterior: Smoothed, potentials: DiagGaussian, log_normaliser: Float[Array, ""]) -> Float[Array, ""]:
    """KL(q(s) || p(s)) in nats, log p(s) in the mean over q(W, Sigma): E[sum of the potentials] less the normaliser's logarithm."""
    variance = jax.vmap(jnp.diagonal)(posterior.covariance)
    square = ((posterior.mean - potentials.mean) ** 2 + variance) / potentials.std**2
    expected = -0.5 * square.sum() - potentials.log_std.sum() - 0.5 * square.size * math.log(2.0 * math.pi)
    return expected - log_normaliser


def transition_moments(posterior: Smoothed, actions: Float[Array, "H U"]) -> RegressionMoments:
    """Expected moments of s_{t+1} on (s_t, a_t, 1) under q(s), for each step `[H]`."""
    known = jnp.concatenate([actions, jnp.ones((len(actions), 1), actions.dtype)], 1)

    def one(m: Array, P: Array, following: Array, P_next: Array, cross: Array, v: Array) -> RegressionMoments:
        size = len(m)
        x = jnp.concatenate([m, v])
        xx = jnp.outer(x, x).at[:size, :size].add(P)
        yx = jnp.outer(following, x).at[:, :size].add(cross.T)
        return RegressionMoments(xx, yx, jnp.outer(following, following) + P_next, jnp.ones((), m.dtype))

    mean, covariance = posterior.mean, posterior.covariance
    return jax.vmap(one)(mean[:-1], covariance[:-1], mean[1:], covariance[1:], posterior.cross, known)


def weighted_sum(moments: RegressionMoments, weights: Float[Array, "N"]) -> RegressionMoments:
    """Over the leading axis."""
    return jax.tree.map(lambda a: jnp.tensordot(weights, a, 1), moments)


def believed(law: Laws, samples: ScalarLike) -> Laws:
    """The same means from fewer samples (or more): a global law as the prior of local ones."""
    return Laws(law.seen.scaled(jnp.asarray(samples) / law.seen.count))


def local_laws(
    prior: Laws,
    start: Laws,
    potentials: DiagGaussian,
    actions: Float[Array, "N H U"],
    weights: Float[Array, "N"],
    rounds: int,
) -> tuple[Laws, Smoothed]:
    """A law for each step `[H]` from sequences of the same times, and q(s) of each `[N]`, by turns.

    - `prior`: of every step's law. `start`: what the first q(s) is made with.
    - `potentials`: `[N, H + 1, X]`. `weights`: of the sequences.
    """
    horizon = actions.shape[1]

    def states(laws: Laws) -> Smoothed:
        dynamics = ExpectedDynamics.of(laws, horizon)
        return jax.vmap(lambda p, a: smoothed_states(dynamics, p, a)[0])(potentials, actions)

    def laws_of(posterior: Smoothed) -> Laws:
        moments = weighted_sum(jax.vmap(transition_moments)(posterior, actions), weights)
        return jax.vmap(prior.observe)(moments)

    def turn(laws: Laws, _: None) -> tuple[Laws, None]:
        return laws_of(states(laws)), None

    laws = laws_of(states(start))
    laws = jax.lax.scan(turn, laws, None, length=rounds - 1)[0]
    return laws, states(laws)
