r"""How to act from Q-values: greedily, epsilon-greedily, or by Boltzmann's distribution, with schedules and action masks.

$$\pi(a \mid s) = \begin{cases} 1 - \epsilon + \epsilon / |A| & a = \arg\max_{a'} Q(s, a') \\ \epsilon / |A| & \text{else} \end{cases}
\qquad \pi(a \mid s) = \frac{\exp(Q(s, a) / T)}{\sum_{a'} \exp(Q(s, a') / T)}$$

At $\epsilon = 0$, and for $T \to 0$, both are the implicit greedy policy of 5.1. That policy as the notes print it gives probability 1
to *every* maximiser, which with ties is no distribution (erratum E5.1): ties go to the first of them, or are shared evenly. Advantages
would do in place of Q, for they differ by $V(s)$, which no choice depends on (item 5.2). Masked actions have probability 0.

An `Exploration` is a part of a learner: its numbers may be schedules, and `learner.at(updates)` fixes them. `probabilities` is what
corrections of off-policy data need; a call draws from it with one uniform number.

Source: notes 5.1 (implicit policy), 5.3.4 (online Q-iteration, items 5.19 and 5.20).
"""

from abc import abstractmethod

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from ..core import Configured, Number, PRNGKey, number, setting
from ..envs.tabular import draw
from ..ops.schedules import Linear

FIRST, UNIFORM = "first", "uniform"
TIES = (FIRST, UNIFORM)


def greedy_probabilities(
    q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None, ties: str = FIRST
) -> Float[Array, "A"]:
    """The implicit greedy policy of Q-values (or advantages): all on the first maximiser, or evenly on all of them.

    Raises `ValueError` for another way to break ties.
    """
    if ties not in TIES:
        raise ValueError(f"ties go to one of {', '.join(TIES)}, not to {ties!r}")
    q = q if mask is None else jnp.where(mask > 0, q, -jnp.inf)
    if ties == FIRST:
        return jax.nn.one_hot(jnp.argmax(q), q.shape[-1], dtype=q.dtype)
    best = (q == q.max()).astype(q.dtype)
    return best / best.sum()


def uniform_probabilities(q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None) -> Float[Array, "A"]:
    """All allowed actions alike."""
    allowed = jnp.ones_like(q) if mask is None else (mask > 0).astype(q.dtype)
    return allowed / allowed.sum()


class Exploration(Configured):
    """A law over actions made from their Q-values. One observation; masked actions (0 in `mask`) are never chosen."""

    @abstractmethod
    def probabilities(self, q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None) -> Float[Array, "A"]:
        """The probability of each action."""

    @abstractmethod
    def metrics(self) -> dict[str, Float[Array, ""]]:
        """What a learner reports of it: how much it explores now."""

    def __call__(self, q: Float[Array, "A"], key: PRNGKey, mask: Shaped[Array, "A"] | None = None) -> Int[Array, ""]:
        """An action drawn from `probabilities`."""
        return draw(jnp.cumsum(self.probabilities(q, mask)), jax.random.uniform(key, (), q.dtype))


class Greedy(Exploration):
    """The best action always."""

    ties: str = setting(FIRST, "where several actions are best: the first, or each alike", choices=TIES)

    def probabilities(self, q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None) -> Float[Array, "A"]:
        return greedy_probabilities(q, mask, self.ties)

    def metrics(self) -> dict[str, Float[Array, ""]]:
        return {}


class EpsilonGreedy(Exploration):
    """The best action, or with probability `epsilon` any allowed one (the best among them, which so has 1 - epsilon + epsilon / A)."""

    epsilon: Number = number(
        Linear(1.0, 0.05, fraction=0.2), "probability of a uniformly random action", at_least=0, at_most=1
    )
    ties: str = setting(FIRST, "where several actions are best: the first, or each alike", choices=TIES)

    def probabilities(self, q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None) -> Float[Array, "A"]:
        best, any_ = greedy_probabilities(q, mask, self.ties), uniform_probabilities(q, mask)
        return (1.0 - self.epsilon) * best + self.epsilon * any_

    def metrics(self) -> dict[str, Float[Array, ""]]:
        return {"epsilon": jnp.asarray(self.epsilon, jnp.float32)}


class Boltzmann(Exploration):
    """Probabilities proportional to exp(Q / `temperature`); at temperature 0 its limit, the best actions alike.

    Rewards have units and so has a temperature: differences of Q of some temperatures decide, those far below it do not.
    """

    temperature: Number = number(1.0, "T: differences of Q that matter; 0 is greedy", at_least=0)

    def probabilities(self, q: Float[Array, "A"], mask: Shaped[Array, "A"] | None = None) -> Float[Array, "A"]:
        q = q if mask is None else jnp.where(mask > 0, q, -jnp.inf)
        temperature = jnp.asarray(self.temperature, q.dtype)
        # The best action's exponent is exactly 0 whatever the temperature; without the floor a temperature of 0 would make it 0 / 0.
        warm = jax.nn.softmax((q - q.max()) / jnp.maximum(temperature, jnp.finfo(q.dtype).tiny))
        return jnp.where(temperature > 0, warm, greedy_probabilities(q, ties=UNIFORM))

    def metrics(self) -> dict[str, Float[Array, ""]]:
        return {"temperature": jnp.asarray(self.temperature, jnp.float32)}
