r"""Bias and variance of n-step and of λ-returns, exactly, and what they do to learning (notes 4.9).

Above, for a critic that is wrong, V = V^π + noise, what the mean of a few G^(n) or G^λ is worth as an estimate of Q^π(s, a):

$$E[G^{(n)} | s, a] - Q^\pi(s, a) = \gamma^n E[V(s_{t+n}) - V^\pi(s_{t+n})], \qquad
G^\lambda_t = r_t + \gamma [(1 - \lambda) V(s_{t+1}) + \lambda G^\lambda_{t+1}].$$

The last makes G^λ the return of a problem with discount γ λ and rewards r + γ (1 - λ) V(s'), so both moments solve linear equations. Below,
the error of tables that learn the 19-state random walk in 10 episodes, with the best α for each n and each λ: neither one step nor
Monte Carlo is best. λ is the chance of looking one step further (erratum E4.11).

Source: notes, section 4.9 (items 4.31, 4.32 and 4.35); Sutton and Barto 2018, figures 7.2 and 12.6.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..actor_critic.tabular_values import learn_n_step, learn_td_lambda
from ..envs.tabular import MDP, TabularEnv
from ..envs.tabular_problems import random_mdp, random_policy, random_walk
from ..exact import TablePolicy, q_values, simulate, v_values
from ..exact.estimators import Moments
from ..exact.targets import n_step_return_moments

STEPS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
LAMBDAS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95, 0.975, 0.99, 1.0)
RATES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
EPISODES, HORIZON = 10, 700
SAMPLES = 5
BIAS, VARIANCE, SUM, INK = "#d55e00", "#0072b2", "#333333", "#333333"


def lambda_return_moments(
    mdp: MDP, policy: Float[np.ndarray, "S A"], values: Float[np.ndarray, "S"], lambda_: float
) -> Moments:
    """Mean and variance of G^λ given s and a. With λ = 1 and discount 1 the policy must come to an end."""
    transitions, live = np.asarray(mdp.transitions, np.float64), ~np.asarray(mdp.terminal)
    given = np.asarray(mdp.rewards, np.float64)[..., None] if mdp.outcome_rewards is None else mdp.outcome_rewards
    discount, ahead = float(mdp.discount), np.where(live, values, 0.0)
    reward, further = given + discount * (1 - lambda_) * ahead, discount * lambda_
    joint = policy[..., None] * transitions * live[:, None, None]
    chain = joint.sum(1) * live

    def solved(each: Array | np.ndarray, factor: float) -> np.ndarray:
        return np.linalg.solve(np.eye(len(live)) - factor * chain, (joint * each).sum((1, 2)))

    mean = solved(reward, further)
    square = solved(reward**2 + 2 * further * reward * mean, further**2)
    action_mean = (transitions * (reward + further * mean)).sum(-1)
    action_square = (transitions * (reward**2 + 2 * further * reward * mean + further**2 * square)).sum(-1)
    return Moments(action_mean, np.maximum(action_square - action_mean**2, 0.0))


class Spread(NamedTuple):
    """Squared bias and variance of the mean of `SAMPLES` returns, averaged over states and actions, for each n and for each λ."""

    n_step: Float[np.ndarray, "2 K"]
    lambdas: Float[np.ndarray, "2 L"]


def critic(seed: int = 0) -> tuple[MDP, Float[np.ndarray, "S A"], Float[np.ndarray, "S"]]:
    """A random problem of 8 states, a policy, and a V with normal noise of standard deviation 3, drawn with `seed`."""
    mdp, policy = random_mdp(0, 8, 2, discount=0.95, concentration=0.1), random_policy(0, 8, 2)
    return mdp, policy, v_values(mdp, policy) + 3 * np.random.default_rng(seed).normal(size=8)


def spreads(seed: int = 0, steps: int = 16, grid: int = 101) -> Spread:
    """Exact, for n = 1..`steps` and for `grid` values of λ between 0 and 1."""
    mdp, policy, noisy = critic(seed)
    q = q_values(mdp, policy)

    def summary(found: list[Moments]) -> np.ndarray:
        return np.array([[((m.mean - q) ** 2).mean(), m.variance.mean() / SAMPLES] for m in found]).T

    return Spread(
        summary([n_step_return_moments(mdp, policy, noisy, n) for n in range(1, steps + 1)]),
        summary([lambda_return_moments(mdp, policy, noisy, x) for x in np.linspace(0, 1, grid)]),
    )


class Sweep(NamedTuple):
    """RMSE of V over states, episodes and learners: for each of `STEPS`, each of `LAMBDAS`, and each of `RATES`."""

    n_step: Float[np.ndarray, "K R"]
    lambdas: Float[np.ndarray, "L R"]


def sweep(seed: int = 0, runs: int = 100) -> Sweep:
    """Learning the values of the 19-state random walk, `runs` times for each setting, all from the same walks."""
    walk, uniform = random_walk(), np.full((21, 2), 0.5)
    policy = TablePolicy(jnp.asarray(uniform, jnp.float32))
    walks = simulate(TabularEnv(walk), policy, jax.random.key(seed), runs * EPISODES, HORIZON)
    walks, rates, true = jax.tree.map(np.asarray, walks), np.array(RATES), v_values(walk, uniform)

    def error(tables: Float[Array | np.ndarray, "R E K O"]) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.sqrt(((np.asarray(tables) - true)[..., 1:-1] ** 2).mean(-1)).mean((0, 1))

    n_step = [error(learn_n_step(walks, 21, n, rates, runs=runs)) for n in STEPS]
    lambdas = [error(learn_td_lambda(walks, 21, lambda_, rates, runs=runs)) for lambda_ in LAMBDAS]
    # Rates at which learning diverged count as infinitely bad.
    return Sweep(np.nan_to_num(n_step, nan=np.inf), np.nan_to_num(lambdas, nan=np.inf))


def draw(seed: int = 0, runs: int = 60) -> Figure:
    """The figure; noise and walks are from `seed`."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    ((by_n, by_lambda), (learned_n, learned_lambda)) = figure.subplots(2, 2)
    exact, learned = spreads(seed), sweep(seed, runs)
    _draw_spread(by_n, np.arange(1, exact.n_step.shape[1] + 1), exact.n_step, "o-")
    by_n.set(xlabel="$n$", title=f"$Q^\\pi(s, a)$ as the mean of {SAMPLES} $n$-step returns", xticks=[1, 4, 8, 12, 16])
    _draw_spread(by_lambda, np.linspace(0, 1, exact.lambdas.shape[1]), exact.lambdas, "-")
    by_lambda.set(xlabel="$\\lambda$", title=f"$Q^\\pi(s, a)$ as the mean of {SAMPLES} $\\lambda$-returns")
    by_lambda.legend(frameon=False, fontsize=9, loc="upper center")
    by_n.set_ylim(by_lambda.get_ylim())
    _draw_learning(learned_n, np.array(STEPS), learned.n_step)
    learned_n.set_xscale("log", base=2)
    learned_n.set(
        xlabel="$n$", title=f"random walk, 19 states, {EPISODES} episodes: $n$-step TD", xticks=STEPS, xticklabels=STEPS
    )
    learned_n.minorticks_off()
    _draw_learning(learned_lambda, np.array(LAMBDAS), learned.lambdas)
    learned_lambda.set(xlabel="$\\lambda$", title="the same: TD($\\lambda$) with eligibility traces")
    top = 1.08 * max(learned.n_step.min(1).max(), learned.lambdas.min(1).max())
    for axis in (learned_n, learned_lambda):
        axis.set_ylim(0, top)
    return figure


