"""Small runs, made once: a short training, and folders of policies that were never trained."""

import json
import shutil

import jax
import jax.numpy as jnp
import pytest

from rewardtogo.core import env_spec
from rewardtogo.nn import MLP
from rewardtogo.runner.engine import Program
from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.plan import plan
from rewardtogo.runner.policy import save_policy
from rewardtogo.runner.train import RunState, train


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """`seeds`, a folder of three runs of PPO in CartPole, 2,000 steps each; `ppo`, a copy of the first; `other`, one that says it is
    of DQN.
    """
    root = tmp_path_factory.mktemp("trained")
    train(
        "ppo",
        "CartPole-v1",
        steps=2000,
        num_envs=4,
        num_seeds=3,
        out=root / "seeds",
        loop={"unroll": 32},
        learner={"network": MLP(16), "epochs": 2, "minibatches": 2},
        preset="none",
        checkpoint_every=1e6,
        quiet=True,
    )
    for name in ("ppo", "other"):
        shutil.copytree(root / "seeds" / "seed-0", root / name)
    config = json.loads((root / "other" / "config.json").read_text())
    (root / "other" / "config.json").write_text(json.dumps({**config, "algorithm": "dqn"}))
    return root


@pytest.fixture(scope="session")
def untrained(tmp_path_factory):
    """`untrained(algorithm, env, ...)`: a run folder with a configuration and fresh parameters, without any training.

    With `checkpoint`, also a checkpoint of the first state; `options` are those of `plan`, the rest is the learner's.
    """
    root = tmp_path_factory.mktemp("untrained")

    def folder(algorithm, env, checkpoint=False, options=None, **learner):
        network = {"network": MLP(8), **learner}
        made = plan(algorithm, env, **{"steps": 1, "preset": "none", "learner": network, **(options or {})})
        path = root / f"{len(list(root.iterdir()))}"
        path.mkdir()
        run = RunFolder(path)
        run.write_config(made.config)
        if checkpoint:
            program = Program(made.algorithm, jax.random.key(0), 1)
            state = program.init()
            run.save_checkpoint(1, RunState(state, program.fresh_sums(state), jnp.zeros(())), {})
            learned = made.algorithm.learned(state)
        else:
            learned = jax.jit(lambda key: made.learner.init(env_spec(made.env), key))(jax.random.key(0))
        about = {"algorithm": made.config["algorithm"], "env": made.config["env"]["id"], "env_steps": 0}
        save_policy(path, made.learner, learned, env_spec(made.env), about)
        return path

    return folder
