"""What versions 0.5, 1.0 and 1.5 learn, and model-free beside model-based: runs of minutes, five seeds each (`make slow`)."""

import statistics
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import Batch, PRNGKey, env_spec
from rewardtogo.envs.pendulum import Pendulum, observe
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops.collect import RandomPolicy, begin
from rewardtogo.model_based.fit import dynamics_data
from rewardtogo.planning import CrossEntropy
from rewardtogo.runner.plan import plan

pytestmark = pytest.mark.slow
SEEDS = 5


class Hanging(Pendulum):
    """A pendulum that begins hanging and at rest, so that random torques never show what it is like upright."""

    def reset(self, key: PRNGKey) -> tuple[Any, Any]:
        state = jnp.asarray([np.pi, 0.0]) + 0.1 * jax.random.normal(key, (2,))
        return state, observe(state)


def algorithm(version: str) -> rtg.OffPolicy:
    """A version as the catalogue has it, in episodes of 200 steps."""
    settings = {
        "v0.5": {"acting": "random", "every": 20},
        "v1.0": {"every": 20},
    }[version]
    learner = rtg.ModelBased(
        members=1, posterior=rtg.model_based.Bootstrap(False), probabilistic=False, propagation="mean", horizon=20,
        planner=CrossEntropy(samples=100, elites=10, iterations=3), **settings,
    )  # fmt: skip
    env = rtg.make(lambda: TimeLimit(Hanging(), 200), 1)
    return rtg.OffPolicy(env, learner, rtg.UniformReplay(10_000), unroll=100, updates=300, batch_size=128, warm_up=200)


ITERATIONS = 20


@pytest.fixture(scope="module")
def runs():
    """Of each version and seed: returns of ten episodes at the end, and the one-step errors, in the places that the version plans its way
    to, of the first fit and of the last.
    """
    found: dict[str, np.ndarray] = {}
    for version in ("v0.5", "v1.0"):
        loop = algorithm(version)
        many = rtg.make(lambda: TimeLimit(Hanging(), 200), 10)
        spec = env_spec(many)

        def one(key, loop=loop, many=many, spec=spec):
            init_key, play_key, early_key = jax.random.split(key, 3)
            state = loop.init(init_key)

            def visit(state, key):
                """What the policy does, and how wrong its model is of it."""
                policy = loop.policy(state)
                actor = begin(many, policy, key)
                _, rollout, episodes = rtg.collect(many, policy, actor, key, 200)
                t = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout.transitions)
                x, y = dynamics_data(t, spec, True, True)
                assert isinstance(loop.learner, rtg.ModelBased)
                model = loop.learner.model(state.learner)
                said = model.ensemble(jax.vmap(model.inputs)(x)[None])
                error = ((said.mean[0] - jax.vmap(model.targets)(y)) * model.targets.sd()[None])[:, :-1]
                return episodes.return_sum / episodes.count, jnp.square(error).mean()

            step = lambda s, i: (loop.step(s, jax.random.fold_in(key, i))[0], None)  # noqa: E731
            early, _ = jax.lax.scan(step, state, jnp.arange(1))
            _, first = visit(early, early_key)
            state, _ = jax.lax.scan(step, early, jnp.arange(1, ITERATIONS))
            score, last = visit(state, play_key)
            return jnp.stack([score, first, last])

        found[version] = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), SEEDS)))
        print(
            f"\n{version}: returns {np.sort(found[version][:, 0]).round(1)}, errors {found[version][:, 1:].round(4).tolist()}"
        )
    return found


@pytest.fixture(scope="module")
def swing_up(tmp_path_factory):
    """Returns of version 1.5 in the swing-up of a cart-pole, five seeds."""
    made = rtg.train(
        "mbrl_v15", "CartPoleSwingUp", num_seeds=SEEDS, out=tmp_path_factory.mktemp("swing") / "run", quiet=True
    )
    found = [run.evaluation["return_mean"] for run in made]
    print(f"\nv1.5: {np.sort(found).round(1)}")
    return found


