r"""What imitation costs: rewards of imitating, bounds on mistakes, and where the states of the copy go.

$$c(s, a) = 1[a \ne \pi^\star(s)], \qquad \mathbb{E}_{a \sim \pi_\theta}[c] = 1 - \pi_\theta(\pi^\star(s) \mid s) \le \epsilon
\;\Rightarrow\; \mathbb{E}\Big[\sum_{t=0}^{T-1} c(s_t, a_t)\Big] \le \sum_{t=0}^{T-1} \big(1 - (1 - \epsilon)^{t+1}\big)
= T - \frac{(1 - \epsilon)\big(1 - (1 - \epsilon)^T\big)}{\epsilon} \le \epsilon\, \frac{T (T + 1)}{2} \le \epsilon\, T^2.$$

The first sum is reached by a tightrope: one mistake, and nothing but mistakes ever after. The expert is deterministic, the learner
need not be (erratum E2.6: for a deterministic one the log likelihood is 0 or -inf). Where only the expert's own states have the
mean mistake ε, and not each of them, 1 - ε t takes the place of (1 - ε)^t.

Deviations from the notes. These are upper bounds (E2.1). The exponent of the mixture is t where time counts from 0, and t - 1 where
it counts from 1 (E2.2). |p_θ - p_train| is an L1 distance, at most 2 (1 - (1 - ε)^t), total variation half of it (E2.3). The left
side is a sum over t (E2.4); what is printed, ε T + ε T (T + 1), holds too, for it is more than twice the sharp one.

Source: notes, sections 2.2 and 2.4; Ross and Bagnell (2010); Ross, Gordon and Bagnell (2011). All in float64.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from ..envs.tabular import MDP
from ..exact import (
    MixtureDecomposition,
    check_policy,
    check_share,
    horizon_of,
    mixture_decomposition,
    one_hot_policy,
    state_distributions,
    state_l1_bound,
    tv_rows,
)
from ..exact.mismatch import PolicyTable

Labels = Int[Array | np.ndarray, "... S"]


def log_likelihood_reward(policy: PolicyTable, expert: Labels) -> Float[np.ndarray, "... S"]:
    """The reward log π(π*(s) | s), for a table `[.. S, A]` and the expert's action in each state (item 2.24); -inf where it is never taken.

    Its mean over an expert's data is minus the cross-entropy that BC minimises.
    """
    with np.errstate(divide="ignore"):
        return np.log(_chance_of(policy, expert))


def mistake_cost(
    action: Int[Array | np.ndarray, "..."], label: Int[Array | np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """1[a != π*(s)] of actions and the expert's labels (item 2.25)."""
    return (np.asarray(action) != np.asarray(label)).astype(np.float64)


def mistake_probability(policy: PolicyTable, expert: Labels) -> Float[np.ndarray, "... S"]:
    """E_{a ~ π}[1[a != π*(s)]] = 1 - π(π*(s) | s) in each state (item 2.25)."""
    return 1.0 - _chance_of(policy, expert)


def _chance_of(policy: PolicyTable, expert: Labels) -> np.ndarray:
    table, labels = np.asarray(policy, np.float64), np.asarray(expert)
    if labels.shape[-1:] != table.shape[-2:-1] or labels.min() < 0 or labels.max() >= table.shape[-1]:
        raise ValueError(f"the expert has labels of shape {labels.shape} from {labels.min()} to {labels.max()}, and the policy has "
                         f"{table.shape[-2]} states and {table.shape[-1]} actions: give one of the actions for each state")  # fmt: skip
    wanted = np.broadcast_to(labels, table.shape[:-1])
    return np.take_along_axis(table, wanted[..., None], -1)[..., 0]


def expected_mistakes(
    mdp: MDP, policy: PolicyTable, expert: Labels, horizon: int | None = None
) -> Float[np.ndarray, "T"]:
    """E[c(s_t, a_t)] under the policy's own states, for t = 0..T-1: exactly, by their distributions. Ended episodes cost nothing.

    Raises `ValueError` without a horizon.
    """
    visits = state_distributions(mdp, policy, horizon)[:-1] * ~np.asarray(mdp.terminal)
    table = check_policy(mdp, policy, len(visits))
    return (visits * mistake_probability(table, expert)).sum(-1)


def worst_mistake(mdp: MDP, policy: PolicyTable, expert: Labels, horizon: int | None = None) -> float:
    """ε: the greatest chance of a mistake in any state that the expert itself comes to within the horizon."""
    steps = horizon_of(mdp, horizon)
    visits = state_distributions(mdp, one_hot_policy(expert, mdp.num_actions), steps)[:-1]
    table = check_policy(mdp, policy, len(visits))
    acting = (visits > 0) & ~np.asarray(mdp.terminal)
    return float(np.max(mistake_probability(table, expert), where=acting, initial=0.0))


