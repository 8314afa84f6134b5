"""Figure 2.3: past a tree on the left or on the right, and what four laws of the action make of it.

The expert of `Drone` flies to either side of the tree, by a coin. BC with each head is fitted to its flights and
flies itself. The mean of a Gaussian is the mean of the two sides, which is the tree; a mixture, a network with a
hidden variable and one that chooses bins one after the other have both sides.

Source: notes, section 2.3.2, figure 2.3 (items 2.19 to 2.23). The problem is our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ..core import PRNGKey, Transition, env_spec
from ..data.episodes import Dataset
from ..envs.imitation_problems import WIDTH, Drone
from ..imitation import BC
from ..loops.offline import Offline
from ..nn import MLP, Autoregressive, HeadRecipe, Latent, Mixture, Standard
from ..ops.schedules import Linear
from ..runner.engine import run

FLIGHTS = 1000
"""Of the expert's, and of each copy."""
HEADS: dict[str, HeadRecipe] = {
    "a Gaussian": Standard(),
    "a mixture of Gaussians": Mixture(),
    "a hidden variable": Latent(1),
    "bins, one after the other": Autoregressive(),
}
INK, TREE, EXPERT, COPY = "#333333", "#b7d3b0", "#0072b2", "#d55e00"


class Flights(NamedTuple):
    """Where the tree is, and the headings that are flown there, `[N]`."""

    place: Float[np.ndarray, "N"]
    heading: Float[np.ndarray, "N"]

    @property
    def beside(self) -> Float[np.ndarray, "N"]:
        """By how much each passes the tree's middle, to the right."""
        return self.heading - self.place

    @property
    def collisions(self) -> float:
        """Share of the flights that end in the tree."""
        return float((np.abs(self.beside) < WIDTH).mean())


def demonstrations(key: PRNGKey) -> Dataset:
    """Flights of the expert's, of one step each."""
    env = Drone()

    @jax.jit
    def fly(key: Array) -> tuple[Array, Array]:
        reset_key, act_key = jax.random.split(key)
        _, observation = env.reset(reset_key)
        return observation, env.expert(observation, act_key)

    observation, action = jax.vmap(fly)(jax.random.split(key, FLIGHTS))
    end = jnp.ones(FLIGHTS, bool)
    return Dataset.of(Transition(observation, action, jnp.ones(FLIGHTS), end, ~end, observation, {}), env_spec(env))


def expert_flights(seed: int = 0) -> Flights:
    """Those that the copies learn from."""
    t = demonstrations(jax.random.key(seed)).transitions
    return Flights(np.asarray(t.observation[:, 0], np.float64), np.asarray(t.action[:, 0], np.float64))


def fly(head: HeadRecipe, seed: int = 0) -> Flights:
    """Learns from the expert's flights with this head, and flies past other trees by sampling."""
    key = jax.random.key(seed)
    latent = isinstance(head, Latent)
    learner = BC(network=MLP(32), head=head, learning_rate=Linear(0.03 if latent else 5e-3, 0.0))
    algorithm = Offline(demonstrations(key), learner, batch_size=256 if latent else 128, updates=20)
    policy = algorithm.policy(run(algorithm, key, 80 if latent else 40)[0], explore=True)
    reset_keys, act_keys = jax.random.split(jax.random.fold_in(key, 1), (2, FLIGHTS))
    place = jax.vmap(lambda k: Drone().reset(k)[1])(reset_keys)
    heading = jax.jit(jax.vmap(lambda o, k: jnp.clip(policy((), o, k)[1], -1.0, 1.0)))(place, act_keys)
    return Flights(np.asarray(place[:, 0], np.float64), np.asarray(heading[:, 0], np.float64))


def draw(seed: int = 0) -> Figure:
    """The figure."""
    figure = Figure(figsize=(12.5, 4.2), layout="constrained")
    panels = figure.subplot_mosaic([["expert", 0, 1], ["expert", 2, 3]], width_ratios=[1, 1, 1])  # type: ignore[list-item]
    _draw_flights(panels["expert"], expert_flights(seed))
    axes = [panels[i] for i in range(4)]  # type: ignore[index]
    for axis in axes[1:]:
        axis.sharex(axes[0])
        axis.sharey(axes[0])
    for axis, (name, head) in zip(axes, HEADS.items(), strict=True):
        found = fly(head, seed)
        axis.axvspan(-WIDTH, WIDTH, color=TREE, linewidth=0)
        axis.hist(found.beside, np.linspace(-1.3, 1.3, 53).tolist(), color=COPY)
        axis.set_title(f"{name}: {100 * found.collisions:.0f} % in the tree", fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[2:]:
        axis.set_xlabel("where it passes, from the tree's middle")
    return figure


def _draw_flights(axis: Axes, found: Flights) -> None:
    axis.add_patch(Circle((0, 1), WIDTH, color=TREE))
    for beside in found.beside[:60]:
        axis.plot([0, beside], [0, 1], color=EXPERT, linewidth=0.7, alpha=0.6)
        axis.plot([beside, 1.35 * beside], [1, 1.35], color=EXPERT, linewidth=0.7, alpha=0.6)
    mean = float(found.beside.mean())
    axis.annotate("", (0.72 * mean, 0.72), (0, 0), arrowprops={"arrowstyle": "->", "color": COPY, "linewidth": 2})
    axis.plot(0, 0, "o", color=INK, markersize=7)
    axis.set(xlim=(-1, 1), ylim=(-0.1, 1.4), aspect="equal")
    axis.set_title("the expert's flights, and their mean", fontsize=10)
    axis.axis("off")
