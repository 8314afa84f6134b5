r"""The family of policy-gradient estimators: what multiplies each score (notes 3.6-3.8, 4.2-4.9).

Every estimator here is

$$g = \text{mean}_{i,t}\; w_t\, \nabla \log \pi(a_t|s_t)\, (\hat R_t - b_t),$$

and differs from the others in three choices:

- $\hat R_t$, `returns`: `full`, all rewards of the trajectory (3.2); `reward_to_go` (3.7.1); `n_step` (4.9, erratum E4.9); `gae`, the
  lambda-return (erratum E4.10); `vtrace`, the lambda-return corrected for actions of an older policy, whose weight is also multiplied
  by min(1, pi / mu) (4.7).
- $b_t$, `baseline`: `none`; `mean` of the batch (biased by 1 - 1/N, erratum E3.5); `leave_one_out` (unbiased); `time_mean` (4.2);
  `value`, V(s_t); `optimal` and `optimal_per_parameter` (3.7.3, erratum E3.6).
- $w_t$, `discount_states`: 1, which is discount option 1, or $\gamma^t$, option 2, the gradient of the discounted objective (E4.5, E4.6).

`reward_to_go` is the lambda-return at lambda 1: a return that is cut, by a time limit or by the end of the rollout, goes on
with the value of where it was cut (erratum E1.5); where all values are 0 it simply stops. Arrays are time-major, `[T, B]`: T steps of
B environments, in which episodes end and begin anywhere. A *trajectory* is the part of an episode that lies in these T steps.
"""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core import Configured, Number, number, setting
from .returns import lambda_returns, n_step_returns
from .vtrace import vtrace

Returns = Literal["full", "reward_to_go", "n_step", "gae", "vtrace"]
Baseline = Literal["none", "mean", "leave_one_out", "time_mean", "value", "optimal", "optimal_per_parameter"]
RETURNS: tuple[str, ...] = get_args(Returns)
BASELINES: tuple[str, ...] = get_args(Baseline)


class Steps(eqx.Module):
    """What an estimator may look at, `[T, B]`.

    - `discount`: gamma (1 - terminated);
    - `cut`: terminated or truncated;
    - `value`, `next_value`: V of where the action was chosen and of where it led, before any reset;
    - `ratio`: pi / mu of the action, 1 where the policy that acted is the one that learns;
    - `elapsed` `[B]`: steps that the first trajectory of each environment had made before.
    """

    reward: Float[Array, "T B"]
    discount: Float[Array, "T B"]
    cut: Bool[Array, "T B"]
    value: Float[Array, "T B"]
    next_value: Float[Array, "T B"]
    ratio: Float[Array, "T B"]
    elapsed: Int[Array, "B"]

    @property
    def start(self) -> Int[Array, "T B"]:
        """The row in which the trajectory of each step begins."""
        rows = jnp.arange(len(self.reward))[:, None]
        begins = jnp.concatenate([jnp.ones_like(self.cut[:1]), self.cut[:-1]])
        return jax.lax.cummax(jnp.where(begins, rows, 0), axis=0)

    @property
    def time(self) -> Int[Array, "T B"]:
        """t: steps since the episode began."""
        start = self.start
        return jnp.arange(len(self.reward))[:, None] - start + jnp.where(start == 0, self.elapsed[None], 0)

    @property
    def trajectory(self) -> Int[Array, "T B"]:
        """A number for each trajectory, less than T B."""
        return self.start * self.reward.shape[1] + jnp.arange(self.reward.shape[1])[None]


