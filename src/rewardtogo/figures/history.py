"""Figure 2.2: a recurrent policy with one encoder for every step, what it learns that no memoryless policy can, and what history costs.

    o_1 -> encoder -> memory -> a_1,   o_2 -> the same encoder -> memory -> a_2,   ...

The expert of `LastTwo` answers the XOR of the last two observations. A network of o_t alone is right half of the
time; one of the last two, and one with a memory, are right always. A stack of k pictures has a first layer that grows
with k; a recurrent network is as large for any past.

Source: notes, section 2.3.1, figure 2.2, erratum E2.9 (items 2.12 to 2.15).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from ..core import PRNGKey, Transition, env_spec
from ..data.episodes import Dataset
from ..envs.imitation_problems import Lane, LastTwo, draw_road
from ..envs.vectorize import vectorize
from ..imitation import BC
from ..loops import RandomPolicy
from ..loops.offline import Offline
from ..nn import CNN, LSTM, MLP, Network, Stacked
from ..runner.collect import play
from ..runner.engine import run

EPISODES, LENGTH, ITERATIONS = 50, 20, 25
NETWORKS: dict[str, Network] = {
    "of the last observation": MLP(16),
    "of the last two": Stacked(2, MLP(16)),
    "LSTM": LSTM(16, MLP(8)),
}
PICTURES = CNN((16, 32), (4, 3), (2, 2), (64,))
"""The encoder whose size is counted."""
HISTORIES = 2 ** np.arange(10)
INK, COLOURS = "#333333", ("#d55e00", "#0072b2", "#009e73")


def demonstrations(key: PRNGKey) -> Dataset:
    """Right answers to episodes of random bits; nothing that is seen depends on what was answered."""
    env = vectorize(LastTwo(), EPISODES)
    t = play(env, RandomPolicy(env_spec(env)), EPISODES, key).transitions
    bit = np.asarray(t.observation)[:, 0].reshape(EPISODES, LENGTH)
    before = np.concatenate([bit[:, :1], bit[:, :-1]], 1)
    answer = jnp.asarray((bit != before).ravel().astype(np.int32))
    return Dataset.of(
        Transition(t.observation, answer, t.reward, t.terminated, t.truncated, t.next_observation, {}), env_spec(env)
    )


def accuracy(network: Network, seed: int = 0) -> Float[np.ndarray, "K"]:
    """Share of right answers in the data, by iteration of ten updates each.

    Of windows that begin anywhere: the first answer of one in mid-episode is a guess, for want of the observation before it.
    """
    key = jax.random.key(seed)
    learner = BC(network=network, learning_rate=0.02)
    steps = 32 * LENGTH  # of a batch, in windows or one by one
    algorithm = Offline(
        demonstrations(key),
        learner,
        batch_size=steps // (LENGTH if network.has_memory else 1),
        length=LENGTH,
        updates=10,
    )
    return np.asarray(run(algorithm, key, ITERATIONS, row_every=1)[1]["accuracy"], np.float64)


def parameters(network: Network) -> int:
    """Of the network, for the pictures of `Steering`."""
    spec = env_spec(Lane(picture=True)).observation
    return sum(x.size for x in jax.tree.leaves(jax.eval_shape(lambda k: network.build(spec, k), jax.random.key(0))))


def costs() -> tuple[Int[np.ndarray, "K"], int]:
    """Parameters of a stack of each of `HISTORIES` pictures, and of an LSTM for any of them."""
    return np.array([parameters(Stacked(int(k), PICTURES)) for k in HISTORIES]), parameters(LSTM(64, PICTURES))


def draw(seed: int = 0) -> Figure:
    """The figure."""
    figure = Figure(figsize=(13, 4), layout="constrained")
    network, learnt, size = figure.subplots(1, 3, width_ratios=[1.15, 1, 1])
    _draw_network(network)
    for (name, recipe), colour in zip(NETWORKS.items(), COLOURS, strict=True):
        dashes = "--" if recipe is NETWORKS["of the last two"] else "-"
        learnt.plot(
            10 * np.arange(1, ITERATIONS + 1),
            accuracy(recipe, seed),
            dashes,
            color=colour,
            label=name,
            zorder=2 + (dashes == "--"),
        )
    learnt.axhline(0.5, color=INK, linewidth=0.8, linestyle="dotted")
    learnt.set(xlabel="gradient steps", ylim=(0.4, 1.03))
    learnt.set_title("right answers, XOR of the last two", fontsize=11)
    stacks, lstm = costs()
    size.plot(HISTORIES, stacks / 1000, "o-", color=COLOURS[1], markersize=4, label="the last $k$ pictures, stacked")
    size.axhline(lstm / 1000, color=COLOURS[2], label="LSTM, the same encoder in every step")
    size.set(xlabel="$k$", xscale="log", ylim=(0, None))
    size.set_xticks(HISTORIES[::3], [str(k) for k in HISTORIES[::3]])
    size.minorticks_off()
    size.set_title("thousand parameters", fontsize=11)
    for axis in (learnt, size):
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=9)
    return figure


def _draw_network(axis: Axes) -> None:
    axis.set(xlim=(-0.6, 4.6), ylim=(-0.9, 4.4), aspect="equal")
    axis.axis("off")
    for t, (offset, direction) in enumerate(((0.5, -0.1), (0.35, -0.2), (0.1, -0.15), (0.0, 0.0))):
        x = 1.2 * t
        axis.imshow(draw_road(jnp.asarray(offset), jnp.asarray(direction))[..., 0], cmap="gray",
                    extent=(x - 0.45, x + 0.45, -0.7, 0.2), zorder=3)  # fmt: skip
        for y, text, colour in ((1.0, "conv", COLOURS[1]), (2.3, "LSTM", COLOURS[2])):
            axis.add_patch(FancyBboxPatch((x - 0.38, y - 0.22), 0.76, 0.44, "round,pad=0.03", facecolor="white",
                                          edgecolor=colour, linewidth=1.6, zorder=3))  # fmt: skip
            axis.text(x, y, text, ha="center", va="center", fontsize=8, color=colour, zorder=4)
        axis.text(x, 3.55, f"$a_{t}$", ha="center", fontsize=8, color=INK)
        for low, high in ((0.25, 0.72), (1.28, 2.02), (2.58, 3.4)):
            axis.annotate("", (x, high), (x, low), arrowprops={"arrowstyle": "->", "color": INK})
        if t:
            axis.annotate("", (x - 0.42, 2.3), (x - 0.78, 2.3), arrowprops={"arrowstyle": "->", "color": COLOURS[2]})
            axis.plot([x - 0.78, x - 0.42], [1.0, 1.0], color=COLOURS[1], linewidth=1, linestyle="dotted")
    axis.set_title("one encoder, whose weights all steps share", fontsize=11)
