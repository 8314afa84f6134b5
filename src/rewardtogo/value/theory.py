r"""Bounds and closed forms of chapters 5 and 6: how fast, how large, how biased.

- Geometric rate (item 5.24): $\Vert V_k - V^\star \Vert_\infty \le \gamma^k \Vert V_0 - V^\star \Vert_\infty$, so that
  $k \ge \log(\epsilon / \Vert V_0 - V^\star \Vert) / \log \gamma$ sweeps are enough for an error of $\epsilon$.
- The curse of dimensionality (item 5.9): a table over $d$ coordinates of $n$ values has $n^d |A|$ entries.
- Over-estimation (item 6.11): $\mathbb{E}[\max_i X_i] \ge \max_i \mathbb{E}[X_i]$, in closed form for independent normal estimates. Two of
  mean 0 and variance 1 have 0.5642 where the truth is 0, ten 1.5388, of means 1 and 0 1.1996 where it is 1.
- What double estimation does in its place (item 6.13): $\mathbb{E}[X_{j^\star}]$, $j^\star$ the best by another, independent set of
  estimates. It is never above $\max_i \mathbb{E}[X_i]$: for means 1 and 0 it is $\Phi(1 / \sqrt 2) = 0.7602$ (erratum E6.3: not unbiased).

Source: notes, sections 5.3, 5.4 and 6.3; van Hasselt 2010.
"""

import itertools
import math

import numpy as np
from jaxtyping import Float


def sweeps_needed(gamma: float, first_error: float, error: float) -> int:
    """Sweeps of value iteration that are sure to bring the error of V from `first_error` to `error`.

    Raises `ValueError` for a discount outside (0, 1), and for errors that are not positive.
    """
    if not 0 < gamma < 1:
        raise ValueError(f"the rate is γ^k, and γ = {gamma:g} is not in (0, 1)")
    if not (first_error > 0 and error > 0):
        raise ValueError(f"errors must be more than 0, not {first_error:g} and {error:g}")
    return max(0, math.ceil(math.log(error / first_error) / math.log(gamma)))


def table_and_network_sizes(
    dimensions: int, values: int, actions: int, hidden: tuple[int, ...] = (64, 64)
) -> tuple[int, int]:
    """Entries of a Q-table over a grid, and parameters of a dense Q-network over the same coordinates."""
    sizes = (dimensions, *hidden, actions)
    network = sum((a + 1) * b for a, b in itertools.pairwise(sizes))
    return values**dimensions * actions, network


def expected_maximum(means: Float[np.ndarray, "A"], stds: Float[np.ndarray, "A"] | float = 1.0) -> float:
    r"""$\mathbb{E}[\max_i X_i]$ of independent normal estimates, $\int x\, \frac{d}{dx} \prod_i \Phi_i(x)\, dx$, by quadrature to 1e-10."""
    means, stds = np.broadcast_arrays(np.asarray(means, np.float64), np.asarray(stds, np.float64))
    x, weights = _grid(means, stds)
    z = (x[:, None] - means) / stds
    below, density = _normal_cdf(z), np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * stds)
    others = np.stack([np.delete(below, i, 1).prod(1) for i in range(len(means))], 1)
    return float((weights * x * (density * others).sum(1)).sum())


def chance_of_best(means: Float[np.ndarray, "A"], stds: Float[np.ndarray, "A"] | float = 1.0) -> Float[np.ndarray, "A"]:
    """The probability that each of some independent normal estimates is the largest."""
    means, stds = np.broadcast_arrays(np.asarray(means, np.float64), np.asarray(stds, np.float64))
    x, weights = _grid(means, stds)
    z = (x[:, None] - means) / stds
    below, density = _normal_cdf(z), np.exp(-0.5 * z**2) / (math.sqrt(2 * math.pi) * stds)
    return np.array([(weights * density[:, i] * np.delete(below, i, 1).prod(1)).sum() for i in range(len(means))])


def expected_double_maximum(means: Float[np.ndarray, "A"], stds: Float[np.ndarray, "A"] | float = 1.0) -> float:
    """E of one set of estimates at the best of another, independent one: Σ_i P(i is best) E[X_i]. At most the largest mean."""
    return float(chance_of_best(means, stds) @ np.asarray(means, np.float64))


def _grid(means: np.ndarray, stds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equally spaced points: the trapezoidal rule is exact to rounding for what falls off like a normal density at both ends."""
    x = np.linspace((means - 12 * stds).min(), (means + 12 * stds).max(), 8001)
    return x, np.full(len(x), x[1] - x[0])


def _normal_cdf(z: np.ndarray) -> np.ndarray:
    return 0.5 * np.vectorize(math.erfc, otypes=[float])(-z / math.sqrt(2))
