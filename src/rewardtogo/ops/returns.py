r"""Returns along one trajectory, time-major `[T]`.

$$G_t = r_t + \gamma_t G_{t+1}, \qquad G^{(n)}_t = \sum_{k<n} \gamma^k r_{t+k} + \gamma^n V(s_{t+n}), \qquad
G^\lambda_t = r_t + \gamma_t [(1 - \lambda) V(s_{t+1}) + \lambda G^\lambda_{t+1}].$$

Two flags, never mixed (erratum E1.5): `discount_t` is $\gamma (1 - \text{terminated}_t)$, so that nothing is added
after a terminal state; `cut_t` is terminated or truncated, after which the sum stops. A truncated step still adds
`discount_t * v_t`, where `v_t[t]` is the value of the observation that step t led to, before any reset.

Source: notes 3.7.1 (reward to go), 4.4.2 (Monte Carlo), 4.9 (n steps and lambda, errata E4.9 and E4.10).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

UNROLL = 4
"""Steps per iteration of a scan: on CPU as fast as 1 (T = 128), where 8 is slower; on a GPU fewer launches."""


def backward(add_t: Float[Array, "T"], factor_t: Float[Array, "T"], last: ScalarLike = 0.0) -> Float[Array, "T"]:
    """Solve x_t = add_t + factor_t * x_{t+1} from the end, with x_T = `last`."""

    def body(after: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        add, factor = step
        now = add + factor * after
        return now, now

    return jax.lax.scan(body, jnp.asarray(last, add_t.dtype), (add_t, factor_t), reverse=True, unroll=UNROLL)[1]


def total_return(reward: Float[Array, "T"], gamma: ScalarLike) -> Float[Array, ""]:
    """The return of the whole trajectory, the sum of gamma^t r_t."""
    return backward(reward, jnp.full(reward.shape, gamma, reward.dtype))[0]


def reward_to_go(
    r_t: Float[Array, "T"], discount_t: Float[Array, "T"], final_value: ScalarLike = 0.0
) -> Float[Array, "T"]:
    """G_t = r_t + discount_t G_{t+1}, with G_T = `final_value`: the value of the last observation, 0 if it is terminal.

    For a trajectory that is also truncated in the middle use `lambda_returns` with lambda 1.
    """
    return backward(r_t, discount_t, final_value)


def lambda_returns(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_t: Float[Array, "T"],
    lambda_: ScalarLike,
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """The lambda-weighted mean of all n-step returns; lambda 0 looks one step ahead, lambda 1 is Monte Carlo."""
    trace_t = jnp.where(cut_t, 0.0, jnp.asarray(lambda_, r_t.dtype))
    return backward(r_t + discount_t * (1.0 - trace_t) * v_t, discount_t * trace_t, v_t[-1])


def n_step_returns(
    r_t: Float[Array, "T"],
    discount_t: Float[Array, "T"],
    v_t: Float[Array, "T"],
    n: int,
    cut_t: Bool[Array, "T"],
) -> Float[Array, "T"]:
    """Rewards of n steps and then the value of where they led; fewer steps where the trajectory is cut or ends."""
    if n < 1:
        raise ValueError(f"a return of {n} steps has no reward in it: give n of at least 1")
    ends_t = cut_t.at[-1].set(True)

    def longer(shorter: Array, _: None) -> tuple[Array, None]:
        return r_t + discount_t * jnp.where(ends_t, v_t, jnp.roll(shorter, -1)), None

    more = min(n, r_t.shape[0]) - 1
    return jax.lax.scan(longer, r_t + discount_t * v_t, None, length=more, unroll=max(1, min(more, UNROLL)))[0]