class Estimator(Configured):
    """One member of the family: `Estimator("gae", "value", gae_lambda=0.95)`. A value, to train with or to ask for its exact variance."""

    returns: Returns = setting("reward_to_go", "rewards that are credited to an action", choices=RETURNS)
    baseline: Baseline = setting("value", "what is subtracted from them", choices=BASELINES)
    discount_states: bool = setting(False, "weigh step t by gamma^t: discount option 2")
    gamma: Number = number(0.99, "discount", at_least=0, at_most=1)
    gae_lambda: Number = number(
        0.95, "chance of looking one step further, for `gae` and `vtrace`", at_least=0, at_most=1
    )
    n_steps: int = setting(5, "rewards in a return, for `n_step`", at_least=1)

    def weights(self, steps: Steps) -> Float[Array, "T B"]:
        """What multiplies each score. Raises `ValueError` for the optimal baselines, which need the scores: `gradient`."""
        if self.baseline.startswith("optimal"):
            raise ValueError(
                f"the {self.baseline} baseline depends on the scores themselves: ask for `gradient`, not for weights"
            )
        returns = self.estimated_returns(steps)
        return self.state_weights(steps) * (returns - self._baseline(steps, returns))

    def gradient(self, steps: Steps, scores: Float[Array, "T B P"]) -> Float[Array, "P"]:
        """The estimate itself, from the score of every step: the mean over steps."""
        if not self.baseline.startswith("optimal"):
            return jnp.einsum("tb,tbp->p", self.weights(steps), scores) / steps.reward.size
        returns = self.estimated_returns(steps).reshape(-1)
        scores = (scores * self.state_weights(steps)[..., None]).reshape(len(returns), -1)
        if self.returns == "full":
            # One term a trajectory: the sum of its scores, and its return.
            rows = steps.trajectory.reshape(-1)
            scores = jax.ops.segment_sum(scores, rows, len(rows))
            returns = jax.ops.segment_max(returns, rows, len(rows))
            returns = jnp.where(jnp.isfinite(returns), returns, 0.0)
        b = optimal_baseline(scores, returns, per_parameter=self.baseline == "optimal_per_parameter")
        return (scores * (returns[:, None] - jnp.atleast_1d(b)[None])).sum(0) / steps.reward.size

    def estimated_returns(self, steps: Steps) -> Float[Array, "T B"]:
        """R_t, before a baseline."""
        s = steps
        if self.returns == "n_step":
            of = lambda r, d, v, c: n_step_returns(r, d, v, self.n_steps, c)  # noqa: E731
            return jax.vmap(of, 1, 1)(s.reward, s.discount, s.next_value, s.cut)
        if self.returns == "vtrace":
            return self.corrected(s)[1]
        lambda_ = self.gae_lambda if self.returns == "gae" else 1.0
        returns = jax.vmap(lambda r, d, v, c: lambda_returns(r, d, v, lambda_, c), 1, 1)(
            s.reward, s.discount, s.next_value, s.cut
        )
        return jnp.take_along_axis(returns, s.start, 0) if self.returns == "full" else returns

    def corrected(self, steps: Steps) -> tuple[Float[Array, "T B"], Float[Array, "T B"]]:
        """V-trace: targets for V, and the returns whose advantages the policy follows."""
        s = steps
        of = lambda r, d, v, n, p, c: vtrace(r, d, v, n, p, self.gae_lambda, c)  # noqa: E731
        return jax.vmap(of, 1, 1)(s.reward, s.discount, s.value, s.next_value, s.ratio, s.cut)

    def state_weights(self, steps: Steps) -> Float[Array, "T B"]:
        """w_t: 1 or gamma^t, times min(1, pi / mu) for `vtrace`."""
        weight = jnp.minimum(steps.ratio, 1.0) if self.returns == "vtrace" else jnp.ones_like(steps.reward)
        if not self.discount_states:
            return weight
        return weight * jnp.asarray(self.gamma, steps.reward.dtype) ** steps.time.astype(steps.reward.dtype)

    def _baseline(self, steps: Steps, returns: Float[Array, "T B"]) -> Array:
        if self.baseline == "none":
            return jnp.zeros(())
        if self.baseline == "value":
            return steps.value
        if self.baseline == "mean":
            return returns.mean()
        if self.baseline == "leave_one_out":
            return leave_one_out(returns, steps.trajectory)
        return _group_means(returns, steps.time - steps.time.min(), returns.size)


def leave_one_out(returns: Float[Array, "T B"], trajectory: Int[Array, "T B"]) -> Float[Array, "T B"]:
    """For each step the mean over the steps of all *other* trajectories (item 3.21); 0 where there is no other."""
    own, count = (
        jax.ops.segment_sum(x.reshape(-1), trajectory.reshape(-1), returns.size)[trajectory]
        for x in (returns, jnp.ones_like(returns))
    )
    others = returns.size - count
    return jnp.where(others > 0, (returns.sum() - own) / jnp.maximum(others, 1.0), 0.0)


def optimal_baseline(scores: Float[Array, "N P"], returns: Float[Array, "N"], *, per_parameter: bool) -> Array:
    """The b that minimises the variance of score * (return - b), estimated from a batch (item 3.24, erratum E3.6).

    E[|g|^2 R] / E[|g|^2]: one number, or one for each parameter `[P]`. Estimated from the batch that it is used on it biases again.
    """
    square = scores**2 if per_parameter else (scores**2).sum(-1, keepdims=True)
    total = square.sum(0)
    best = (square * returns[:, None]).sum(0) / jnp.where(total > 0, total, 1.0)
    return best if per_parameter else best[0]


def _group_means(values: Float[Array, "T B"], group: Int[Array, "T B"], groups: int) -> Float[Array, "T B"]:
    # Episodes may have begun long before: times beyond the last group share it.
    index = jnp.minimum(group, groups - 1)
    total, count = (
        jax.ops.segment_sum(x.reshape(-1), index.reshape(-1), groups) for x in (values, jnp.ones_like(values))
    )
    return (total / jnp.maximum(count, 1.0))[index]
