r"""How far a policy that changes a little moves the states: total variation, couplings, Pinsker's inequality.

$$\max_s D_{TV}\big(\pi'(\cdot|s), \pi(\cdot|s)\big) \le \epsilon \;\Rightarrow\;
\sum_s |d'_t(s) - d_t(s)| \le 2\,(1 - (1 - \epsilon)^t) \le 2 \epsilon t, \qquad D_{TV} \le \sqrt{D_{KL} / 2},
\qquad D_{TV}(p, q) = \tfrac12 \sum_i |p_i - q_i|.$$

Why: couple the two policies so that they choose the same action with probability 1 - D_TV, the most that any joint
distribution can. Then both are in the same state after t steps with probability at least (1 - ε)^t. Time counts
from t = 0.

The distances, the bound and the identity are in `exact.mismatch`, since chapter 2 stands on them as well.

Deviations from the notes. |π' - π| <= ε is to be read as total variation in every state; neither the difference of
single probabilities nor the L1 distance gives the coupling (erratum E7.2). The bound of an expectation has max |f|,
not max f (erratum E7.3). And d'_t = (1 - ε)^t d_t + (1 - (1 - ε)^t) p_mistake needs π' >= (1 - ε) π, action by
action: for a deterministic π that is total variation, for a stochastic one it asks more, and total variation alone
leaves the bound above but not the identity (`separation` is the ε that it takes).

Source: notes, sections 7.2.1 and 7.2.2, errata E2.2, E7.2, E7.3 and E7.6; Levin, Peres and Wilmer (2009), section 4.2.
"""

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import PRNGKey
from ..exact import check_share, state_l1_bound
from ..exact.mismatch import Rows, check_pair


def kl_rows(first: Rows, second: Rows) -> Float[np.ndarray, "..."]:
    """KL(first || second) of each pair of rows, infinite where `second` is 0 and `first` is not."""
    one, two = check_pair(first, second)
    possible = one > 0
    with np.errstate(divide="ignore"):
        ratios = np.log(np.where(possible, one, 1)) - np.log(np.where(possible, two, 1))
    # Rounding may leave -1e-17 for equal rows, and a divergence is never negative.
    return np.asarray(np.maximum((np.where(possible, one, 0) * ratios).sum(-1), 0.0))


def expectation_lower_bound(
    values: Float[Array | np.ndarray, "S"], old: Float[Array | np.ndarray, "S"], eps: float, t: int
) -> float:
    """E_{d'_t}[f] >= E_{d_t}[f] - 2 ε t max |f| (item 7.11), for f = `values` and d_t = `old`. |f|: erratum E7.3."""
    f, weights = np.asarray(values, np.float64), check_pair(old, old)[0]
    return float(weights @ f - state_l1_bound(eps, t, linear=True) * np.abs(f).max())


def maximal_coupling(
    first: Float[Array | np.ndarray, "K"], second: Float[Array | np.ndarray, "K"]
) -> Float[np.ndarray, "K K"]:
    """The joint distribution of (x, y), x ~ `first`, y ~ `second`, with P(x = y) = 1 - D_TV, the most there can be.

    min(p, q) on the diagonal; what p has more than q is matched with what q has more than p.
    """
    one, two = check_pair(first, second)
    common = np.minimum(one, two)
    more, less = one - common, two - common
    rest = more.sum()
    return np.diag(common) + (np.outer(more, less) / rest if rest > 0 else 0.0)


def sample_maximal_coupling(
    first: Float[Array | np.ndarray, "K"], second: Float[Array | np.ndarray, "K"], key: PRNGKey, num_samples: int
) -> Int[np.ndarray, "N 2"]:
    """Pairs (x, y) from `maximal_coupling` (item 7.10): actions of two policies that agree as often as they can."""
    if num_samples < 1:
        raise ValueError(f"the number of samples is {num_samples} and must be at least 1")
    joint = maximal_coupling(first, second)
    cumulative = joint.cumsum()
    uniform = np.asarray(jax.random.uniform(key, (num_samples,)), np.float64)
    # "right", and scaled by the last sum: no outcome of probability 0 is ever chosen.
    drawn = np.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return np.stack(np.unravel_index(drawn, joint.shape), -1)


def kl_to_tv(kl: Float[np.ndarray, "..."] | float) -> Float[np.ndarray, "..."]:
    """Pinsker: D_TV <= sqrt(D_KL / 2), in whichever direction the KL is taken (items 7.15 and 7.17)."""
    divergence = np.asarray(kl, np.float64)
    if not np.all(divergence >= 0):
        raise ValueError(f"a KL divergence of {divergence.min()} was given and none is below 0: "
                         "the logarithms may be in the wrong order")  # fmt: skip
    return np.asarray(np.sqrt(divergence / 2))


def tv_to_kl(tv: float) -> float:
    """The KL, 2 ε², that keeps the total variation within ε = `tv`: `kl_to_tv` backwards (item 7.17, erratum E7.5)."""
    return 2 * check_share(tv) ** 2
