r"""What Q(s, a) is regressed on: one step, n steps, or a whole sequence, and how actions of older policies are made up for (notes 6.3).

$$y_t = \sum_{k<n} \gamma^k r_{t+k} + \gamma^n Q_\text{target}(s_{t+n}, \arg\max_a Q(s_{t+n}, a))$$

(erratum E6.4) is valid for the greedy policy only if $a_{t+1}, \dots, a_{t+n-1}$ were greedy (erratum E6.5; $a_t$ may be anything).
`correction`:

- `none`: ignore it. Works well in practice; its fixed point is neither Q* nor that of the policy that acted.
- `adaptive`: stop before the first later action that is not greedy, so that n varies. The fixed point is Q*.
- `importance`: weight each error by $\prod_{k=1}^{n-1} \pi(a_{t+k}|s_{t+k}) / \mu(a_{t+k}|s_{t+k})$. The fixed point is Q*.

Or use sequences as a whole, with traces (`ops.retrace`): Retrace, tree backup or importance sampling.
"""

from typing import Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core import Number, Observation, Transition
from ..data.n_step import DISCOUNT
from ..ops.axes import over
from ..ops.retrace import Trace, retrace, trace_coefficients
from .outputs import Outputs
from .q_network import QNetwork, allowed_only, expected, greedy_probabilities

Correction = Literal["none", "adaptive", "importance"]
CORRECTIONS = ("none", "adaptive", "importance")


Parameters = TypeVar("Parameters")


class Seen(eqx.Module):
    """An observation, and what both networks say of it. Stands where a `Transition` has its observations."""

    observation: Observation
    online: Float[Array, "*N A M"]
    target: Float[Array, "*N A M"]


def look(network: QNetwork, target: QNetwork, t: Transition, burn_in: int = 0) -> Transition:
    """The same steps without the first `burn_in`, with `Seen` in place of observations.

    Raises `ValueError` where nothing is left.
    """
    if burn_in and t.reward.shape[0] <= burn_in:
        raise ValueError(
            f"burn_in={burn_in} leaves nothing to learn from of sequences of {t.reward.shape[0]} steps: give the loop a larger length"
        )
    online, online_ahead = network.along(t, burn_in)
    old, old_ahead = target.along(t, burn_in)
    t = jax.tree.map(lambda x: x[burn_in:], t) if burn_in else t
    here, ahead = Seen(t.observation, online, old), Seen(t.next_observation, online_ahead, old_ahead)
    return eqx.tree_at(lambda t: (t.observation, t.next_observation), t, (here, ahead))


def corrections(
    kind: Correction, q: Float[Array, "T N A"], observation: Observation, t: Transition
) -> tuple[Bool[Array, "T N"] | None, Float[Array, "T N"] | None]:
    """Where n steps must stop, and what weighs them: `stop` and `ratio` of `data.n_step`, for the greedy policy of `q`."""
    if kind == "none":
        return None, None
    if kind == "adaptive":
        strays = t.action != jnp.argmax(q, -1)
        return jnp.concatenate([strays[1:], jnp.zeros_like(strays[:1])]), None
    pi = at_action(greedy_probabilities(q, 0.0, observation), t.action)
    return None, pi / jnp.exp(behaviour(t))


def behaviour(t: Transition) -> Float[Array, "*N"]:
    """Log probabilities with which the actions were chosen. Raises `ValueError` where the data does not say."""
    if "log_prob" not in t.extras:
        raise ValueError(
            "importance ratios need the probability with which each action was chosen, and this data does not say it: "
            "use data of this library's own policies, kept in a replay, or traces='tree_backup', which needs none"
        )
    return t.extras["log_prob"]


def at_action(values: Float[Array, "*N A"], action: Array) -> Float[Array, "*N"]:
    """The entry of each action."""
    return jnp.take_along_axis(values, action[..., None], -1)[..., 0]


def outputs_at(values: Float[Array, "*N A M"], action: Array) -> Float[Array, "*N M"]:
    """The outputs of each action."""
    return jnp.take_along_axis(values, action[..., None, None], -2)[..., 0, :]


def bootstrapped(outputs: Outputs, t: Transition, gamma: Number, double: bool) -> Float[Array, "*N M"]:
    """Targets from where each step (or n of them, with their discount in `extras`) led to.

    The next action is the target network's best, or with `double` the online network's; the target network values it.
    """
    ahead = t.next_observation
    discount = t.extras.get(DISCOUNT, gamma * (1.0 - t.terminated))
    if outputs.size == 1 and not double:
        # A single output grows with its expectation: the best action's is the greatest, and need not be looked up.
        following = allowed_only(ahead.target[..., 0], ahead.observation).max(-1, keepdims=True)
    else:
        chooser = expected(outputs, ahead.online if double else ahead.target, ahead.observation)
        following = outputs_at(ahead.target, jnp.argmax(chooser, -1))
    return over(t.reward.ndim, outputs.target)(t.reward, discount, following)


def traced(
    outputs: Outputs, t: Transition, gamma: Number, double: bool, kind: Trace, decay: Number, epsilon: Number
) -> Float[Array, "T N M"]:
    """Targets from the rest of each sequence, of the epsilon-greedy policy of the target network (or with `double` the online one)."""
    here, ahead = t.observation, t.next_observation

    def policy(seen: Seen) -> Float[Array, "T N A"]:
        q = expected(outputs, seen.online if double else seen.target, seen.observation)
        return greedy_probabilities(q, epsilon, seen.observation)

    value = (policy(ahead) * expected(outputs, ahead.target, ahead.observation)).sum(-1)
    chosen = outputs.mean(outputs_at(here.target, t.action))
    pi = at_action(policy(here), t.action)
    mu = jnp.ones_like(pi) if kind == "tree_backup" else jnp.exp(behaviour(t))
    trace = trace_coefficients(kind, decay, pi, mu)
    y = jax.vmap(retrace, 1, 1)(t.reward, gamma * (1.0 - t.terminated), chosen, value, trace, t.done)
    # The sum is complete: with discount 0 nothing is added to it, and it comes out on the scale that is learned.
    return over(2, outputs.target)(y, jnp.zeros_like(y), ahead.target[..., 0, :])
