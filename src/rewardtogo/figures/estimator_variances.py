r"""The whole family of policy-gradient estimators side by side: exact variance and exact bias (notes 3.7, 4.2, 4.8, 4.9).

`ops.estimators.Estimator` is what `PolicyGradient` trains with. Here all its members, every way to credit rewards with every baseline,
are evaluated on *every* batch of two trajectories of a small problem, and weighted with the probability of the batch:

$$E[g] = \sum_{\tau_1, \tau_2} p(\tau_1)\, p(\tau_2)\, g(\tau_1, \tau_2), \qquad \text{total variance} = \sum_j \mathrm{Var}[g_j].$$

V is exact. Reward-to-go and a baseline take most of the variance away. The mean of the same batch, over time or at each time, shrinks
the gradient, with N = 2 to half, 1 - 1/N, where leaving one out does not (erratum E3.5); the optimal baselines, estimated from the
batch that they are used on, are biased, too (erratum E3.6), so that their small variance is not for nothing.

Source: notes, sections 3.7, 4.1, 4.2, 4.8 and 4.9 (items 3.23 and 4.1 to 4.3). The problem is our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..envs.tabular import MDP
from ..exact import v_values
from ..exact.estimators import Moments, moments
from ..exact.gradients import policy_gradient
from ..exact.observed import enumerate_observed
from ..exact.signals import values_at
from ..exact.softmax import gradient_samples, softmax_policy
from ..ops.estimators import BASELINES, Estimator, Steps

HORIZON, BATCH = 3, 2
GAE_LAMBDA, N_STEPS = 0.5, 2
ROW_NAMES = {
    "full": "full return",
    "reward_to_go": "reward to go",
    "n_step": f"{N_STEPS}-step return",
    "gae": f"λ-return, λ = {GAE_LAMBDA}",
}
COLUMN_NAMES = {
    "none": "none",
    "mean": "batch\nmean",
    "leave_one_out": "leave\none out",
    "time_mean": "mean at\ntime t",
    "value": "V(s)",
    "optimal": "optimal",
    "optimal_per_parameter": "optimal,\neach\nparameter",
}


def problem(seed: int = 0) -> tuple[MDP, Float[np.ndarray, "S A"]]:
    """Two states, two actions, three steps, no discount, rewards of mean 1; and the logits of a policy."""
    rng = np.random.default_rng(seed)
    transitions, rewards = rng.dirichlet(np.ones(2), size=(2, 2)), 1 + rng.normal(size=(2, 2))
    return MDP(transitions, rewards, [0.5, 0.5], 1.0, horizon=HORIZON), rng.normal(size=(2, 2))


def estimators() -> dict[tuple[str, str], Estimator]:
    """Every member of the family, by its returns and its baseline, but those for actions of another policy."""
    make = lambda r, b: Estimator(r, b, False, 1.0, GAE_LAMBDA, N_STEPS)  # noqa: E731
    return {(r, b): make(r, b) for r in ROW_NAMES for b in BASELINES}


class Batches(NamedTuple):
    """Every batch of `BATCH` trajectories: what happened, the scores of the actions, and the logarithm of how probable it is."""

    rewards: Float[np.ndarray, "N T B"]
    values: Float[np.ndarray, "N T B"]
    scores: Float[np.ndarray, "N T B P"]
    log_probs: Float[np.ndarray, "N"]


def every_batch(mdp: MDP, logits: Float[np.ndarray, "S A"], size: int = BATCH) -> Batches:
    """All of them, for a problem without terminal states."""
    every, log_probs = enumerate_observed(mdp, softmax_policy(logits))
    values, count = values_at(every, v_values(mdp, softmax_policy(logits))), len(log_probs)
    scores = [gradient_samples(logits, every, np.tile(one, (count, 1))).reshape(count, -1) for one in np.eye(HORIZON)]
    batch = np.stack(np.unravel_index(np.arange(count**size), (count,) * size), -1)
    pick = lambda x: np.moveaxis(np.asarray(x)[batch], 1, 2)  # noqa: E731
    return Batches(pick(every.rewards), pick(values), pick(np.stack(scores, 1)), log_probs[batch].sum(-1))


def steps_of(rewards: Float[Array, "T B"], values: Float[Array, "T B"]) -> Steps:
    """Whole episodes of `HORIZON` undiscounted steps side by side, each of which ends with the last."""
    end = jnp.zeros(rewards.shape, bool).at[-1].set(True)
    return Steps(
        reward=rewards,
        discount=1.0 - end.astype(rewards.dtype),
        cut=end,
        value=values,
        next_value=jnp.concatenate([values[1:], jnp.zeros_like(values[:1])]),
        ratio=jnp.ones_like(rewards),
        elapsed=jnp.zeros(rewards.shape[1], jnp.int32),
    )


def exact_moments(seed: int = 0) -> tuple[dict[tuple[str, str], Moments], Float[np.ndarray, "P"]]:
    """Mean and variance of every member as an estimate of ∇J, and ∇J itself."""
    mdp, logits = problem(seed)
    members, batches = estimators(), every_batch(mdp, logits)

    def all_of_them(rewards: Array, values: Array, scores: Array) -> list[Array]:
        # The mean over steps, which `Estimator` gives, times the steps of an episode, estimates ∇J.
        return [HORIZON * member.gradient(steps_of(rewards, values), scores) for member in members.values()]

    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(all_of_them))(*map(jnp.asarray, batches[:3]))
        samples = [np.asarray(x) for x in found]
    summary = [moments(x, batches.log_probs) for x in samples]
    return dict(zip(members, summary, strict=True)), policy_gradient(mdp, logits).ravel()


def draw(seed: int = 0) -> Figure:
    """The figure; `seed` chooses the problem."""
    found, gradient = exact_moments(seed)
    grid = lambda f: np.array([[f(found[r, b]) for b in BASELINES] for r in ROW_NAMES])  # noqa: E731
    variance = grid(lambda m: m.total_variance)
    bias = grid(lambda m: 100 * np.linalg.norm(m.mean - gradient) / np.linalg.norm(gradient))
    figure = Figure(figsize=(12.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_table(left, variance, np.log(variance), "Blues", "{:.2f}")
    left.set_title(f"total variance of the estimate from {BATCH} trajectories", fontsize=11)
    _draw_table(right, bias, bias, "Oranges", "{:.0f} %")
    right.set_title("bias, per cent of the length of $\\nabla J$", fontsize=11)
    right.set_yticklabels([])
    return figure


def _draw_table(axis: Axes, shown: np.ndarray, colour: np.ndarray, colours: str, form: str) -> None:
    span = max(float(colour.max() - colour.min()), 1e-9)
    axis.imshow(colour, cmap=colours, aspect="auto", vmin=colour.min() - 0.05 * span, vmax=colour.max() + 0.5 * span)
    for (row, column), number in np.ndenumerate(shown):
        axis.text(column, row, form.format(abs(number)), ha="center", va="center", fontsize=10, color="#222222")
    axis.set_xticks(range(len(BASELINES)), [COLUMN_NAMES[b] for b in BASELINES], fontsize=9)
    axis.set_yticks(range(len(ROW_NAMES)), list(ROW_NAMES.values()), fontsize=10)
    axis.set_xlabel("baseline")
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
