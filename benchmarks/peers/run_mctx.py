"""Searches of mctx in the positions of `search_task.py`; prints one JSON line."""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mctx

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1] / "src")]

import search_task as task  # noqa: E402


def main() -> None:
    """Compile, search, measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    key = jax.random.key(0)
    game, network, states = task.GAME, task.network(key), task.roots(key)

    def look(state):
        return network(game.observe(state))

    def recurrent(_, key, action, state):
        def one(state, action):
            following = game.transition(state, action, key)
            side = 1.0 - 2.0 * game.player(state)
            return following, side * game.reward(state, action, following), game.terminal(following)

        following, reward, over = jax.vmap(one)(state, action)
        logits, value = jax.vmap(look)(following)
        # Turns alternate: what is good for the next player is bad for this one.
        discount = jnp.where(over, 0.0, -1.0)
        value = jnp.where(over, 0.0, value)
        output = mctx.RecurrentFnOutput(reward=reward, discount=discount, prior_logits=logits, value=value)
        return output, following

    @jax.jit
    def search(states, key):
        logits, value = jax.vmap(look)(states)
        root = mctx.RootFnOutput(prior_logits=logits, value=value, embedding=states)
        forbidden = ~jax.vmap(game.legal)(states)
        found = mctx.muzero_policy((), key, root, recurrent, task.SIMULATIONS, invalid_actions=forbidden)
        return found.action, found.action_weights

    jax.block_until_ready(search(states, key))
    times = []
    for i in range(given.repeats):
        began = time.perf_counter()
        jax.block_until_ready(search(states, jax.random.key(i)))
        times.append(time.perf_counter() - began)
    print(json.dumps({"seconds": statistics.median(times)}))


if __name__ == "__main__":
    main()
