r"""Estimated and true values while DQN and double DQN learn (item 6.12).

A problem where no action is better than another: anywhere next, a reward of 3 or -1 by a coin, so that with $\gamma = 0.9$ every value
is 10. Every hundred steps the greedy policy plays on, and what it thinks of each state is compared with what it then earns, in several
seeds.

Source: notes, section 6.3; van Hasselt et al. 2016, figure 3. The problem is our own.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from ..data.replay import UniformReplay
from ..envs.tabular import MDP, TabularEnv
from ..envs.vectorize import vectorize
from ..loops.off_policy import OffPolicy
from ..nn import MLP
from ..value.dqn import DQN
from ..value.overestimation import check_values

GAMMA, SEEDS, MOMENTS, BETWEEN = 0.9, 8, 30, 25
"""Discount; runs; how often values are checked; iterations of four steps in between."""
INK, COLOURS = "#333333", {"DQN": "#d55e00", "double DQN": "#0072b2"}


def coins(states: int = 3, actions: int = 8) -> MDP:
    """All actions alike. Every value is 1 / (1 - gamma) = 10."""
    transitions = np.full((2 * states, actions, 2 * states), 1 / (2 * states))
    rewards = np.where(np.arange(2 * states) < states, 3.0, -1.0) * np.ones((2 * states, actions, 1))
    return MDP(transitions, rewards, 0, GAMMA)


def curves(double: bool, seed: int = 0) -> tuple[Float[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """Estimated and true values of each run at each moment."""
    env, many = vectorize(TabularEnv(coins()), 1), vectorize(TabularEnv(coins()), 16)
    learner = DQN(
        network=MLP(), gamma=GAMMA, epsilon=1.0, optimiser="sgd", learning_rate=0.5, double=double, target_period=50,
        huber=1e9, max_grad_norm=1e9,
    )  # fmt: skip
    loop = OffPolicy(env, learner, UniformReplay(1000), unroll=4, updates=2, batch_size=32)

    def run(key: Array) -> tuple[Array, Array]:
        def moment(state: Any, key: Array) -> tuple[Any, tuple[Array, Array]]:
            step = lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0]  # noqa: E731
            state = jax.lax.fori_loop(0, BETWEEN, step, state)
            found = check_values(many, loop.policy(state), key, gamma=GAMMA, steps=150)
            return state, (found.estimated, found.true)

        return jax.lax.scan(moment, loop.init(key), jax.random.split(key, MOMENTS))[1]

    keys = jax.random.split(jax.random.key(seed), SEEDS)
    estimated, true = jax.device_get(jax.jit(jax.vmap(run))(keys))
    return np.asarray(estimated), np.asarray(true)


def draw(seed: int = 0) -> Figure:
    """The figure."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    steps = 1000 + 4 * BETWEEN * np.arange(1, MOMENTS + 1)
    for name, colour in COLOURS.items():
        estimated, true = curves(name == "double DQN", seed)
        axis.plot(steps, np.median(estimated, 0), color=colour, label=f"{name}, estimated")
        axis.fill_between(steps, *np.quantile(estimated, [0.25, 0.75], axis=0), color=colour, alpha=0.2, linewidth=0)
        axis.plot(steps, np.median(true, 0), color=colour, linestyle="dotted", label=f"{name}, true")
    axis.axhline(1 / (1 - GAMMA), color=INK, linewidth=0.8, linestyle="dashed")
    axis.set(xlabel="environment steps", ylabel="value, median and quartiles of 8 seeds")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
    return figure
