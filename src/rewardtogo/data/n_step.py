r"""Several consecutive steps as one transition, for n-step targets (notes 6.3; Sutton 1988).

$$(s_t, a_t) \to \Big(\sum_{k<m} \gamma^k r_{t+k},\; s_{t+m}\Big), \qquad y = \text{return} + \text{discount} \cdot V(s_{t+m}),$$

with m = n, or fewer where the episode ended before: m counts the steps up to the first end. The discount is gamma^m, and
0 after a terminal state (erratum E1.5).

Off-policy, the actions after the first must be those of the policy whose value is meant (erratum E6.5). Steps may therefore be cut for
other reasons (`stop`), or be weighted by the ratio of the two policies' probabilities (`ratio`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Transition
from ..ops.td import n_step_transition

DISCOUNT = "discount"
"""Name, in `Transition.extras`, of what the value of `next_observation` is multiplied by."""
IMPORTANCE = "importance"
"""Name, in `Transition.extras`, of the product of the ratios of the steps used, the first one left out."""


def n_step(
    sequences: Transition,
    gamma: float | Float[Array, ""],
    stop: Bool[Array, "n N"] | None = None,
    ratio: Float[Array, "n N"] | None = None,
) -> Transition:
    """Transitions `[N]` from sequences `[n, N]` of consecutive steps.

    Observation, action and extras are those of the first step, the reward is the n-step return, next observation and
    ends are those of the last step used. `extras["discount"]` is the product of the discounts.

    - `stop`: steps after which to stop as if n were reached, although the episode goes on.
    - `ratio`: pi / mu of each action; their product over the steps used, without the first, becomes `extras["importance"]`.
    """

    def one(t: Transition, stop: Array | None, ratio: Array | None) -> Transition:
        discount = gamma * (1.0 - t.terminated.astype(t.reward.dtype))
        total, product, last = n_step_transition(t.reward, discount, t.done if stop is None else t.done | stop)
        first = lambda tree: jax.tree.map(lambda x: x[0], tree)  # noqa: E731
        following = jax.tree.map(lambda x: x[last], t.next_observation)
        extras = {**first(t.extras), DISCOUNT: product}
        if ratio is not None:
            place = jnp.arange(ratio.shape[0])
            extras[IMPORTANCE] = jnp.prod(jnp.where((place > 0) & (place <= last), ratio, 1.0))
        return Transition(
            first(t.observation), first(t.action), total, t.terminated[last], t.truncated[last], following, extras
        )

    return jax.vmap(one, in_axes=1)(sequences, stop, ratio)


def n_step_windows(
    sequences: Transition,
    n: int,
    gamma: float | Float[Array, ""],
    stop: Bool[Array, "T N"] | None = None,
    ratio: Float[Array, "T N"] | None = None,
) -> Transition:
    """`n_step` from every place of sequences `[T, N]` that has n steps before it ends: `[T - n + 1, N]`.

    Raises `ValueError` where the sequences are shorter than n.
    """
    starts = sequences.reward.shape[0] - n + 1
    if starts < 1:
        raise ValueError(
            f"targets of {n} steps need sequences of at least {n} steps, not {starts + n - 1}: give the loop length={n}"
        )
    window = lambda tree, start: jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, n), tree)  # noqa: E731
    whole = (sequences, stop, ratio)
    return jax.vmap(lambda start: n_step(window(whole[0], start), gamma, *window(whole[1:], start)))(jnp.arange(starts))