def mistake_mixture(
    mdp: MDP, policy: PolicyTable, expert: Labels, horizon: int | None = None, *, eps: float | None = None
) -> MixtureDecomposition:
    """p_θ(s_t) = (1 - ε)^t p_train(s_t) + (1 - (1 - ε)^t) p_mistake(s_t), exactly (item 2.30); ε is `worst_mistake` where not given.

    p_mistake is what is left, and a distribution. Raises `ValueError` without a horizon, and for an ε below the worst mistake.
    """
    return mixture_decomposition(mdp, policy, one_hot_policy(expert, mdp.num_actions), horizon, eps=eps)


def mixture_weight(
    eps: float, t: Int[np.ndarray, "..."] | int, *, first: int = 0, on_average: bool = False
) -> Float[np.ndarray, "..."]:
    """The weight of p_train in p_θ(s_t): (1 - ε)^(t - `first`), where time counts from `first` (erratum E2.2).

    `on_average`: ε is only the mean of the mistakes over the expert's states, and the weight 1 - ε (t - `first`), at least 0.
    Raises `ValueError` for a t before the first.
    """
    share, actions = check_share(eps), np.asarray(t) - first
    if np.any(actions < 0):
        raise ValueError(
            f"t is {np.min(t)} and time counts from {first}: give the time of a state, the first one's is {first}"
        )
    return np.asarray(np.maximum(1 - share * actions, 0.0) if on_average else (1 - share) ** actions, np.float64)


class ErrorBounds(eqx.Module):
    """What `error_bounds` says for an ε and a T (item 2.26). Times are t = 0..T-1.

    - `weight`: (1 - ε)^t, the share of p_train in p_θ(s_t).
    - `l1`, `l1_linear`: bounds of Σ_s |p_θ(s_t) - p_train(s_t)|: 2 (1 - (1 - ε)^t) and 2 ε t. Total variation is half of each.
    - `tightrope`: most mistakes in T steps, T - (1 - ε)(1 - (1 - ε)^T) / ε, which a tightrope makes.
    - `sharp`: ε T (T + 1) / 2.   `quadratic`: ε T^2 (Ross and Bagnell 2010).   `printed`: ε T + ε T (T + 1).
    - `linear`: ε T, of a policy that makes its mistakes with chance ε in its own states as well (DAgger).
    """

    weight: Float[np.ndarray, "T"]
    l1: Float[np.ndarray, "T"]
    l1_linear: Float[np.ndarray, "T"]
    tightrope: float
    sharp: float
    quadratic: float
    printed: float
    linear: float


def error_bounds(eps: float, horizon: int) -> ErrorBounds:
    """Bounds on the mistakes in `horizon` steps of a learner that errs with chance at most `eps` in each of the expert's states.

    Raises `ValueError` for an ε outside [0, 1] and for less than one step.
    """
    share, steps = check_share(eps), horizon
    if steps < 1:
        raise ValueError(f"the horizon is {steps} and mistakes are made in steps: give at least 1")
    t = np.arange(steps)
    return ErrorBounds(
        mixture_weight(share, t),
        state_l1_bound(share, t),
        state_l1_bound(share, t, linear=True),
        # As a sum: the closed form loses its digits where ε is small.
        float(-np.expm1((t + 1) * np.log1p(-share)).sum()) if share < 1 else float(steps),
        share * steps * (steps + 1) / 2,
        share * steps**2,
        share * steps + share * steps * (steps + 1),
        share * steps,
    )


def data_mismatch(
    mdp: MDP, states: Int[Array | np.ndarray, "N"], policy: PolicyTable, horizon: int | None = None
) -> float:
    """D_TV(d_D, d_π) of the states of a dataset and those that a policy comes to, over all its steps together (item 2.11).

    d_π(s) is the share of the policy's steps t = 0..T-1 in s; steps of ended episodes do not count. Raises `ValueError` without
    a horizon, and for states that there are not.
    """
    seen = np.asarray(states)
    if not seen.size or seen.min() < 0 or seen.max() >= mdp.num_states:
        raise ValueError(f"the states of the data must be numbers from 0 to {mdp.num_states - 1}, at least one of them")
    visits = (state_distributions(mdp, policy, horizon)[:-1] * ~np.asarray(mdp.terminal)).sum(0)
    counts = np.bincount(seen, minlength=mdp.num_states)
    return float(tv_rows(counts / counts.sum(), visits / visits.sum()))
