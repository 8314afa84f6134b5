r"""Why fitted values may diverge, in the smallest examples, and what does converge (notes, section 5.4).

A linear V = Φ w is moved by the *expected* update of one method over a chain, with states weighed by d:

    semi-gradient TD     w <- w + α Φ'D (r + γ P Φ w - Φ w)
    residual gradient    w <- w - α ∇ ½ ||r + γ P Φ w - Φ w||²_D
    TDC / GTD2           the same fixed point as TD, by two time scales  (Sutton et al. 2009)
    fitted               Φ w <- Π_D (r + γ P Φ w)

Semi-gradient TD is no gradient descent of anything: its Jacobian, -A with A = Φ'D (I - γ P) Φ, is not symmetric. The notes say that this
is because the method is off-policy; it is because no derivative is taken through the target, on-policy or not (erratum E5.11). Whether it
converges is a question of d: with the stationary distribution of the policy A is positive definite and ||γ Π P||_d <= γ (Tsitsiklis and
Van Roy 1997), with another d it may be anything. That "fitted bootstrapped policy evaluation does not converge" is true in general and
false on-policy (erratum E5.10). Averagers, whose fits are weighted means of their data, always converge (Gordon 1995).

Source: notes, section 5.4; Tsitsiklis and Van Roy 1996 (w, 2w); Baird 1995.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .operators import projection


class Chain(eqx.Module):
    """A policy's Markov chain with features: what linear evaluation needs. Weights need not be those the chain has itself.

    - `transitions`: P(s' | s) under the policy, without what ends; rows sum to at most 1.
    - `features`: Φ; `weights`: d, how often a state is updated; `start`: the parameters that the example begins with.
    """

    transitions: Float[np.ndarray, "S S"]
    rewards: Float[np.ndarray, "S"]
    features: Float[np.ndarray, "S F"]
    weights: Float[np.ndarray, "S"]
    gamma: float
    start: Float[np.ndarray, "F"]

    @property
    def key_matrix(self) -> Float[np.ndarray, "F F"]:
        """A = Φ'D (I - γ P) Φ: the expected semi-gradient update is α (b - A w)."""
        return self.features.T @ (
            self.weights[:, None] * (self.features - self.gamma * self.transitions @ self.features)
        )

    @property
    def target(self) -> Float[np.ndarray, "F"]:
        """B = Φ'D r."""
        return self.features.T @ (self.weights * self.rewards)

    @property
    def covariance(self) -> Float[np.ndarray, "F F"]:
        """C = Φ'D Φ."""
        return self.features.T @ (self.weights[:, None] * self.features)


def w_2w(gamma: float = 0.9) -> Chain:
    """Features 1 and 2, both states go to the second, no reward: V* = 0 is w = 0, and each fit makes w 6γ/5 times as large."""
    transitions = np.array([[0.0, 1.0], [0.0, 1.0]])
    return Chain(transitions, np.zeros(2), np.array([[1.0], [2.0]]), np.full(2, 0.5), gamma, np.ones(1))


def baird(gamma: float = 0.99) -> Chain:
    """Baird's seven states and eight features. The policy goes to the last state, updates are spread evenly; V* = 0 can be said.

    As in Sutton and Barto (2018), example 11.2: V(s) = 2 w_s + w_8 for six states, w_7 + 2 w_8 for the last.
    """
    features = np.zeros((7, 8))
    features[np.arange(6), np.arange(6)], features[:6, 7] = 2.0, 1.0
    features[6, 6], features[6, 7] = 1.0, 2.0
    transitions = np.zeros((7, 7))
    transitions[:, 6] = 1.0
    start = np.array([1.0, 1, 1, 1, 1, 1, 10, 1])
    return Chain(transitions, np.zeros(7), features, np.full(7, 1 / 7), gamma, start)


def semi_gradient(chain: Chain, w: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """Expected direction of semi-gradient TD, b - A w."""
    return chain.target - chain.key_matrix @ w


def residual_gradient(chain: Chain, w: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """-∇ of ½ the Bellman error: a true gradient, with two independent next states or none that is random."""
    slope = chain.features - chain.gamma * chain.transitions @ chain.features
    return slope.T @ (chain.weights * (chain.rewards - slope @ w))


def sampled_residual_gradient(chain: Chain, w: Float[np.ndarray, "F"]) -> Float[np.ndarray, "F"]:
    """-∇ of ½ E[δ²] with the same sample of s' in both places: what `jax.grad` through the target would do. Its fixed point is another."""
    gap = chain.features[:, None, :] - chain.gamma * chain.features[None, :, :]
    error = chain.rewards[:, None] - gap @ w
    return np.einsum("st,st,stf->f", chain.weights[:, None] * chain.transitions, error, gap)


def follow(
    chain: Chain, step: float, sweeps: int, method: str = "semi_gradient", second_step: float = 0.0
) -> Float[np.ndarray, "K F"]:
    """Parameters after each of `sweeps` expected updates of a method, from the chain's start: `[sweeps + 1, F]`.

    - `method`: `semi_gradient`, `residual_gradient`, `sampled_residual_gradient`, `gtd2`, `tdc`.
    - `second_step`: β of the auxiliary weights of the last two, u <- u + β (b - A w - C u).

    Raises `ValueError` for another method.
    """
    directions = {f.__name__: f for f in (semi_gradient, residual_gradient, sampled_residual_gradient)}
    if method not in (*directions, "gtd2", "tdc"):
        raise ValueError(f"there is no method {method!r}: choose one of {', '.join((*directions, 'gtd2', 'tdc'))}")
    if method in directions:
        slope, offset = _affine(directions[method], chain)
        update, push = np.eye(len(slope)) + step * slope, step * offset
    else:
        update, push = _two_scales(chain, step, second_step, method == "gtd2")
    point = np.concatenate([chain.start, np.zeros(len(push) - len(chain.start))])
    path = [point]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(sweeps):
            point = update @ point + push
            path.append(point)
    return np.stack(path)[:, : len(chain.start)]


def _affine(
    direction: Callable[[Chain, np.ndarray], np.ndarray], chain: Chain
) -> tuple[Float[np.ndarray, "F F"], Float[np.ndarray, "F"]]:
    """Slope and offset of a direction, which is affine in w."""
    size = len(chain.start)
    offset = direction(chain, np.zeros(size))
    return np.stack([direction(chain, e) - offset for e in np.eye(size)], 1), offset


def _two_scales(
    chain: Chain, step: float, second_step: float, gtd2: bool
) -> tuple[Float[np.ndarray, "G G"], Float[np.ndarray, "G"]]:
    """One update of (w, u): w moves by A'u (GTD2) or by b - A w - γ Φ'P'DΦ u (TDC), u by b - A w - C u."""
    size, matrix, zero = len(chain.start), chain.key_matrix, np.zeros(len(chain.start))
    corrected = chain.gamma * (chain.transitions @ chain.features).T @ (chain.weights[:, None] * chain.features)
    top = [np.zeros((size, size)), matrix.T] if gtd2 else [-matrix, -corrected]
    update = np.block([[step * part for part in top], [-second_step * matrix, -second_step * chain.covariance]])
    push = np.concatenate([zero if gtd2 else step * chain.target, second_step * chain.target])
    return np.eye(2 * size) + update, push


def fit_on(chain: Chain, sweeps: int) -> Float[np.ndarray, "K S"]:
    """Values after each of `sweeps` fits V <- Π_D (r + γ P V), from the chain's start: `[sweeps + 1, S]`."""
    matrix, value = projection(chain.features, chain.weights), chain.features @ chain.start
    path = [value]
    for _ in range(sweeps):
        value = matrix @ (chain.rewards + chain.gamma * chain.transitions @ value)
        path.append(value)
    return np.stack(path)


def lstd(chain: Chain) -> Float[np.ndarray, "F"]:
    """The TD fixed point A w = b, solved (Bradtke and Barto 1996). Raises `ValueError` where A has no inverse."""
    matrix = chain.key_matrix
    if np.linalg.matrix_rank(matrix) < len(matrix):
        raise ValueError("A = Φ'D(I - γP)Φ has no inverse, so there is no single fixed point: use independent features")
    return np.linalg.solve(matrix, chain.target)


def projected_norm(chain: Chain) -> float:
    """||γ Π P||_d, the factor of the fitted backup in the norm of the weights: at most γ where they are stationary (item 5.29)."""
    root = np.sqrt(chain.weights)
    matrix = chain.gamma * projection(chain.features, chain.weights) @ chain.transitions
    return float(np.linalg.norm(root[:, None] * matrix / root[None, :], 2))


def averager(groups: Float[np.ndarray, "S G"]) -> Float[np.ndarray, "S S"]:
    """The fit of an averager: each state's value is the mean over the states of its groups, weighed by membership. Rows sum to 1.

    With hard groups it is state aggregation. A non-expansion in the sup norm, so that with the Bellman backup, whose norm it shares, it
    is a contraction (Gordon 1995). Raises `ValueError` where a state is in no group, or a group is empty.
    """
    shares = np.asarray(groups, np.float64)
    if np.any(shares < 0) or np.any(shares.sum(1) <= 0) or np.any(shares.sum(0) <= 0):
        raise ValueError(
            "every state of an averager must be in a group, and every group must have a state: memberships of at least 0"
        )
    return (shares / shares.sum(1, keepdims=True)) @ (shares / shares.sum(0)).T
