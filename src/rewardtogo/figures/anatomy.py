"""Figure 1.2: the anatomy of reinforcement learning, with measured times.

Generate samples, fit a model or estimate the return, improve the policy, and again. For PPO on CartPole the three parts are timed as
programs of their own (item 1.23): acting in the environment, values and advantages of the rollout, and the update.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from ..core import env_spec
from ..envs.registry import make
from ..loops.collect import begin, collect
from ..policy_gradient.ppo import PPO

INK, COLOURS = "#333333", ("#0072b2", "#009e73", "#d55e00")
PARTS = ("generate samples", "estimate the return", "improve the policy")
DETAIL = (
    "run the policy in the\nenvironment",
    "fit values: V, advantages\n(or a model)",
    "gradient steps on the\nobjective",
)
CENTRES = ((0.0, 1.0), (1.15, -0.55), (-1.15, -0.55))


def median_seconds(call: Callable[[], Any], repeats: int = 15) -> float:
    """Median time of a compiled call, the first one (which compiles) left out."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def measure(seed: int = 0) -> tuple[float, float, float]:
    """Seconds of the three parts of one PPO iteration: 8 environments, 128 steps each."""
    env, learner = make("CartPole-v1", 8), PPO()
    spec_key, actor_key, key = jax.random.split(jax.random.key(seed), 3)
    state = learner.init(env_spec(env), spec_key)
    actor = begin(env, learner.policy(state, explore=True), actor_key)
    acting = jax.jit(lambda state, actor: collect(env, learner.policy(state, explore=True), actor, key, 128)[:2])
    rollout = acting(state, actor)[1]
    values = jax.jit(lambda state, rollout: state.network.values(rollout, lambda x: x))
    update = jax.jit(lambda state, rollout: learner.update(state, rollout, key)[0])
    collecting = median_seconds(lambda: acting(state, actor))
    estimating = median_seconds(lambda: values(state, rollout))
    return collecting, estimating, max(median_seconds(lambda: update(state, rollout)) - estimating, 0.0)


def draw(seed: int = 0) -> Figure:
    """The loop, and beside it the share of the time that each part takes."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    loop, bars = figure.subplots(1, 2, width_ratios=[1.35, 1])
    _draw_loop(loop)
    _draw_times(bars, measure(seed))
    return figure


def _draw_loop(axis: Axes) -> None:
    axis.set(xlim=(-2.1, 2.1), ylim=(-1.25, 1.65), aspect="equal")
    axis.axis("off")
    for (x, y), name, detail, colour in zip(CENTRES, PARTS, DETAIL, COLOURS, strict=True):
        box = FancyBboxPatch((x - 0.85, y - 0.38), 1.7, 0.76, boxstyle="round,pad=0.04,rounding_size=0.12",
                             facecolor=colour + "22", edgecolor=colour, linewidth=2)  # fmt: skip
        axis.add_patch(box)
        axis.text(x, y + 0.17, name, ha="center", va="center", fontsize=12, weight="bold", color=INK)
        axis.text(x, y - 0.15, detail, ha="center", va="center", fontsize=10, color=INK)
    ends = (((0.95, 0.75), (1.45, -0.08)), ((0.22, -0.75), (-0.22, -0.75)), ((-1.45, -0.08), (-0.95, 0.75)))
    for (start, end), bend in zip(ends, (-0.25, -0.2, -0.25), strict=True):
        arrow = FancyArrowPatch(start, end, connectionstyle=f"arc3,rad={bend}", arrowstyle="-|>", mutation_scale=18,
                                linewidth=1.8, color=INK)  # fmt: skip
        axis.add_patch(arrow)


def _draw_times(axis: Axes, seconds: tuple[float, float, float]) -> None:
    shares = np.asarray(seconds) / sum(seconds)
    axis.barh(range(3), 100 * shares, color=COLOURS, height=0.55)
    axis.set_yticks(range(3), PARTS)
    axis.invert_yaxis()
    for i, (share, second) in enumerate(zip(shares, seconds, strict=True)):
        axis.text(100 * share + 1.5, i, f"{100 * share:.0f} %  ({1000 * second:.2f} ms)", va="center", color=INK)
    axis.set_xlim(0, 125)
    axis.set_xticks([0, 25, 50, 75, 100])
    axis.set_xlabel("share of one iteration of PPO on CartPole-v1\n(8 environments × 128 steps, 4 epochs), per cent")
    axis.spines[["top", "right"]].set_visible(False)
