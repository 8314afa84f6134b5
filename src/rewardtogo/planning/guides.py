r"""What the search believes of a state that it sees for the first time: the default policy of the notes, or a network.

    Rollouts   V(s) ~ sum_t gamma^t r_t of one simulation by a random or a given policy     (notes, section 8.2.3; item 8.20)
    Guided     (p, v) = f(o), a prior over actions and a value, learned                    (Silver et al. 2018)

Both count values as the first player does.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from ..core import Action, Choices, PRNGKey, State
from .problem import as_module


class Belief(eqx.Module):
    """Of one state: the return from it on, as the first player counts, a prior over the actions, and whether the return was cut short."""

    value: Float[Array, ""]
    prior: Float[Array, "A"]
    cut: Bool[Array, ""]


class Guide(eqx.Module):
    """Evaluates states."""

    @abstractmethod
    def __call__(
        self, model: Choices, state: State, legal: Bool[Array, "A"], discount: ScalarLike, key: PRNGKey
    ) -> Belief:
        """What to believe of a state that is no end, in which the actions `legal` are allowed."""


class Rollouts(Guide):
    """The default policy: play on to the end, or for `horizon` steps, and count the discounted rewards; all actions are equally likely.

    - `policy`: (state, legal, key) -> action; uniformly random where it is left out.
    - `horizon`: a rollout is cut after so many steps, and counts what it has. A game that never ends is thus searched as if it ended;
      `Solution.stats["cut"]` says of how many rollouts that is true.
    """

    policy: Callable | None = eqx.field(default=None, converter=as_module)
    horizon: int = eqx.field(default=100, static=True)

    def __check_init__(self) -> None:
        if isinstance(self.horizon, bool) or not isinstance(self.horizon, int) or self.horizon < 1:
            raise ValueError(
                f"a rollout must be cut somewhere, because a game may never end: give a horizon of at least 1 step, not {self.horizon}"
            )

    def __call__(
        self, model: Choices, state: State, legal: Bool[Array, "A"], discount: ScalarLike, key: PRNGKey
    ) -> Belief:
        value, cut = self.play(model, state, discount, key)
        return Belief(value, legal / jnp.maximum(legal.sum(), 1), cut)

    def play(
        self, model: Choices, state: State, discount: ScalarLike, key: PRNGKey
    ) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """The return of one simulation, and whether it was cut."""
        luck_key, step_key = jax.random.split(key)
        luck = jax.random.uniform(luck_key, (self.horizon,))

        def going(now: _Playing) -> Bool[Array, ""]:
            return ~now.over & (now.t < self.horizon)

        def step(now: _Playing) -> _Playing:
            legal = model.legal(now.state)
            act_key, move_key = jax.random.split(jax.random.fold_in(step_key, now.t))
            if self.policy is None:
                action = pick(legal, luck[now.t])
            else:
                action = self.policy(now.state, legal, act_key)
            following = model.transition(now.state, action, move_key)
            value = now.value + now.weight * model.reward(now.state, action, following)
            return _Playing(following, is_over(model, following), now.t + 1, value, now.weight * discount)

        begin = _Playing(state, is_over(model, state), jnp.zeros((), jnp.int32), jnp.zeros(()), jnp.ones(()))
        last = jax.lax.while_loop(going, step, begin)
        return last.value, ~last.over


class _Playing(eqx.Module):
    state: State
    over: Bool[Array, ""]
    t: Int[Array, ""]
    value: Float[Array, ""]
    weight: Float[Array, ""]


class Guided(Guide):
    """A network's belief.

    - `network`: observation -> (logits `[A]`, value); both from the side of the player who is to move.
    """

    network: Callable = eqx.field(converter=as_module)

    def __call__(
        self, model: Choices, state: State, legal: Bool[Array, "A"], discount: ScalarLike, key: PRNGKey
    ) -> Belief:
        del discount, key
        logits, value = self.network(model.observe(state))
        prior = jax.nn.softmax(jnp.where(legal, logits, -jnp.inf))
        return Belief(sign(model, state) * value, prior, jnp.zeros((), bool))


def is_over(model: Choices, state: State) -> Bool[Array, ""]:
    """Whether nothing more can happen: a terminal state, or one in which nothing is allowed."""
    return model.terminal(state) | ~model.legal(state).any()


def sign(model: Choices, state: State) -> Float[Array, ""]:
    """1 where the first player is to move, -1 where the second is: whose gain a return is."""
    return 1.0 - 2.0 * model.player(state)


def pick(legal: Bool[Array, "A"], uniform: Float[Array, ""]) -> Action:
    """An allowed action for a number in [0, 1), all equally likely."""
    rank = jnp.floor(uniform * legal.sum()).astype(jnp.int32)
    return jnp.argmax(jnp.cumsum(legal) > rank).astype(jnp.int32)
