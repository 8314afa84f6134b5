"""Figure 2.1: a copy drifts away from where its data was, and DAgger does not.

On the winding road of `Lane` the expert's data was taken on a day without wind, so that it never shows how to get
back to the middle. The copies drive with wind, and so does the expert: each of them in the same wind, that is, with
the same random numbers. What differs is then what they do:

    deviation_t = |y_t - y_t^exp|,    a mean over the winds.

Nobody is stopped at the edge of the lane, so that one sees how far they go.

Source: notes, sections 2.1 and 2.2, figure 2.1 (items 2.5 and 2.6). The problem is our own.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from ..core import Policy, PRNGKey, env_spec
from ..envs.imitation_problems import Lane, steer
from ..envs.time_limit import TimeLimit
from ..envs.vectorize import vectorize
from ..imitation import BC, DAgger, as_expert
from ..loops.offline import Offline
from ..nn import MLP
from ..runner.collect import Recorded, play
from ..runner.engine import run

LIMIT, STEPS, WINDS, ROUNDS, UPDATES = 200, 100, 50, 10, 200
"""Steps of an episode to learn from; of a drive, so few that nobody has turned round; drives; rounds of DAgger, each of
4 x 100 labels; and gradient steps in each of them, BC taking as many in all."""
LEARNER = BC(network=MLP(32), learning_rate=3e-3)
INK, EXPERT, CLONE, ASKED = "#333333", "#999999", "#d55e00", "#0072b2"


class Drift(NamedTuple):
    """Distance from the middle of the lane, by wind and time; the edge is at 1. The training trajectory is `trained`."""

    trained: Float[np.ndarray, "T"]
    expert: Float[np.ndarray, "N T"]
    cloned: Float[np.ndarray, "N T"]
    asked: Float[np.ndarray, "N T"]

    def deviation(self, paths: Float[np.ndarray, "N T"]) -> Float[np.ndarray, "T"]:
        """Mean over the winds of |y_t - y_t^exp|."""
        return np.abs(paths - self.expert).mean(0)


@partial(jax.jit, static_argnames="steps")
def drive(policy: Policy, env: Lane, key: PRNGKey, steps: int) -> Float[Array, "T"]:
    """y_1..y_T in one wind, past the edge of the lane too. Everybody with this key has this wind."""
    wind_key, act_key, carry_key = jax.random.split(key, 3)
    state, observation = env.reset(wind_key)

    def step(now: tuple, keys: Array) -> tuple[tuple, Array]:
        state, observation, carry = now
        carry, action, _ = policy(carry, observation, keys[0])
        state, timestep = env.step(state, jnp.clip(action, -1.0, 1.0), keys[1])
        return (state, timestep.observation, carry), state.offset

    keys = jnp.stack([jax.random.split(act_key, steps), jax.random.split(wind_key, steps)], 1)
    return jax.lax.scan(step, (state, observation, policy.init(carry_key)), keys)[1]


def measure(seed: int = 0) -> Drift:
    """Trains both copies, and drives."""
    key = jax.random.key(seed)
    calm, windy = Lane(0.0), Lane()
    env = vectorize(TimeLimit(calm, LIMIT), 1)
    spec = env_spec(env)
    expert = as_expert(steer, spec)
    cloning = Offline(play(env, Recorded(expert, spec), 1, key), LEARNER, updates=UPDATES)
    asking = DAgger(vectorize(TimeLimit(windy, LIMIT), 4), LEARNER, expert, unroll=100, updates=UPDATES)
    policies = (expert, *(algorithm.policy(run(algorithm, key, ROUNDS)[0]) for algorithm in (cloning, asking)))
    winds = jax.random.split(jax.random.fold_in(key, 1), WINDS)
    paths = [np.asarray(jax.vmap(lambda k, p=p: drive(p, windy, k, STEPS))(winds), np.float64) for p in policies]
    return Drift(np.asarray(drive(expert, calm, key, STEPS), np.float64), *paths)


def draw(seed: int = 0) -> Figure:
    """The figure."""
    found = measure(seed)
    figure = Figure(figsize=(11, 4), layout="constrained")
    road, apart = figure.subplots(1, 2, width_ratios=[1.35, 1])
    time = np.arange(1, STEPS + 1)
    road.fill_between(time, -1, 1, color="#f2f2f2", linewidth=0)
    for paths, colour, name in ((found.cloned, CLONE, "BC"), (found.asked, ASKED, "DAgger")):
        road.plot(time, paths[:12].T, color=colour, linewidth=0.9, alpha=0.8)
        road.plot([], [], color=colour, label=name)
        apart.plot(time, found.deviation(paths), color=colour, label=name)
    road.plot(time, found.trained, "--", color=INK, linewidth=1, label="training trajectory")
    road.set(xlabel="$t$", ylabel="distance from the middle of the lane", ylim=(-3, 3), xlim=(0, STEPS))
    road.set_title("twelve winds; the lane is grey", fontsize=11)
    apart.set(xlabel="$t$", yscale="log", xlim=(0, STEPS))
    apart.set_title("mean distance from the expert in the same wind", fontsize=11)
    for axis, place in ((road, (0.02, 0.72)), (apart, (0.6, 0.5))):
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=9, loc=place)
    return figure
