r"""Several consecutive steps as one transition, for n-step targets (notes 6.3; Sutton 1988).

$$(s_t, a_t) \to \Big(\sum_{k<m} \gamma^k r_{t+k},\; s_{t+m}\Big), \qquad y = \text{return} + \text{discount} \cdot V(s_{t+m}),$$

with m = n, or fewer where the episode ended before: m counts the steps up to the first end. The discount is gamma^m, and
0 after a terminal state (erratum E1.5).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Transition
from ..ops.td import n_step_transition

DISCOUNT = "discount"
"""Name, in `Transition.extras`, of what the value of `next_observation` is multiplied by."""


def n_step(sequences: Transition, gamma: float | Float[Array, ""]) -> Transition:
    """Transitions `[N]` from sequences `[n, N]` of consecutive steps.

    Observation, action and extras are those of the first step, the reward is the n-step return, next observation and
    ends are those of the last step used. `extras["discount"]` is the product of the discounts.
    """

    def one(t: Transition) -> Transition:
        discount = gamma * (1.0 - t.terminated.astype(jnp.float32))
        total, product, last = n_step_transition(t.reward, discount, t.done)
        first = lambda tree: jax.tree.map(lambda x: x[0], tree)  # noqa: E731
        following = jax.tree.map(lambda x: x[last], t.next_observation)
        extras = {**first(t.extras), DISCOUNT: product}
        return Transition(
            first(t.observation), first(t.action), total, t.terminated[last], t.truncated[last], following, extras
        )

    return jax.vmap(one, in_axes=1)(sequences)


def n_step_windows(sequences: Transition, n: int, gamma: float | Float[Array, ""]) -> Transition:
    """`n_step` from every place of sequences `[T, N]` that has n steps before it ends: `[T - n + 1, N]`.

    Raises `ValueError` where the sequences are shorter than n.
    """
    starts = sequences.reward.shape[0] - n + 1
    if starts < 1:
        raise ValueError(
            f"targets of {n} steps need sequences of at least {n} steps, not {starts + n - 1}: give the loop length={n}"
        )
    window = lambda start: jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, n), sequences)  # noqa: E731
    return jax.vmap(lambda start: n_step(window(start), gamma))(jnp.arange(starts))
