"""The drone and the tree (figure 2.3): an expert who goes left or right, and what each head makes of it."""

import jax
import numpy as np
import pytest
from imitating import flights, run

from rewardtogo.envs.imitation_problems import SIDE, Drone
from rewardtogo.imitation import BC
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import MLP, Autoregressive, Latent, Mixture, Standard
from rewardtogo.ops.schedules import Linear

DRONE = Drone()
HEADS = {"gaussian": Standard(), "mixture": Mixture(), "autoregressive": Autoregressive(), "latent": Latent(1)}
ITEMS = {"mixture": "2.20", "autoregressive": "2.22", "latent": "2.21"}


def flown(name: str, key) -> tuple[np.ndarray, np.ndarray]:
    """Of 2,000 flights, by sampling and by the mode: whether they end in the tree; and which side each takes."""
    latent = name == "latent"
    learner = BC(network=MLP(32), head=HEADS[name], learning_rate=Linear(0.03 if latent else 5e-3, 0.0))
    algorithm = Offline(flights(DRONE, 1000, key), learner, batch_size=256 if latent else 128, updates=20)
    state, _ = run(algorithm, key, 80 if latent else 40)
    reset_keys, keys = jax.random.split(jax.random.fold_in(key, 1), (2, 2000))
    place = jax.vmap(lambda k: DRONE.reset(k)[1])(reset_keys)
    hits, sides = [], []
    for explore in (True, False):
        policy = learner.policy(state.learner, explore)
        action = jax.jit(jax.vmap(lambda o, k, p=policy: p((), o, k)[1]))(place, keys)
        hits.append(np.asarray(jax.vmap(DRONE.hits)(place, action)))
        sides.append(np.asarray(action > place)[:, 0])
    return np.stack(hits), np.stack(sides)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "latent" else n for n in HEADS])
def test_past_the_tree(name, key, item):
    hits, sides = flown(name, key)
    sampled, likeliest = hits.mean(1)
    with item("2.19") as check:
        if name == "gaussian":
            check(likeliest, ">=", 0.8, "collisions of the Gaussian's likeliest heading")
            return
        check(sampled, "<=", 0.05, f"collisions, {name}, sampled")
        check(likeliest, "<=", 0.05, f"collisions, {name}, likeliest heading")
    with item(ITEMS[name]) as check:
        check(sides[0].mean(), ">=", 0.35, f"share of flights to the right of the tree, {name}")
        check(sides[0].mean(), "<=", 0.65, f"share of flights to the right of the tree, {name}")


def test_the_expert_never_hits(key):
    data = flights(DRONE, 1000, key)
    t = data.transitions
    assert not np.any(jax.vmap(DRONE.hits)(t.observation, t.action))
    offset = np.asarray(t.action - t.observation)[:, 0]
    assert 0.45 < (offset > 0).mean() < 0.55 and np.abs(np.abs(offset).mean() - SIDE) < 0.01
    state, place = DRONE.reset(key)
    _, timestep = DRONE.step(state, place, key)
    assert float(timestep.reward) == -1.0 and bool(timestep.terminated)
