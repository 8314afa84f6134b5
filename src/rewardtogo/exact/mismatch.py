r"""How far two policies' states drift apart: distances of policies, of state distributions, and the mixture that ties them.

$$d'_t = (1 - \epsilon)^t\, d_t + \big(1 - (1 - \epsilon)^t\big)\, p^{\text{mistake}}_t, \qquad
\sum_s |d'_t(s) - d_t(s)| \le 2\,(1 - (1 - \epsilon)^t) \le 2 \epsilon t.$$

A trajectory of the old policy π keeps at least (1 - ε)^t of its probability under π', where π' >= (1 - ε) π in every
state that π comes to; what π' does elsewhere does not matter. So imitation needs the ε of the expert's own states only
(chapter 2), and a trust region that of all (chapter 7). Time counts from 0: nothing was done before s_0 (erratum E2.2).

Source: notes, sections 2.4 and 7.2; errata E2.2, E2.3 and E7.2.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..envs.tabular import MDP
from .chains import state_distributions
from .policies import check_policy

PolicyTable = Float[Array | np.ndarray, "... S A"]
Rows = Float[Array | np.ndarray, "... K"]


def check_pair(first: Rows, second: Rows) -> tuple[np.ndarray, np.ndarray]:
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
    one, two = check_pair(first, second)
    return np.asarray(np.minimum(0.5 * np.abs(one - two).sum(-1), 1.0))


def policy_closeness(new: PolicyTable, old: PolicyTable) -> float:
    """max_s D_TV(π'(·|s), π(·|s)), over time too (item 7.9): the ε of every bound here."""
    return float(tv_rows(new, old).max())


def separation(new: PolicyTable, old: PolicyTable, where: Bool[np.ndarray, "... S"] | None = None) -> float:
    """The least ε with π'(a|s) >= (1 - ε) π(a|s) for all s, a, or for the s in `where`. At least the total variation there.

    Equal to it where π is deterministic, and at most ε for π' = (1 - ε) π + ε (anything).
    """
    after, before = check_pair(new, old)
    counts = before > 0 if where is None else (before > 0) & where[..., None]
    ratios = np.divide(after, before, out=np.ones_like(after), where=counts)
    return float(np.clip(1 - ratios.min(), 0, 1))


class MixtureDecomposition(eqx.Module):
    """d'_t = `keep`_t d_t + (1 - `keep`_t) `mistake`_t, for t = 0..T; where nothing is left for it, `mistake` is d_t."""

    keep: Float[np.ndarray, "K"]
    mistake: Float[np.ndarray, "K S"]


def mixture_decomposition(
    mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None, *, eps: float | None = None
) -> MixtureDecomposition:
    """Writes d'_t as (1 - ε)^t d_t + (1 - (1 - ε)^t) p_mistake (item 7.7, erratum E2.2); `mistake` is a distribution.

    `eps` is the `separation` of the policies over the states that `old` comes to, or more if given. Raises `ValueError`
    for less, where the rest may have negative entries, and without a horizon.
    """
    before, after = state_distributions(mdp, old, horizon), state_distributions(mdp, new, horizon)
    steps = len(before) - 1
    acting = (before[:-1] > 0) & ~np.asarray(mdp.terminal)
    least = separation(check_policy(mdp, new, steps), check_policy(mdp, old, steps), acting)
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


def state_mismatch(mdp: MDP, new: PolicyTable, old: PolicyTable, horizon: int | None = None) -> Float[np.ndarray, "K"]:
    """D_TV(d'_t, d_t) for t = 0..T (item 2.5): 0 at the start, and 0 throughout for equal policies; the L1 distance is twice it.

    Raises `ValueError` without a horizon.
    """
    return tv_rows(state_distributions(mdp, new, horizon), state_distributions(mdp, old, horizon))
