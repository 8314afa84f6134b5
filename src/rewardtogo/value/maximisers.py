r"""The largest Q(s, a) over continuous actions: by samples, by ascent, by the cross-entropy method (notes 6.3.3).

    sampled   the best of K uniform actions (random shooting): in d dimensions the action is off by K^(-1/d) and the value by K^(-2/d)
    ascent    gradient steps, or Newton's, from several uniform starts, inside the bounds
    CEM       a Gaussian fitted again and again to the best of its own samples (Rubinstein 1999; Kalashnikov et al. 2018, QT-Opt)

Each is a function of the function to maximise (of one action), the bounds and a key, and each has a recipe that a learner takes
(`Sampled`, `Ascent`, `CEM`), in which actions are in units of the box, -1 to 1.

Source: notes 6.3.3 (the first of its options). The notes leave step sizes, restarts and elites open; ascent here keeps a step that went
up and doubles the next one, and undoes one that went down and halves it: no step size to choose, and no end below its start.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Configured, PRNGKey, setting
from ..ops.linalg import conjugate_gradients

Value = Callable[[Float[Array, "*A"]], Float[Array, ""]]
"""What is maximised: a function of one action."""


class Maximum(eqx.Module):
    """The best action that was found, and its value."""

    action: Float[Array, "*A"]
    value: Float[Array, ""]


def _best(actions: Float[Array, "N *A"], values: Float[Array, "N"]) -> Maximum:
    best = jnp.argmax(values)
    return Maximum(actions[best], values[best])


def _uniform(key: PRNGKey, low: Float[Array, "*A"], high: Float[Array, "*A"], number: int) -> Float[Array, "N *A"]:
    return low[None] + (high - low)[None] * jax.random.uniform(key, (number, *low.shape), low.dtype)


def sampled_maximum(
    value: Value, low: Float[Array, "*A"], high: Float[Array, "*A"], key: PRNGKey, samples: int = 64
) -> Maximum:
    """The best of `samples` uniformly random actions (item 6.21)."""
    actions = _uniform(key, low, high, samples)
    return _best(actions, jax.vmap(value)(actions))


def ascended_maximum(
    value: Value,
    low: Float[Array, "*A"],
    high: Float[Array, "*A"],
    key: PRNGKey,
    starts: int = 8,
    steps: int = 20,
    newton: bool = False,
) -> Maximum:
    """The best end of `steps` steps up the gradient from each of `starts` uniformly random actions (item 6.22).

    Steps are in units of half the box and end at its faces. With `newton` a step solves (damping I - H) p = g, entries held at a face left
    out, by as many conjugate gradients as there are entries, and the damping falls after a step up and rises after one down. Where the
    curvature has the wrong sign, conjugate gradients stop at the gradient.
    """
    half = 0.5 * (high - low)
    place = lambda u: low + half * (u + 1.0)  # noqa: E731
    f = lambda u: value(place(u))  # noqa: E731
    climb = jax.value_and_grad(f)

    def direction(u: Array, g: Array, size: Array) -> Array:
        held = ((u <= -1.0) & (g < 0)) | ((u >= 1.0) & (g > 0))
        free = jnp.where(held, 0.0, g)
        if not newton:
            return size * free
        product = lambda v: jax.jvp(jax.grad(f), (u,), (jnp.where(held, 0.0, v),))[1]  # noqa: E731
        multiply = lambda v: v / size - jnp.where(held, 0.0, product(v))  # noqa: E731
        step, _ = conjugate_gradients(multiply, free, max(1, u.size))
        return jnp.where(jnp.any(step != 0), step, size * free)

    def step(loop: tuple[Array, Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array, Array], None]:
        u, height, gradient, size = loop
        tried = jnp.clip(u + direction(u, gradient, size), -1.0, 1.0)
        new_height, new_gradient = climb(tried)
        up = new_height >= height
        growth = (10.0, 0.1) if newton else (2.0, 0.5)
        size = size * jnp.where(up, growth[0], growth[1])
        keep = lambda new, old: jnp.where(up, new, old)  # noqa: E731
        return (keep(tried, u), keep(new_height, height), keep(new_gradient, gradient), size), None

    def one(u: Array) -> tuple[Array, Array]:
        height, gradient = climb(u)
        # The first step goes a tenth of the box, however steep the function is.
        size = 0.2 / jnp.maximum(jnp.linalg.norm(gradient), 1e-12)
        (u, height, _, _), _ = jax.lax.scan(step, (u, height, gradient, size), None, length=steps)
        return u, height

    first = _uniform(key, -jnp.ones_like(low), jnp.ones_like(low), starts)
    ends, heights = jax.vmap(one)(first)
    best = _best(ends, heights)
    return Maximum(place(best.action), best.value)


def cem_maximum(
    value: Value,
    low: Float[Array, "*A"],
    high: Float[Array, "*A"],
    key: PRNGKey,
    iterations: int = 5,
    samples: int = 64,
    elites: int = 6,
) -> Maximum:
    """The best action that the cross-entropy method saw (item 6.23).

    The first samples are uniform; then a Gaussian has the mean and the standard deviation, entry by entry, of the `elites` best of the
    last `samples`. Samples are clipped to the bounds.
    """
    first_key, rest_key = jax.random.split(key)

    def refit(actions: Array, values: Array) -> tuple[Array, Array, Maximum]:
        _, places = jax.lax.top_k(values, elites)
        chosen = actions[places]
        return chosen.mean(0), chosen.std(0), Maximum(chosen[0], values[places[0]])

    def iterate(loop: tuple[Array, Array, Maximum], noise: Array) -> tuple[tuple[Array, Array, Maximum], None]:
        mean, sd, best = loop
        actions = jnp.clip(mean[None] + sd[None] * noise, low[None], high[None])
        mean, sd, found = refit(actions, jax.vmap(value)(actions))
        better = found.value > best.value
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), found, best)
        return (mean, sd, best), None

    actions = _uniform(first_key, low, high, samples)
    loop = refit(actions, jax.vmap(value)(actions))
    noise = jax.random.normal(rest_key, (iterations - 1, samples, *low.shape), low.dtype)
    (_, _, best), _ = jax.lax.scan(iterate, loop, noise)
    return best


class Maximiser(Configured):
    """A recipe for the maximum over actions in units of a box of some shape."""

    @abstractmethod
    def __call__(self, value: Value, shape: tuple[int, ...], key: PRNGKey) -> Maximum:
        """The best action between -1 and 1 in each entry, and its value."""


def as_maximiser(maximiser: Any) -> Maximiser:
    """What was given, if it is a maximiser. Raises `ValueError` otherwise."""
    if not isinstance(maximiser, Maximiser):
        raise ValueError(
            f"a maximiser is rtg.Sampled(), rtg.Ascent() or rtg.CEM(), or sampled, ascent or cem by name, not {maximiser!r}"
        )
    return maximiser


class Sampled(Maximiser):
    """Random shooting."""

    samples: int = setting(64, "uniformly random actions", at_least=1)

    def __call__(self, value: Value, shape: tuple[int, ...], key: PRNGKey) -> Maximum:
        return sampled_maximum(value, -jnp.ones(shape), jnp.ones(shape), key, self.samples)


class Ascent(Maximiser):
    """Gradient ascent from several starts, or Newton's method."""

    starts: int = setting(4, "uniformly random actions to start from", at_least=1)
    steps: int = setting(8, "steps from each", at_least=1)
    newton: bool = setting(False, "use second derivatives; of use with smooth activations such as tanh")

    def __call__(self, value: Value, shape: tuple[int, ...], key: PRNGKey) -> Maximum:
        return ascended_maximum(value, -jnp.ones(shape), jnp.ones(shape), key, self.starts, self.steps, self.newton)


class CEM(Maximiser):
    """The cross-entropy method."""

    iterations: int = setting(3, "generations of samples", at_least=1)
    samples: int = setting(32, "actions in a generation", at_least=1)
    elites: int = setting(4, "the best ones, that the next generation is like", at_least=1)

    def __check_init__(self) -> None:
        if self.elites > self.samples:
            raise ValueError(
                f"CEM cannot choose {self.elites} elites among {self.samples} samples: give it more samples or fewer elites"
            )

    def __call__(self, value: Value, shape: tuple[int, ...], key: PRNGKey) -> Maximum:
        return cem_maximum(value, -jnp.ones(shape), jnp.ones(shape), key, self.iterations, self.samples, self.elites)
