"""What versions 0.5, 1.0 and 1.5 learn, and model-free beside model-based: runs of minutes, five seeds each (`make slow`)."""

import statistics
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from rewardtogo.core import PRNGKey, env_spec
from rewardtogo.envs.pendulum import Pendulum, observe
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops.collect import begin
from rewardtogo.model_based.fit import dynamics_data
from rewardtogo.planning import CrossEntropy

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
        "v1.5": {},
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
    for version in ("v0.5", "v1.0", "v1.5"):
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
    """Returns in the swing-up of a cart-pole, five seeds of each, and three of SAC.

    Version 0.5 has as many steps as 1.5, all random, and one fit with as many updates as 1.5 makes in all. With `every=1` it plans like
    1.5, so that nothing but the data differs.
    """
    once = {"warm_up": 3900, "unroll": 100, "updates": 7000}
    wanted = {
        "v1.5": ("mbrl_v15", 4000, {}, {}),
        "v0.5": ("mbrl_v15", 4000, {"acting": "random", "every": 25}, once),
        "v0.5, replanning": ("mbrl_v15", 4000, {"acting": "random"}, once),
        "sac, as many steps": ("sac", 4000, {}, {}),
        "sac": ("sac", 80_000, {}, {}),
    }
    found = {}
    for name, (algorithm, steps, learner, loop) in wanted.items():
        made = rtg.train(
            algorithm,
            "CartPoleSwingUp",
            steps=steps,
            num_seeds=3 if algorithm == "sac" else SEEDS,
            learner=learner,
            loop=loop,
            out=tmp_path_factory.mktemp("swing") / "run",
            quiet=True,
        )
        found[name] = [run.evaluation["return_mean"] for run in made]
        print(f"\n{name}: {np.sort(found[name]).round(1)}")
    return found


RANDOM = 0.8
"""Return of random actions in the swing-up; docs/environments.md."""


@pytest.mark.parametrize("name", ["v0.5", "v0.5, replanning"])
def test_random_data_are_of_the_wrong_places(item, swing_up, name):
    """Random forces hardly move a pole that hangs: nothing in their data is upright. Returns count from those of random actions."""
    with item("8.42") as check:
        share = (statistics.median(swing_up[name]) - RANDOM) / (statistics.median(swing_up["v1.5"]) - RANDOM)
        check(share, "<=", 0.5, f"return of version {name[1:]} over that of 1.5, swing-up, medians of five seeds")


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


def test_model_based_is_ahead_early_and_not_late(item, swing_up):
    """The swing-up: what plans 25 steps ahead in a model against SAC, after as many steps and after twenty times as many."""
    middle = {name: statistics.median(returns) for name, returns in swing_up.items()}
    with item("8.50") as check:
        ahead = middle["v1.5"] - middle["sac, as many steps"]
        check(ahead, ">", 0, "model-based less model-free after 4,000 steps, swing-up, medians of seeds")
        behind = middle["sac"] - middle["v1.5"]
        check(behind, ">", 0, "model-free after 80,000 steps less model-based after 4,000")
