"""Tests of this folder run commands in an empty folder of their own and leave the settings of the process alone."""

from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import jax
import pytest
from faulty import SMALL, Faulty, files_under
from jax.experimental.compilation_cache import compilation_cache

import rewardtogo as rtg
from rewardtogo.cli import commands
from rewardtogo.cli.main import main

if "Faulty-v0" not in gymnasium.registry:
    gymnasium.register("Faulty-v0", entry_point=Faulty, order_enforce=False, disable_env_checker=True)


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where compiled programs are kept while these tests run."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="package", autouse=True)
def compiled_once(cache: Path) -> Iterator[None]:
    """The same program is compiled once for all tests here, as it is for a user; what other tests do is left alone."""
    settings = {
        "jax_compilation_cache_dir": str(cache),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: jax.config.values[name] for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(autouse=True)
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is also the present one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "use_cache", lambda: None)
    return tmp_path


@pytest.fixture
def refused(workplace: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must be refused: status 2, one line, nothing on stdout, nothing new on disk. Returns the line."""

    def check(*arguments: object, status: int = 2) -> str:
        before = files_under(workplace)
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == status
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("rtg: ") and said.err.count("\n") == 1 and said.err.endswith("\n"), said.err
        assert "Traceback" not in said.err
        assert files_under(workplace) == before
        return said.err

    return check


@pytest.fixture(scope="session")
def small_ppo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of PPO in CartPole, stopped after its first checkpoints. Copy it before changing anything."""
    folder = tmp_path_factory.mktemp("runs") / "ppo"
    learner = {"network": {"class": "MLP", "sizes": [4]}, "epochs": 1, "minibatches": 1}
    rtg.train("ppo", "CartPole-v1", out=folder, preset="none", learner=learner, checkpoint_every=1e-9, **SMALL)
    return folder


@pytest.fixture(scope="session")
def small_leaner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the learner in `faulty.py`, in CartPole."""
    folder = tmp_path_factory.mktemp("runs") / "leaner"
    rtg.train("faulty:Leaner", "CartPole-v1", out=folder, checkpoint_every=1e-9, **SMALL)
    return folder
