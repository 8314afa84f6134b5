"""A stack of k observations of a process of order k is Markov again."""

from typing import Any

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np

from rewardtogo.core import Environment, Timestep
from rewardtogo.envs import FrameStack
from rewardtogo.exact import markov_test


class SecondOrder(Environment):
    """A bit that is likely to be the exclusive or of the last two, or of their opposite where the action is 1."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        bits = jax.random.bernoulli(key, 0.5, (2,)).astype(jnp.int32)
        return bits, bits[1:].astype(jnp.float32)

    def step(self, state: Any, action: Any, key: jax.Array) -> tuple[Any, Timestep]:
        usual = state[0] ^ state[1] ^ action
        bit = jnp.where(jax.random.bernoulli(key, 0.8), usual, 1 - usual)
        no, seen = jnp.zeros((), bool), bit[None].astype(jnp.float32)
        return jnp.stack([state[1], bit]), Timestep(seen, jnp.zeros(()), no, no, seen, {})


def test_a_stack_restores_the_markov_property(item):
    def play(size: int) -> tuple[np.ndarray, np.ndarray]:
        env = FrameStack(SecondOrder(), size)

        def episode(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            reset_key, action_key, step_key = jax.random.split(key, 3)
            state, first = env.reset(reset_key)
            actions = jax.random.bernoulli(action_key, 0.5, (30,)).astype(jnp.int32)

            def step(state: Any, given: Any) -> tuple[Any, jax.Array]:
                state, timestep = env.step(state, *given)
                return state, timestep.observation

            seen = jax.lax.scan(step, state, (actions, jax.random.split(step_key, 30)))[1]
            return jnp.concatenate([first[None], seen]), actions

        seen, actions = jax.device_get(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(size), 400)))
        # What is shown, as one number. A stack is filled with real observations from its second on.
        return (seen.astype(int) @ (2 ** np.arange(size)))[:, 2:], actions[:, 2:]

    with item("1.24") as check:
        check(markov_test(*play(1)).p_value, "<", 1e-6, "p of one observation of a process of order 2")
        check(markov_test(*play(2)).p_value, ">", 0.01, "p of a stack of two")
