r"""Figure 8.3: the graphical model with latent states, its edges read from the networks that `latent_mbrl` plans in.

Whether a quantity depends on another is asked of the functions themselves: an edge is drawn where a derivative of a conditional mean is not
zero, p(s' | s, a), p(r | s, a) and p(o | s). Dashed is the encoder's q(s | o), which is no part of the model.

Source: notes 8.3.4 (item 8.64).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ..core import EnvSpec, env_spec
from ..envs.pendulum import Pendulum
from ..envs.vectorize import vectorize
from ..model_based.latent import LatentMBRL, LatentNetworks, followed

INK, SHADE, DASHED = "#333333", "#d9e8f5", "#d55e00"
Edges = set[tuple[str, str]]
"""Pairs (from, to) of s, a, s', o, r."""


def factorisation(networks: LatentNetworks, action_size: int, key: jax.Array) -> tuple[Edges, Edges]:
    """The edges of the generative model and of the encoder."""
    size = networks.decoder.layers[0].weight.shape[1]
    seen = networks.encoder.layers[0].weight.shape[1]
    keys = jax.random.split(key, 3)
    s, a, o = (jax.random.normal(k, (n,)) for k, n in zip(keys, (size, action_size, seen), strict=True))
    slopes, read = _slopes(networks, s, a, o)
    model = {(parent, name) for name, pair in slopes.items() for parent, slope in pair.items() if _moves(slope)}
    return model, {("o", "s")} if _moves(read) else set()


@jax.jit
def _slopes(
    networks: LatentNetworks, s: Float[Array, "L"], a: Float[Array, "A"], o: Float[Array, "O"]
) -> tuple[dict[str, dict[str, Array]], Float[Array, "L O"]]:
    """Derivatives of the mean of each of s', r and o with respect to s and a, and of the encoding with respect to o."""
    means = {
        "s'": lambda s, a: followed(networks, s, a)[0],
        "r": lambda s, a: followed(networks, s, a)[1][0],
        "o": lambda s, a: networks.decoder(s),
    }
    slopes = {name: dict(zip("sa", jax.jacobian(mean, (0, 1))(s, a), strict=True)) for name, mean in means.items()}
    return slopes, jax.jacobian(networks.encoder)(o)


def _moves(slope: Array) -> bool:
    return bool(jnp.any(slope != 0.0))


def made(seed: int) -> tuple[LatentNetworks, int]:
    """Networks as the learner makes them for a pendulum, and how many numbers an action is."""
    spec: EnvSpec = env_spec(vectorize(Pendulum(), 1))
    learner = LatentMBRL(encoder_sizes=(16,), sizes=(16,))
    networks = jax.jit(lambda key: learner.init(spec, key).networks)(jax.random.key(seed))
    return networks, spec.action.size


def draw(seed: int = 0, networks: LatentNetworks | None = None) -> Figure:
    """The figure, of other networks (with actions of one number) where they are given."""
    fresh, actions = made(seed)
    model, encoder = factorisation(fresh if networks is None else networks, actions, jax.random.key(seed))
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    axis = figure.subplots()
    _draw_edges(axis, model, encoder)
    names = {"s": "s", "a": "a", "o": "o", "r": "r"}
    for t, label in enumerate(("t", "t+1", "t+2")):
        for name, symbol in names.items():
            if name in ("a", "r") and t == 2:
                continue
            x, y = _place(name, t)
            axis.add_patch(
                Circle((x, y), 0.36, facecolor="white" if name == "s" else SHADE, edgecolor=INK, linewidth=1.5)
            )
            axis.text(x, y, f"${symbol}_{{{label}}}$", ha="center", va="center", fontsize=13, color=INK)
    axis.text(
        7.6, 1.0,
        "blue: seen\nwhite: latent\n\n$p(s_{t+1} \\mid s_t, a_t)$\n$p(r_t \\mid s_t, a_t)$\n$p(o_t \\mid s_t)$",
        fontsize=11, color=INK, va="center",
    )  # fmt: skip
    axis.text(7.6, -0.75, "dashed: encoder $q(s_t \\mid o_t)$", fontsize=11, color=DASHED, va="center")
    axis.set(xlim=(-0.6, 10.2), ylim=(-1.6, 3.4), aspect="equal")
    axis.axis("off")
    return figure


def _place(name: str, t: int) -> tuple[float, float]:
    dx, y = {"s": (0.0, 1.0), "a": (1.0, 2.4), "o": (0.0, -0.9), "r": (1.35, -0.4)}[name]
    return 3.0 * t + dx, y


def _draw_edges(axis: Axes, model: Edges, encoder: Edges) -> None:
    for t in range(3):
        for source, target in sorted(model):
            if t == 2 and ("a" in (source, target) or target in ("s'", "r")):
                continue
            start = _place(source, t)
            end = _place("s", t + 1) if target == "s'" else _place(target, t)
            _arrow(axis, start, end, INK, "-", 0.0)
        for source, target in sorted(encoder):
            _arrow(axis, _place(source, t), _place(target, t), DASHED, "--", -0.45)


def _arrow(
    axis: Axes, start: tuple[float, float], end: tuple[float, float], colour: str, line: str, bend: float
) -> None:
    axis.annotate(
        "", end, start,
        arrowprops={
            "arrowstyle": "-|>", "color": colour, "linestyle": line, "linewidth": 1.6, "shrinkA": 21, "shrinkB": 21,
            "connectionstyle": f"arc3,rad={bend}",
        },
    )  # fmt: skip
