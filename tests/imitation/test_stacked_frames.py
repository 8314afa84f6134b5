"""An expert who remembers (erratum E2.9): the XOR of the last two observations, by networks with and without a memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitating import run, steps

from rewardtogo.core import env_spec
from rewardtogo.data import Dataset
from rewardtogo.envs.imitation_problems import LastTwo
from rewardtogo.envs.vectorize import vectorize
from rewardtogo.imitation import BC
from rewardtogo.loops import RandomPolicy, begin, collect
from rewardtogo.loops.offline import Offline
from rewardtogo.nn import CNN, GRU, LSTM, MLP, Stacked
from rewardtogo.runner.evaluate import Evaluator

TASK = LastTwo()
NETWORKS = {"memoryless": MLP(16), "stacked": Stacked(2, MLP(16)), "lstm": LSTM(16, MLP(8))}


def demonstrations(key) -> Dataset:
    """50 episodes of right answers; nothing that is seen depends on the answers."""
    env = vectorize(TASK, 50)

    @jax.jit
    def play(key):
        policy = RandomPolicy(env_spec(env))
        return collect(env, policy, begin(env, policy, key), key, 20)[1].transitions.observation

    bit = np.asarray(play(key))[..., 0].T
    before = np.concatenate([bit[:, :1], bit[:, :-1]], 1)
    answer = (bit != before).astype(np.int32)
    return steps(jnp.asarray(bit.reshape(-1, 1)), jnp.asarray(answer.ravel()), env_spec(env), length=20)


@pytest.mark.parametrize("name", ["memoryless", "stacked", pytest.param("lstm", marks=pytest.mark.slow)])
def test_xor_of_the_last_two(name, key, item):
    learner = BC(network=NETWORKS[name], learning_rate=0.02)
    algorithm = Offline(demonstrations(key), learner, batch_size=32, length=20, updates=10)
    state, _ = run(algorithm, key, 25)
    returns, _ = Evaluator(vectorize(TASK, 100), 100)(algorithm.policy(state), key)
    share = returns.mean() / 20
    with item({"memoryless": "2.12", "stacked": "2.13", "lstm": "2.14"}[name]) as check:
        if name == "memoryless":
            check(abs(share - 0.5), "<=", 0.05, "right answers of a policy of o_t alone, from a half")
        else:
            check(share, ">=", 0.99, f"right answers, {name}")
    if name != "memoryless":
        with item("2.12") as check:
            check(share, ">=", 0.99, f"right answers, {name}")


def parameters(network, spec, key) -> int:
    return sum(x.size for x in jax.tree.leaves(jax.eval_shape(lambda k: network.build(spec, k), key)))


def test_what_memory_costs(key, item):
    spec = env_spec(TASK).observation
    stacks = [parameters(Stacked(k, MLP(16)), spec, key) for k in (1, 2, 3, 8)]
    with item("2.13") as check:
        check(stacks[1] - stacks[0], "==", 16, "weights of one more frame of one number")
        check(stacks[3] - stacks[2], "==", 5 * 16, "and of five more: linear in k")
    lstm = LSTM(16, MLP(8)).build(spec, key)
    carry = lstm.init()
    with item("2.15") as check:
        check(
            sum(x.size for x in jax.tree.leaves(carry)), "==", 32, "numbers that an LSTM remembers, whatever the past"
        )
        check(parameters(LSTM(16, MLP(8)), spec, key), "==", 1888, "parameters of an LSTM, however long the history")
        check(stacks[3] / stacks[0], ">", 3, "parameters of a stack of 8, in those of one frame")


def test_a_stack_is_a_memory_of_frames(key, item):
    network = Stacked(3, MLP())
    torso = network.build(env_spec(TASK).observation, key)
    carry, seen = torso.init(), []
    for x in (1.0, 2.0, 3.0, 4.0):
        carry, features = torso(carry, jnp.full(1, x))
        seen.append(np.asarray(features))
    with item("2.13") as check:
        wanted = np.array([[1, 1, 1], [1, 1, 2], [1, 2, 3], [2, 3, 4]])
        check(np.abs(np.stack(seen) - wanted).max(), "==", 0, "frames against those written out")


@pytest.mark.parametrize("network", [Stacked(2, CNN((4,), (3,), (2,), (8,))), LSTM(8, CNN((4,), (3,), (2,), (8,)))])
def test_pictures_share_an_encoder(network, key, item):
    """One set of convolutions, whatever the number of steps (figure 2.2); the memory begins anew with an episode."""
    from rewardtogo.envs.imitation_problems import Lane
    from rewardtogo.nn import is_recurrent, unroll

    spec = env_spec(Lane(picture=True)).observation
    torso = jax.jit(lambda k: network.build(spec, k))(key)  # the runner builds networks in a compiled program
    pictures = jax.random.randint(key, (6, *spec.shape), 0, 255).astype(jnp.uint8)
    done = jnp.asarray([False, False, True, False, False, False])
    _, features = jax.jit(lambda p, d: unroll(torso, torso.init(), p, d))(pictures, done)
    alone = jax.jit(lambda p: unroll(torso, torso.init(), p, jnp.zeros(3, bool))[1])(pictures[3:])
    assert is_recurrent(torso)
    with item("2.14") as check:
        check(np.abs(features[3:] - alone).max(), "<=", 1e-6, "features after an end, and of the same steps alone")
        kernels = [x for x in jax.tree.leaves(torso) if x.shape and x.shape[0] == 4 and x.ndim == 2]
        check(len(kernels), "==", 1, "tensors of convolutions")


def test_what_a_stack_refuses():
    with pytest.raises(ValueError, match="its size is 1 or more, not 0"):
        Stacked(0)
    with pytest.raises(ValueError, match="GRU is another one"):
        Stacked(2, GRU())