def once_and_for_all(every: int) -> np.ndarray:
    """Returns of version 0.5 in the swing-up, five seeds: as many steps as version 1.5 has, all random, and one fit of as many updates.

    With `every=1` it plans like version 1.5, so that nothing but the data differs.
    """
    learner = plan("mbrl_v15", "CartPoleSwingUp", learner={"every": every}).learner
    assert isinstance(learner, rtg.ModelBased)
    env = rtg.make("CartPoleSwingUp", 40)
    spec = env_spec(env)

    def one(key: PRNGKey) -> jax.Array:
        data_key, init_key, fit_key, play_key = jax.random.split(key, 4)
        random = RandomPolicy(spec)
        _, rollout, _ = rtg.collect(env, random, begin(env, random, data_key), data_key, 100)
        data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout.transitions)

        def update(state, key):
            batch_key, key = jax.random.split(key)
            at = jax.random.randint(batch_key, (128,), 0, 4000)
            batch = Batch(jax.tree.map(lambda x: x[at], data), at, jnp.ones(128))
            return learner.update(state, batch, key)[0], None

        state, _ = jax.lax.scan(update, learner.init(spec, init_key), jax.random.split(fit_key, 7000))
        few, policy = rtg.make("CartPoleSwingUp", 10), learner.policy(state, explore=False)
        _, _, episodes = rtg.collect(few, policy, begin(few, policy, play_key), play_key, 100)
        return episodes.return_sum / episodes.count

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), SEEDS)))


RANDOM = 0.8
"""Return of random actions in the swing-up; docs/environments.md."""


@pytest.mark.parametrize("every", [25, 1])
def test_random_data_are_of_the_wrong_places(item, swing_up, every):
    """Random forces hardly move a pole that hangs: nothing in their data is upright. Returns count from those of random actions."""
    found = once_and_for_all(every)
    print(f"\nv0.5, a plan every {every}: {np.sort(found).round(1)}")
    with item("8.42") as check:
        share = (statistics.median(found.tolist()) - RANDOM) / (statistics.median(swing_up) - RANDOM)
        what = f"return of version 0.5, a plan every {every}, over that of 1.5, swing-up, medians of five seeds"
        check(share, "<=", 0.5, what)


def test_whole_plans_teach_what_they_meet(item, runs):
    with item("8.43") as check:
        fall = 1 - np.median(runs["v1.0"][:, 2]) / np.median(runs["v1.0"][:, 1])
        check(fall, ">=", 0.5, "fall of the one-step error where plans lead, first fit to last, medians of five seeds")
        better = (runs["v1.0"][:, 0] > runs["v0.5"][:, 0]).sum()
        check(better, ">=", 4, "seeds whose return is above that of version 0.5")


@pytest.mark.parametrize(
    ("name", "env", "steps", "score"), [("mbrl_v15", "Pendulum-v1", 5000, -250), ("mbrl_v15", "CartPole-v1", 5000, 200)]
)
def test_replanning_learns_quickly(item, tmp_path: Path, name: str, env: str, steps: int, score: float):
    made = rtg.train(name, env, steps=steps, num_seeds=SEEDS, out=tmp_path / "run", quiet=True)
    scores = [run.evaluation["return_mean"] for run in made]
    print(f"\n{name}, {env}: {np.sort(scores).round(1)}")
    with item("8.44") as check:
        check(statistics.median(scores), ">=", score, f"{name}, {env}: median return of five seeds, {steps} steps")
        check(sum(s >= score for s in scores), ">=", 4, "seeds that reach it")


def test_model_based_is_ahead_early_and_not_late(item, swing_up, tmp_path: Path):
    """The swing-up: what plans 25 steps ahead in a model against SAC, after as many steps and after twenty times as many."""
    sac = {}
    for steps in (4000, 80_000):
        made = rtg.train("sac", "CartPoleSwingUp", steps=steps, num_seeds=3, out=tmp_path / f"sac-{steps}", quiet=True)
        sac[steps] = statistics.median(run.evaluation["return_mean"] for run in made)
    print(f"\nsac: {sac}")
    with item("8.50") as check:
        ahead = statistics.median(swing_up) - sac[4000]
        check(ahead, ">", 0, "model-based less model-free after 4,000 steps, swing-up, medians of five and three seeds")
        behind = sac[80_000] - statistics.median(swing_up)
        check(behind, ">", 0, "model-free after 80,000 steps less model-based after 4,000")
