"""What learners of models share: nothing is planned while actions are random; then every step has a plan, and noise on it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import Action, PRNGKey, Solution, Spec, State
from rewardtogo.envs import Pendulum
from rewardtogo.model_based import E2C, LatentMBRL, ModelBased, PlaNet
from rewardtogo.model_based.planned import explored
from rewardtogo.planning.mpc import Planner
from rewardtogo.planning.problem import Plan, Problem

PLANS: list[int] = []


class Counting(Planner):
    """A plan of ones, and a mark for it."""

    def __call__(self, problem: Problem, state: State, guess: Action, key: PRNGKey) -> Solution:
        del state, key
        jax.debug.callback(lambda _: PLANS.append(1), guess)
        actions = jnp.ones_like(guess)
        return Solution(Plan(actions, jnp.zeros((problem.horizon + 1, 1)), jnp.zeros(())), jnp.ones((), bool), {})


@pytest.mark.parametrize("learner", [ModelBased, LatentMBRL, PlaNet, E2C], ids=lambda cls: cls.__name__)
def test_nothing_is_planned_in_the_warm_up(learner, key):
    options = {"sizes": (4,), "planner": Counting(), "horizon": 3, **({} if learner is ModelBased else {"noise": 0.0})}
    if learner is not ModelBased:
        options["encoder_sizes"] = (4,)
    env = rtg.vectorize(Pendulum(), 2)
    algorithm = rtg.OffPolicy(env, learner(**options), unroll=4, warm_up=16, batch_size=4, length=2)
    PLANS.clear()
    state = jax.block_until_ready(jax.jit(lambda k: algorithm.init(k))(key))
    jax.effects_barrier()
    assert not PLANS
    step = jax.jit(lambda s, k: algorithm.step(s, k)[0])
    # The first iteration acts before it learns: at random still.
    state = jax.block_until_ready(step(state, key))
    jax.effects_barrier()
    assert not PLANS
    state = jax.block_until_ready(step(state, key))
    jax.effects_barrier()
    assert len(PLANS) == 2 * 4


def test_noise_is_added_where_there_is_any(key):
    box = Spec("box", (2,), low=(-2.0,), high=(2.0,))
    planned, no, one, two = jnp.array([0.5, -1.0]), jnp.zeros((), bool), *jax.random.split(key)
    assert np.array_equal(explored(box, planned, no, None, one, two), planned)
    assert np.array_equal(explored(box, planned, no, jnp.zeros(()), one, two), planned)
    noise = jax.random.normal(two, (2,))
    assert np.allclose(explored(box, planned, no, jnp.asarray(0.1), one, two), planned + 0.1 * 2.0 * noise)
    guess = explored(box, planned, ~no, jnp.asarray(0.1), one, two)
    assert np.array_equal(guess, box.sample(one)) and np.array_equal(guess, explored(box, planned, ~no, None, one, two))
    choice = Spec("discrete", counts=(5,), dtype="int32")
    always = [int(explored(choice, jnp.asarray(3), no, jnp.ones(()), k, two)) for k in jax.random.split(key, 20)]
    assert len(set(always)) > 2 and int(explored(choice, jnp.asarray(3), no, None, one, two)) == 3
