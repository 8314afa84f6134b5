"""Small runs, made once: short trainings, and folders of policies that were never trained."""

import shutil

import jax
import pytest

from rewardtogo.core import env_spec
from rewardtogo.envs.registry import make
from rewardtogo.nn import MLP
from rewardtogo.runner.folder import RunFolder
from rewardtogo.runner.plan import plan
from rewardtogo.runner.policy import save_policy
from rewardtogo.runner.train import train

SMALL = {"network": {"class": "mlp", "sizes": [16]}, "epochs": 2, "minibatches": 2}


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """`seeds`, a folder of three runs of PPO in CartPole, 2,000 steps each; `ppo`, a copy of the first one; `dqn`, a run of DQN."""
    root = tmp_path_factory.mktemp("trained")
    common = {"steps": 2000, "num_envs": 4, "preset": "none", "quiet": True}
    loop = {"unroll": 32}
    train("ppo", "CartPole-v1", num_seeds=3, out=root / "seeds", learner=SMALL, loop=loop, **common)
    shutil.copytree(root / "seeds" / "seed-0", root / "ppo")
    options = {"unroll": 8, "batch_size": 128, "warm_up": 200, "updates": 2}
    train("dqn", "CartPole-v1", out=root / "dqn", loop=options, **common)
    return root


@pytest.fixture(scope="session")
def untrained(tmp_path_factory):
    """`untrained(algorithm, env, ...)`: a run folder with a configuration and fresh parameters, which takes no training."""
    root = tmp_path_factory.mktemp("untrained")

    def folder(algorithm, env, seed=0, **learner):
        made = plan(algorithm, env, steps=1, preset="none", learner={"network": MLP(8), **learner})
        spec, key = env_spec(made.env if made.env is not None else make(env, 1)), jax.random.key(seed)
        state = jax.jit(lambda k: made.learner.init(spec, k))(key)
        path = root / f"{len(list(root.iterdir()))}"
        path.mkdir()
        RunFolder(path).write_config(made.config)
        name = made.config["algorithm"]
        save_policy(
            path, made.learner, state, spec, {"algorithm": name, "env": made.config["env"]["id"], "env_steps": 0}
        )
        return path

    return folder
