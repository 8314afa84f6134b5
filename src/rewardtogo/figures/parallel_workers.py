r"""Figure 4.2: parallel workers, synchronous and asynchronous, drawn from what an actor-critic on CartPole counted.

Synchronous workers (A2C) wait for each other: every update uses one rollout of each, made by the parameters as they are. Asynchronous
ones (A3C) go on by themselves: every update uses the rollout of one worker, which acted with the parameters that it fetched when it last
delivered, so that they are older by its *lag*, the number of updates in between. With W workers in turn the lag is W - 1; in random order
it is W - 1 in the mean, and has no largest value. No rollout is lost, and none is used twice.

Source: notes, section 4.7 (items 4.25 to 4.27); Mnih et al. 2016.
"""

from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..actor_critic.asynchronous import Asynchronous, AsynchronousState
from ..core import env_spec
from ..envs.registry import make
from ..loops.collect import begin, collect
from ..nn import MLP, VERSION
from ..policy_gradient.vanilla import PolicyGradient

WORKERS, UNROLL = 4, 5
INK, FRESH, OLD = "#333333", "#0072b2", "#d55e00"
SHOWN = 16
"""Updates in the timelines."""


class Rollouts(NamedTuple):
    """Of every rollout, in the order in which they were used: who made it, with which version of the parameters, and which it updated."""

    worker: Int[np.ndarray, "N"]
    version: Int[np.ndarray, "N"]
    update: Int[np.ndarray, "N"]

    @property
    def lag(self) -> Int[np.ndarray, "N"]:
        """How many updates older the acting parameters were than those that learned."""
        return self.update - self.version


def learner() -> PolicyGradient:
    """A small actor-critic."""
    return PolicyGradient(MLP(8), returns="n_step", value_updates=1)  # pyright: ignore[reportCallIssue]


def synchronous(seed: int = 0, updates: int = SHOWN) -> Rollouts:
    """One environment for each of the workers, stepped together: versions as the policy wrote them down while acting."""
    env, critic = make("CartPole-v1", WORKERS), learner()
    learner_key, actor_key, key = jax.random.split(jax.random.key(seed), 3)
    state = critic.init(env_spec(env), learner_key)
    actor = begin(env, critic.policy(state, explore=True), actor_key)

    def iterate(loop: tuple, key: Array) -> tuple[tuple, tuple[Array, Array]]:
        state, actor = loop
        collect_key, update_key = jax.random.split(key)
        actor, rollout, _ = collect(env, critic.policy(state, explore=True), actor, collect_key, UNROLL)
        following, _, _ = critic.update(state, rollout, update_key)
        return (following, actor), (rollout.transitions.extras[VERSION][-1], state.updates)

    run = jax.jit(lambda loop, keys: jax.lax.scan(iterate, loop, keys)[1])
    version, update = map(np.asarray, run((state, actor), jax.random.split(key, updates)))
    return Rollouts(np.tile(np.arange(WORKERS), updates), version.ravel(), np.repeat(update, WORKERS))


def asynchronous(order: Literal["in_turn", "random"] = "in_turn", seed: int = 0, updates: int = SHOWN) -> Rollouts:
    """One environment for each of the workers, which deliver one after another."""
    algorithm = Asynchronous(make("CartPole-v1", 1), learner(), workers=WORKERS, unroll=UNROLL, order=order)
    init_key, key = jax.random.split(jax.random.key(seed))

    def iterate(state: AsynchronousState, key: Array) -> tuple[AsynchronousState, tuple[Array, Array, Array]]:
        following, _ = algorithm.step(state, key)
        return following, (state.fetched, following.fetched, state.updates)

    run = jax.jit(lambda key, keys: jax.lax.scan(iterate, algorithm.init(key), keys)[1])
    before, after, update = map(np.asarray, run(init_key, jax.random.split(key, updates)))
    worker = (before != after).argmax(1)
    return Rollouts(worker, before[np.arange(updates), worker], update)


def draw(seed: int = 0, updates: int = 400) -> Figure:
    """Timelines of the first updates, and the lags of `updates` of them."""
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    axes = figure.subplot_mosaic([["sync", "lags"], ["async", "lags"]], width_ratios=[2.1, 1])
    turns, drawn = asynchronous("in_turn", seed, updates), asynchronous("random", seed, updates)
    together = synchronous(seed, updates)
    _draw_timeline(
        axes["sync"], together, f"synchronous: {WORKERS} rollouts for each update, all of the newest parameters"
    )
    _draw_timeline(
        axes["async"], turns, "asynchronous, in turn: an update for each rollout, of parameters as the bar says"
    )
    axes["async"].set_xlabel("version of the parameters: updates so far")
    _draw_lags(axes["lags"], {"synchronous": together, "in turn": turns, "random order": drawn})
    return figure


def _draw_timeline(axis: Axes, rollouts: Rollouts, title: str) -> None:
    for worker, version, update in zip(*rollouts, strict=True):
        if version >= SHOWN:
            continue
        colour = FRESH if version == update else OLD
        axis.barh(worker, update + 1 - version - 0.14, left=version + 0.07, height=0.62, color=colour, alpha=0.3,
                  edgecolor=colour, linewidth=1.3)  # fmt: skip
        middle = (version + min(update, SHOWN - 1) + 1) / 2
        axis.text(middle, worker, f"{version}", ha="center", va="center", fontsize=9, color=INK)
        if update < SHOWN:
            axis.plot([update + 1], [worker], marker=">", color=colour, markersize=5, zorder=3, clip_on=False)
    for update in range(1, SHOWN + 1):
        axis.axvline(update, color="#cccccc", linewidth=0.8, zorder=0)
    axis.set_yticks(range(WORKERS), [f"worker {i + 1}" for i in range(WORKERS)])
    axis.set(xlim=(0, SHOWN + 0.2), ylim=(WORKERS - 0.45, -0.55), xticks=range(0, SHOWN + 1, 2))
    axis.set_title(title, fontsize=11)
    axis.tick_params(axis="y", length=0)
    axis.spines[["top", "right", "left"]].set_visible(False)


def _draw_lags(axis: Axes, kinds: dict[str, Rollouts]) -> None:
    most = 3 * WORKERS
    shades = (FRESH, OLD, "#999999")
    for i, ((name, rollouts), colour) in enumerate(zip(kinds.items(), shades, strict=True)):
        share = np.bincount(np.minimum(rollouts.lag, most), minlength=most + 1) / len(rollouts.lag)
        axis.bar(
            np.arange(most + 1) + 0.28 * (i - 1),
            share,
            width=0.28,
            color=colour,
            label=f"{name}: mean {rollouts.lag.mean():.2g}",
        )
    axis.set(xlabel="lag: updates since the acting parameters", ylabel="share of the rollouts")
    axis.set_xticks(range(0, most + 1, 2), [*map(str, range(0, most, 2)), f"{most}+"])
    axis.set_title("how old the acting parameters are", fontsize=11)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
