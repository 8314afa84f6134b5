r"""Mistakes in T steps: a copy makes them in proportion to T^2, DAgger in proportion to T.

On the tightrope (`envs.tabular_problems.tightrope`) a copy errs with chance ε in each step on the rope. On the ground
it knows no better than to go on stepping, a mistake in every step: T - (1 - ε)(1 - (1 - ε)^T) / ε in all, as many as
there can be. With labels of the ground as well, ε T. All are exact. Two learners beside them: BC and DAgger from an
expert whose answers are wrong with chance ε, acting by sampling.

Source: notes, section 2.4, errata E2.2 to E2.5 (items 2.26 to 2.28); Ross and Bagnell (2010).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.figure import Figure

from ..core import Policy, env_spec
from ..envs.imitation_problems import balance
from ..envs.tabular import TabularEnv
from ..envs.tabular_problems import TIGHTROPE_EXPERT, tightrope
from ..envs.vectorize import vectorize
from ..imitation import BC, DAgger, Fallible, as_expert, error_bounds, expected_mistakes
from ..loops.offline import Offline
from ..nn import MLP
from ..ops.schedules import Linear
from ..runner.collect import Recorded, play
from ..runner.engine import run

EPS = 0.01
HORIZONS = np.unique(np.geomspace(1, 1000, 40).astype(int))
INK, COPY, REPAIRED = "#333333", "#d55e00", "#0072b2"


def copy_policy(eps: float) -> Float[np.ndarray, "2 2"]:
    """Errs with chance ε on the rope, and steps on the ground as if it were there."""
    return np.array([[1 - eps, eps], [1.0, 0.0]])


def repaired_policy(eps: float) -> Float[np.ndarray, "2 2"]:
    """Errs with chance ε everywhere."""
    return np.array([[1 - eps, eps], [eps, 1 - eps]])


def mistakes(policy: Float[np.ndarray, "2 2"], horizons: Int[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """Expected mistakes in so many steps, exactly. A way back helps whoever takes it."""
    every = expected_mistakes(tightrope(int(max(horizons))), policy, TIGHTROPE_EXPERT)
    return np.cumsum(every)[np.asarray(horizons) - 1]


class Learned(NamedTuple):
    """What BC and DAgger have learnt, as tables π(a | s)."""

    cloned: Float[np.ndarray, "2 2"]
    asked: Float[np.ndarray, "2 2"]


def learn(seed: int = 0, eps: float = EPS) -> Learned:
    """From an expert whose labels are wrong with chance ε.

    The network is one layer of one-hot states and a bias: what it learns of the rope, it half believes of the ground.
    """
    key = jax.random.key(seed)
    env = vectorize(TabularEnv(tightrope(50)), 8)
    spec = env_spec(env)
    right = as_expert(balance, spec)
    # Of the answers that are replaced by a random one, half happen to be right.
    expert = Fallible(right, spec, noise=2 * eps)
    learner = BC(network=MLP(), learning_rate=Linear(0.1, 0.0))
    data = play(env, Recorded(right, spec), 80, key)
    said = jax.vmap(lambda o, k: expert(expert.init(k), o, k)[1])(
        data.transitions.observation, jax.random.split(key, data.num_steps)
    )
    data = type(data).of(type(data.transitions)(**{**vars(data.transitions), "action": said}), data.spec)
    cloning = Offline(data, learner, batch_size=512, updates=20)
    asking = DAgger(env, learner, expert, unroll=250, updates=100, batch_size=512, explore=True)
    return Learned(*(_table(a.policy(run(a, key, 20)[0], explore=True)) for a in (cloning, asking)))


@jax.jit
def _probabilities(policy: Policy) -> Float[Array, "2 2"]:
    return jax.vmap(partial(policy.inspect, ()))(jnp.arange(2))["probabilities"]


def _table(policy: Policy) -> Float[np.ndarray, "2 2"]:
    table = np.asarray(_probabilities(policy), np.float64)
    return table / table.sum(-1, keepdims=True)


def draw(seed: int = 0) -> Figure:
    """The figure."""
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    axis = figure.subplots()
    bounds = [error_bounds(EPS, int(n)) for n in HORIZONS]
    axis.plot(HORIZONS, [b.quadratic for b in bounds], ":", color=INK, label="$\\epsilon T^2$")
    axis.plot(HORIZONS, [b.sharp for b in bounds], "--", color=INK, linewidth=1, label="$\\epsilon T (T + 1) / 2$")
    axis.plot(HORIZONS, [b.tightrope for b in bounds], color=COPY, label="a copy on the tightrope")
    axis.plot(
        HORIZONS,
        mistakes(repaired_policy(EPS), HORIZONS),
        color=REPAIRED,
        label="with labels of the ground: $\\epsilon T$",
    )
    learned = learn(seed)
    for table, colour, mark, name in ((learned.cloned, COPY, "o", "BC"), (learned.asked, REPAIRED, "s", "DAgger")):
        axis.plot(
            HORIZONS[::3], mistakes(table, HORIZONS[::3]), mark, color=colour, markersize=5, label=f"{name}, learnt"
        )
    axis.set(xscale="log", yscale="log", xlabel="$T$", ylim=(EPS / 2, 2000), xlim=(1, 1000))
    axis.set_ylabel(f"expected mistakes in $T$ steps, $\\epsilon$ = {EPS:g}")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
    return figure
