r"""The whole family of policy-gradient estimators side by side: exact variance and exact bias (notes 3.7, 4.2, 4.8, 4.9).

`ops.estimators.Estimator` is what `PolicyGradient` trains with. Here each of its members, every way to credit rewards with every baseline, is
evaluated on *every* batch of two trajectories of a small problem, and the results are weighted with the batches' probabilities:

$$E[g] = \sum_{\tau_1, \tau_2} p(\tau_1)\, p(\tau_2)\, g(\tau_1, \tau_2), \qquad \text{total variance} = \sum_j \mathrm{Var}[g_j].$$

V is exact. What the numbers show: reward-to-go and a baseline take most of the variance away; V is not the best of baselines (erratum
E4.13); the mean of the same batch shrinks the gradient to half, 1 - 1/N with N = 2, where leaving one out does not (erratum E3.5); the
optimal baselines, estimated from the batch that they are used on, are biased, too (erratum E3.6).

Source: notes, sections 3.7, 4.1, 4.2, 4.8 and 4.9 (items 3.23 and 4.1 to 4.3). The problem is our own.
"""

import equinox as eqx
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
from ..ops.estimators import BASELINES, RETURNS, Baseline, Estimator, Returns, Steps

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


def estimators(discount_states: bool = False) -> dict[tuple[Returns, Baseline], Estimator]:
    """Every member of the family, by its returns and its baseline."""
    make = lambda r, b: Estimator(r, b, discount_states, 1.0, GAE_LAMBDA, N_STEPS)  # noqa: E731
    return {(r, b): make(r, b) for r in RETURNS for b in BASELINES}  # type: ignore[misc]


def every_batch(
    mdp: MDP, logits: Float[np.ndarray, "S A"], size: int = BATCH
) -> tuple[Steps, Float[np.ndarray, "N T B P"], Float[np.ndarray, "N"]]:
    """All batches of `size` trajectories of a problem without terminal states: steps `[N, T, B]`, scores, log probabilities."""
    every, log_probs = enumerate_observed(mdp, softmax_policy(logits))
    values = v_values(mdp, softmax_policy(logits))
    steps, count = every.rewards.shape[1], len(log_probs)
    only = np.eye(steps)
    scores = np.stack([gradient_samples(logits, every, np.tile(one, (count, 1))).reshape(count, -1) for one in only], 1)
    value = np.concatenate([values_at(every, values), np.zeros((count, 1))], 1)
    batch = np.stack(np.unravel_index(np.arange(count**size), (count,) * size), -1)
    pick = lambda x: np.moveaxis(np.asarray(x)[batch], 1, 2)  # noqa: E731
    ends = np.broadcast_to(np.arange(steps) == steps - 1, every.rewards.shape)
    data = (every.rewards, float(mdp.discount) * ~ends, ends, value[:, :-1], value[:, 1:])
    elapsed = np.zeros((len(batch), size), np.int32)
    return Steps(*map(pick, data), elapsed), pick(scores), log_probs[batch].sum(-1)  # type: ignore[arg-type]


def exact_moments(seed: int = 0) -> tuple[dict[tuple[Returns, Baseline], Moments], Float[np.ndarray, "P"]]:
    """Mean and variance of every member as an estimate of ∇J, and ∇J itself."""
    mdp, logits = problem(seed)
    members = estimators()
    steps, scores, log_probs = every_batch(mdp, logits)
    with jax.enable_x64(True):
        # The mean over steps that `Estimator` gives, times the steps of an episode, estimates ∇J.
        all_of_them = lambda s, g: [HORIZON * member.gradient(s, g) for member in members.values()]  # noqa: E731
        found = jax.jit(jax.vmap(all_of_them))(jax.tree.map(jnp.asarray, steps), jnp.asarray(scores))
        samples = [np.asarray(x) for x in found]
    summary = [moments(x, log_probs) for x in samples]
    return dict(zip(members, summary, strict=True)), policy_gradient(mdp, logits).ravel()


def draw(seed: int = 0) -> Figure:
    """The figure; `seed` chooses the problem."""
    found, gradient = exact_moments(seed)
    grid = lambda f: np.array([[f(found[r, b]) for b in BASELINES] for r in RETURNS])  # type: ignore[index]  # noqa: E731
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
    axis.set_yticks(range(len(RETURNS)), [ROW_NAMES[r] for r in RETURNS], fontsize=10)
    axis.set_xlabel("baseline")
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
