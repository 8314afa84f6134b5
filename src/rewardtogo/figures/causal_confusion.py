"""Causal confusion: a brake light makes a copy look better and drive worse, and two cures (notes, section 2.3.1).

In `Braking` a sensor is wrong in 2 % of the steps, and a light on the dashboard shows the last action. In an expert's
data the light tells the next action better than the sensor does, so that the validation loss falls when the light is
in view. But whoever brakes because it braked never begins to, or never ends: the return is lower than without the
light. DAgger's data has the learner's own mistakes in it, in which the light is wrong; and among policies for all
graphs of causes (`imitation.causal`) the return says which one to use.

Source: notes, section 2.3.1, erratum E2.10 (items 2.16 to 2.18); de Haan, Jayaraman and Levine (2019). The problem is our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core import Algorithm, Batch, Policy, PRNGKey, env_spec
from ..data.episodes import Dataset
from ..envs.imitation_problems import Braking, brake
from ..envs.vectorize import vectorize
from ..imitation import BC, DAgger, as_expert, choose_graph_by_return, with_random_graphs
from ..imitation.causal import GraphPolicy
from ..loops.offline import Offline
from ..nn import MLP, Entries
from ..runner.collect import Recorded, play
from ..runner.engine import run
from ..runner.evaluate import Evaluator

SEEN = (0, 1)
"""The sensor and the light, without the truth."""
EPISODES, ROUNDS, BEST = 50, 10, 100.0
LEARNER = BC(network=Entries(SEEN, MLP(16)), learning_rate=0.01)
INK, PLAIN, LIT, CURED = "#333333", "#0072b2", "#d55e00", "#009e73"


def demonstrations(env: Braking, key: PRNGKey) -> Dataset:
    """What the expert does, who sees the obstacles."""
    many = vectorize(env, EPISODES)
    return play(many, Recorded(as_expert(brake, env_spec(many)), env_spec(many)), EPISODES, key)


def returned(env: Braking, policy: Policy, key: PRNGKey) -> float:
    """Mean return of 100 episodes."""
    return float(Evaluator(vectorize(env, 100), 100)(policy, key)[0].mean())


class Cloned(NamedTuple):
    """Mean -log pi(a* | o) of BC on data of the expert's that it did not learn from, and its return."""

    loss: float
    earned: float


def clone(light: bool, seed: int = 0) -> Cloned:
    """BC from the expert's data, with or without the light."""
    env, key = Braking(light), jax.random.key(seed)
    algorithm = Offline(demonstrations(env, key), LEARNER, batch_size=1000, updates=10)
    state, _ = run(algorithm, key, 30)
    held_out = demonstrations(env, jax.random.fold_in(key, 1))
    batch = Batch(held_out.transitions, jnp.arange(held_out.num_steps), jnp.ones(held_out.num_steps))
    loss = jax.jit(lambda learner: LEARNER.update(learner, batch, key)[1]["bc_loss"])(state.learner)
    return Cloned(float(loss), returned(env, algorithm.policy(state), key))


def ask(seed: int = 0, rounds: int = ROUNDS) -> Float[np.ndarray, "R"]:
    """DAgger with the light in view: return of the newest policy after each round, the first one that of the expert's own data."""
    key, env = jax.random.key(seed), vectorize(Braking(), 4)
    algorithm: Algorithm = DAgger(env, LEARNER, as_expert(brake, env_spec(env)), unroll=100, updates=100).with_horizon(
        rounds
    )
    step = jax.jit(lambda state, key: algorithm.step(state, key)[0])
    state, evaluate, found = jax.jit(lambda k: algorithm.init(k))(key), Evaluator(vectorize(Braking(), 100), 100), []
    for i in range(rounds):
        state = step(state, jax.random.fold_in(key, i))
        found.append(float(evaluate(LEARNER.policy(state.learner, False), key)[0].mean()))
    return np.array(found)


def intervene(seed: int = 0) -> tuple[Float[np.ndarray, "n"], float]:
    """Weights of the sensor and the light, found by acting; and the return with the graph that they choose."""
    key, env = jax.random.key(seed), Braking()
    data = with_random_graphs(demonstrations(env, key), SEEN, key)
    algorithm = Offline(data, BC(network=MLP(16), learning_rate=0.01), batch_size=1000, updates=10)
    policy = algorithm.policy(run(algorithm, key, 30)[0])
    choice = choose_graph_by_return(vectorize(env, 10), policy, SEEN, key)
    return choice.weights, returned(env, GraphPolicy(policy, jnp.asarray(choice.graph, float), SEEN), key)


def draw(seed: int = 0) -> Figure:
    """The figure."""
    figure = Figure(figsize=(12, 3.9), layout="constrained")
    losses, earned, cured = figure.subplots(1, 3, width_ratios=[1, 1, 1.3])
    plain, lit = clone(False, seed), clone(True, seed)
    _bars(losses, [plain.loss, lit.loss], "validation loss: lower with the light", "{:.3f}")
    _bars(earned, [plain.earned, lit.earned], "return: lower with the light", "{:.0f}")
    rounds = ask(seed)
    weights, graph = intervene(seed)
    cured.plot(np.arange(1, len(rounds) + 1), rounds, "o-", color=CURED, label="DAgger, light in view")
    cured.axhline(
        graph, color=PLAIN, label=f"graph chosen by return: sensor {weights[0]:+.1f}, light {weights[1]:+.1f}"
    )
    cured.axhline(lit.earned, color=LIT, label="BC, light in view")
    cured.axhline(BEST, color=INK, linewidth=0.8, linestyle="dashed", label="the expert")
    cured.set(xlabel="round", ylim=(0, 105))
    cured.set_title("return, of two cures", fontsize=11)
    cured.legend(frameon=False, fontsize=9, loc="lower right")
    for axis in (losses, earned, cured):
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def _bars(axis: Axes, values: list[float], title: str, text: str) -> None:
    bars = axis.bar([0, 1], values, color=[PLAIN, LIT], width=0.55)
    axis.bar_label(bars, [text.format(v) for v in values], padding=2, color=INK)
    axis.set_xticks([0, 1], ["without\nthe light", "with\nthe light"])
    axis.margins(y=0.15)
    axis.set_title(title, fontsize=11)
