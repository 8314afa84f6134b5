r"""Are values true? What a policy thinks that states are worth, against what it then earns from them (notes 6.3; van Hasselt et al. 2016).

A greedy policy plays, and from every state that it comes to

$$\text{estimated} = \max_a Q(s_t, a), \qquad \text{true} = \sum_{k \ge 0} \gamma^k r_{t+k},$$

both averaged over the same states. The maximum of noisy estimates is too large on average, and bootstrapping feeds on it. Where a time
limit cuts an episode the sum is unfinished; states count only if what is missing weighs less than `tolerance` (gamma to the power of
the steps left), so no estimate enters the truth.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from ..core import Action, Carry, Observation, Policy, PRNGKey, Transition, VectorEnv
from ..loops.collect import begin, collect
from ..ops.returns import backward

VALUE = "value"


class ValueCheck(eqx.Module):
    """Mean estimated and mean true value over `states` states; with none both are not a number."""

    estimated: Float[Array, ""]
    true: Float[Array, ""]
    states: Float[Array, ""]

    @property
    def excess(self) -> Float[Array, ""]:
        """How much is over-estimated, in units of return."""
        return self.estimated - self.true


class Thinking(Policy):
    """Another policy's actions, and what it thinks of each observation, `inspect`'s `value`, kept as `extras["value"]`."""

    policy: Policy

    def init(self, key: PRNGKey) -> Carry:
        return self.policy.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        thoughts = self.policy.inspect(carry, observation)
        if VALUE not in thoughts:
            raise ValueError(
                f"a {type(self.policy).__name__} says no value of what it sees, so there is none to check: use a policy of a learner "
                "that learns values, such as DQN"
            )
        carry, action, _ = self.policy(carry, observation, key)
        return carry, action, {VALUE: thoughts[VALUE]}

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.policy.inspect(carry, observation)


def check_values(
    env: VectorEnv, policy: Policy, key: PRNGKey, *, gamma: ScalarLike, steps: int, tolerance: float = 0.01
) -> ValueCheck:
    """Play `steps` steps in each environment, and compare the values that the policy says with the returns that follow."""
    begin_key, play_key = jax.random.split(key)
    thinking = Thinking(policy)
    _, rollout, _ = collect(env, thinking, begin(env, thinking, begin_key), play_key, steps)
    return compare(rollout.transitions, gamma, tolerance)


def compare(t: Transition, gamma: ScalarLike, tolerance: float = 0.01) -> ValueCheck:
    """The same for steps `[T, B]` whose `extras["value"]` says what was thought of each observation."""
    discount = (1.0 - t.terminated) * gamma
    returns, missing = jax.vmap(known_returns, 1, 1)(t.reward, discount, t.done)
    counts = (missing <= tolerance).astype(jnp.float32)
    states = counts.sum()
    mean = lambda x: (x * counts).sum() / states  # noqa: E731
    return ValueCheck(mean(t.extras[VALUE]), mean(returns), states)


def known_returns(
    r_t: Float[Array, "T"], discount_t: Float[Array, "T"], cut_t: Array
) -> tuple[Float[Array, "T"], Float[Array, "T"]]:
    """Reward sums up to each cut or the end of the data, and the discount of what lies beyond: 0 after a terminal state."""
    ends = cut_t.at[-1].set(True)
    through = jnp.where(ends, 0.0, discount_t)
    return backward(r_t, through), backward(jnp.where(ends, discount_t, 0.0), through)