def _draw_spread(axis: Axes, place: np.ndarray, found: np.ndarray, style: str) -> None:
    bias, variance = found
    axis.plot(place, bias, style, color=BIAS, markersize=4, label="bias²")
    axis.plot(place, variance, style, color=VARIANCE, markersize=4, label="variance")
    axis.plot(place, bias + variance, style, color=SUM, markersize=4, linewidth=2, label="mean squared error")
    _mark_least(axis, place, bias + variance)
    axis.set(ylabel="mean over $(s, a)$", ylim=(0, None))


def _draw_learning(axis: Axes, place: np.ndarray, errors: np.ndarray) -> None:
    best = errors.min(1)
    axis.plot(place, best, "o-", color=SUM, markersize=4, linewidth=2)
    _mark_least(axis, place, best)
    axis.set_ylabel("RMSE of $V$, best $\\alpha$")


def _mark_least(axis: Axes, place: np.ndarray, height: np.ndarray) -> None:
    least = int(np.argmin(height))
    axis.plot(
        place[least],
        height[least],
        "o",
        markersize=11,
        markerfacecolor="none",
        markeredgecolor=INK,
        markeredgewidth=1.3,
    )
    axis.annotate(f"best: {place[least]:g}", (place[least], height[least]), (0, 11), textcoords="offset points",
                  ha="center", va="bottom", fontsize=9, color=INK)  # fmt: skip
    axis.spines[["top", "right"]].set_visible(False)
