r"""Noise on the actions of a deterministic policy, so that it sees what other actions do (notes 6.3.3, Algorithm 14 step 2).

    Gaussian              x_t ~ N(0, sd^2), independent from step to step
    Ornstein-Uhlenbeck    x_{t+1} = x_t - theta x_t dt + sigma sqrt(dt) xi_t,    xi_t ~ N(0, 1)

The second is a first-order autoregression (an Euler step of dx = -theta x dt + sigma dW): neighbouring steps have the correlation
1 - theta dt, and in the long run its standard deviation is

$$\frac{\sigma \sqrt{dt}}{\sqrt{1 - (1 - \theta\, dt)^2}},$$

which is 0.3797 at theta = 0.15, sigma = 0.2, dt = 1 and not sigma. It pushes in one direction for about 1 / (theta dt) steps, which is what
an under-powered system needs to get anywhere. It starts at 0 in each episode, and is part of the policy's memory.

All noise is in units of half the width of the action's box, and what is executed (and learnt from) is clipped into the box.

Source: notes 6.3.3; Uhlenbeck and Ornstein 1930; Lillicrap et al. 2016; Fujimoto et al. 2018 (Gaussian noise does as well there).
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core import Action, Carry, Configured, Number, Observation, Policy, PRNGKey, Schedule, Spec, number
from ..nn.heads import half_width


class Noise(Configured):
    """A random process with the shape of an action."""

    @abstractmethod
    def init(self, shape: tuple[int, ...]) -> Carry:
        """Its state at the start of an episode."""

    @abstractmethod
    def __call__(self, state: Carry, shape: tuple[int, ...], key: PRNGKey) -> tuple[Carry, Float[Array, "..."]]:
        """Its state after a step, and the noise of that step."""


class Gaussian(Noise):
    """Independent from step to step. 0 is no noise at all: then nothing but the warm-up explores."""

    sd: Number = number(0.1, "standard deviation, in units of half the box", at_least=0)

    def init(self, shape: tuple[int, ...]) -> Carry:
        del shape
        return ()

    def __call__(self, state: Carry, shape: tuple[int, ...], key: PRNGKey) -> tuple[Carry, Float[Array, "..."]]:
        return state, self.sd * jax.random.normal(key, shape)


class OU(Noise):
    """Ornstein-Uhlenbeck: it wanders around 0, and keeps its direction for a while."""

    sigma: Number = number(0.2, "how hard it is shaken, in units of half the box", at_least=0)
    theta: Number = number(0.15, "how fast it comes back to 0", above=0)
    dt: Number = number(1.0, "time from step to step; theta dt must be below 2", above=0)

    def __check_init__(self) -> None:
        pull = [float(np.max(x)) for x in (self.theta, self.dt) if not isinstance(x, (Tracer, Schedule))]
        if len(pull) == 2 and pull[0] * pull[1] >= 2:
            raise ValueError(
                f"OU noise with theta={pull[0]:g} and dt={pull[1]:g} grows without end: give them a product below 2"
            )

    def init(self, shape: tuple[int, ...]) -> Carry:
        return jnp.zeros(shape)

    def __call__(self, state: Carry, shape: tuple[int, ...], key: PRNGKey) -> tuple[Carry, Float[Array, "..."]]:
        shaken = self.sigma * jnp.sqrt(self.dt) * jax.random.normal(key, shape)
        state = state - self.theta * self.dt * state + shaken
        return state, state

    def stationary_sd(self) -> Float[Array, ""]:
        """Its standard deviation in the long run, the root of Var = (1 - theta dt)^2 Var + sigma^2 dt."""
        return self.sigma * jnp.sqrt(self.dt) / jnp.sqrt(1.0 - (1.0 - self.theta * self.dt) ** 2)


def as_noise(noise: Any) -> Noise:
    """What was given, if it is a noise. Raises `ValueError` otherwise."""
    if not isinstance(noise, Noise):
        raise ValueError(
            f"noise on actions is rtg.Gaussian(0.1) or rtg.OU(0.2), or gaussian or ou by name, not {noise!r}"
        )
    return noise


class NoisyMemory(eqx.Module):
    """What a policy remembers, and the state of the noise on its actions."""

    policy: Carry
    noise: Carry


class Noisy(Policy):
    """A policy with noise on its actions, clipped into the box."""

    policy: Policy
    noise: Noise
    spec: Spec = eqx.field(static=True)

    @staticmethod
    def of(policy: Policy, noise: Noise, spec: Spec) -> "Noisy":
        """The same, the noise's numbers as arrays, so that a policy's file has one type for them."""
        return Noisy(policy, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), noise), spec)

    def init(self, key: PRNGKey) -> Carry:
        return NoisyMemory(self.policy.init(key), self.noise.init(self.spec.shape))

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        policy_key, noise_key = jax.random.split(key)
        memory, action, extras = self.policy(carry.policy, observation, policy_key)
        state, noise = self.noise(carry.noise, self.spec.shape, noise_key)
        return NoisyMemory(memory, state), self.spec.clip(action + half_width(self.spec) * noise), extras

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.policy.inspect(carry.policy, observation)
