r"""How far a policy that changes a little moves the states: total variation, couplings, Pinsker's inequality.

$$\max_s D_{TV}\big(\pi'(\cdot|s), \pi(\cdot|s)\big) \le \epsilon \;\Rightarrow\;
\sum_s |d'_t(s) - d_t(s)| \le 2\,(1 - (1 - \epsilon)^t) \le 2 \epsilon t, \qquad D_{TV} \le \sqrt{D_{KL} / 2},
\qquad D_{TV}(p, q) = \tfrac12 \sum_i |p_i - q_i|.$$

Why: couple the two policies so that they choose the same action with probability 1 - D_TV, the most that any joint
distribution can. Then both are in the same state after t steps with probability at least (1 - ε)^t. Time counts
from t = 0.

Deviations from the notes. |π' - π| <= ε is to be read as total variation in every state; neither the difference of
single probabilities nor the L1 distance gives the coupling (erratum E7.2). The bound of an expectation has max |f|,
not max f (erratum E7.3). And d'_t = (1 - ε)^t d_t + (1 - (1 - ε)^t) p_mistake needs π' >= (1 - ε) π, action by
action: for a deterministic π that is total variation, for a stochastic one it asks more, and total variation alone
leaves the bound above but not the identity (`separation` is the ε that it takes).

Source: notes, sections 7.2.1 and 7.2.2, errata E2.2, E7.2, E7.3 and E7.6; Levin, Peres and Wilmer (2009), section 4.2.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..core import PRNGKey
from ..envs.tabular import MDP
from ..exact import state_distributions
from .theory import PolicyTable

Rows = Float[Array | np.ndarray, "... K"]


def _pair(first: Rows, second: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Both in float64 with one shape. Raises `ValueError` unless their last axes hold probabilities."""
    one, two = np.asarray(first, np.float64), np.asarray(second, np.float64)
    shared = min(one.ndim, two.ndim)
    if one.shape[-shared:] != two.shape[-shared:]:
        raise ValueError(f"the tables have shapes {one.shape} and {two.shape}: only distributions over the same outcomes, "
                         "in the same states, can be compared")  # fmt: skip
    for rows in (one, two):
        if not (np.all(rows >= 0) and np.all(np.abs(rows.sum(-1) - 1) <= 1e-5)):
            raise ValueError("a row is not a distribution: its entries must be at least 0 and sum to 1")
    one, two = np.broadcast_arrays(one, two)
    return one, two


def check_share(eps: float) -> float:
    """A distance of policies. Raises `ValueError` outside [0, 1], which a total variation never leaves."""
    if not 0 <= eps <= 1:
        raise ValueError(f"eps is {eps} and total variation lies in [0, 1]: give the largest over the states "
                         "of half the L1 distance of the policies")  # fmt: skip
    return float(eps)


def tv_rows(first: Rows, second: Rows) -> Float[np.ndarray, "..."]:
    """Total variation ½ Σ |p - q| of each pair of rows, in [0, 1]."""
    one, two = _pair(first, second)
    return np.asarray(np.minimum(0.5 * np.abs(one - two).sum(-1), 1.0))


def kl_rows(first: Rows, second: Rows) -> Float[np.ndarray, "..."]:
    """KL(first || second) of each pair of rows, infinite where `second` is 0 and `first` is not."""
    one, two = _pair(first, second)
    possible = one > 0
    with np.errstate(divide="ignore"):
        ratios = np.log(np.where(possible, one, 1)) - np.log(np.where(possible, two, 1))
    # Rounding may leave -1e-17 for equal rows, and a divergence is never negative.
    return np.asarray(np.maximum((np.where(possible, one, 0) * ratios).sum(-1), 0.0))


def policy_closeness(new: PolicyTable, old: PolicyTable) -> float:
    """max_s D_TV(π'(·|s), π(·|s)), over time too (item 7.9): the ε of every bound here."""
    return float(tv_rows(new, old).max())


def separation(new: PolicyTable, old: PolicyTable) -> float:
    """The least ε with π'(a|s) >= (1 - ε) π(a|s) for all s, a. At least the total variation.

    Equal to it where π is deterministic, and at most ε for π' = (1 - ε) π + ε (anything).
    """
    after, before = _pair(new, old)
    ratios = np.divide(after, before, out=np.ones_like(after), where=before > 0)
    return float(np.clip(1 - ratios.min(), 0, 1))


class MixtureDecomposition(eqx.Module):
    """d'_t = `keep`_t d_t + (1 - `keep`_t) `mistake`_t, for t = 0..T; where nothing is left for it, `mistake` is d_t."""

    keep: Float[np.ndarray, "K"]
    mistake: Float[np.ndarray, "K S"]


def mixture_decomposition(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None, *, eps: float | None = None
) -> MixtureDecomposition:
    """Writes d'_t as (1 - ε)^t d_t + (1 - (1 - ε)^t) p_mistake (item 7.7, erratum E2.2); `mistake` is a distribution.

    `eps` is the `separation` of the policies, or more if given. Raises `ValueError` for less, where the rest may have
    negative entries, and without a horizon.
    """
    before, after = state_distributions(mdp, old, horizon), state_distributions(mdp, new, horizon)
    least = separation(new, old)
    share = least if eps is None else check_share(eps)
    if share < least - 1e-12:
        raise ValueError(f"eps is {share:g} and the new policy keeps only a share of {1 - least:g} of some action's "
                         f"probability, so what is left of d' may be negative: give eps of at least {least:g}")  # fmt: skip
    keep = (1 - share) ** np.arange(len(before))
    rest = (1 - keep)[:, None]
    mistake = np.divide(after - keep[:, None] * before, rest, out=before.copy(), where=rest > 0)
    return MixtureDecomposition(keep, mistake)


def state_l1_bound(eps: float, t: Int[np.ndarray, "..."] | int, *, linear: bool = False) -> Float[np.ndarray, "..."]:
    """Σ_s |d'_t(s) - d_t(s)| <= 2 (1 - (1 - ε)^t), or the larger 2 ε t where `linear` (item 7.8)."""
    share, times = check_share(eps), np.asarray(t)
    if np.any(times < 0):
        raise ValueError(f"t is {times.min()} and time counts from 0: give the number of actions before the state")
    return np.asarray(2 * share * times if linear else 2 * (1 - (1 - share) ** times), np.float64)


def expectation_lower_bound(
    values: Float[Array | np.ndarray, "S"], old: Float[Array | np.ndarray, "S"], eps: float, t: int
) -> float:
    """E_{d'_t}[f] >= E_{d_t}[f] - 2 ε t max |f| (item 7.11), for f = `values` and d_t = `old`. |f|: erratum E7.3."""
    f, weights = np.asarray(values, np.float64), _pair(old, old)[0]
    return float(weights @ f - state_l1_bound(eps, t, linear=True) * np.abs(f).max())


def maximal_coupling(
    first: Float[Array | np.ndarray, "K"], second: Float[Array | np.ndarray, "K"]
) -> Float[np.ndarray, "K K"]:
    """The joint distribution of (x, y), x ~ `first`, y ~ `second`, with P(x = y) = 1 - D_TV, the most there can be.

    min(p, q) on the diagonal; what p has more than q is matched with what q has more than p.
    """
    one, two = _pair(first, second)
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
