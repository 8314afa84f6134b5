"""Environments that give NaN, raise, answer in a wrong shape or never end: an exception with a name, status 1 or 2, one sentence."""

import gymnasium
import numpy as np
import pytest
from faulty import SMALL, Faulty, Leaner, files_under
from gymnasium import spaces

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.runner import evaluate
from rewardtogo.runner.engine import NonFinite

SINGLE = SMALL | {"num_envs": 1, "steps": 16}
FAULTS = {
    "raises": "KeyError step after 2 vector steps joint 7",
    "nan observation": "observation NaN step after 2",
    "infinite observation": "observation infinity step after 2",
    "nan reward": "reward nan step after 2",
    "infinite reward": "reward inf step after 2",
    "wrong shape": "step (3, 1) (3,)",
    "wrong type": "step type",
    "four values": "step 4 values five",
    "nothing": "step TypeError",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_failing_environment_is_named_and_nothing_is_left(workplace, fault):
    with pytest.raises(rtg.EnvironmentFailure) as caught:
        rtg.train(Leaner(), lambda: Faulty(fault), **SINGLE)
    sentence = str(caught.value)
    missing = [fragment for fragment in ("Faulty", *FAULTS[fault].split()) if fragment not in sentence]
    assert not missing, f"{missing} not in: {sentence}"
    assert "\n" not in sentence and not files_under(workplace)


def test_on_the_command_line_it_is_status_1_and_one_sentence(refused):
    command = (
        "train",
        "faulty:Leaner",
        "Faulty-v0",
        "--steps",
        "16",
        "--num-envs",
        "1",
        "--quiet",
        "--env.fault",
        "raises",
    )
    sentence = refused(*command, status=1)
    assert "Faulty-v0" in sentence and "joint 7" in sentence


def test_what_was_learnt_before_the_failure_is_kept(workplace, capsys):
    """The first two chunks are whole; the third one meets the fault, and the second checkpoint can be used."""
    command = (
        "train",
        "faulty:Leaner",
        "Faulty-v0",
        "--steps",
        "16",
        "--num-envs",
        "1",
        "--quiet",
        "--loop.unroll",
        "4",
    )
    fault = ("--env.fault", "raises late", "--out", "run", "--checkpoint-every", "0.000001")
    calls = {"n": 0}
    step = Faulty.step

    def late(self, action):
        calls["n"] += self.fault == "raises late"
        if calls["n"] == 11:
            raise OSError("the cable came off")
        return step(self, action)

    with pytest.MonkeyPatch.context() as patch:
        # Evaluations end chunks: one after each iteration, however long they take outside of the program.
        patch.setattr("rewardtogo.runner.plan.HOSTED_SHARE", 1e9)
        patch.setattr(evaluate.Evaluator, "__call__", lambda *_: (np.zeros(20), np.ones(20)))
        patch.setattr(Faulty, "step", late)
        assert main([*command, *fault]) == 1
    assert "the cable came off" in capsys.readouterr().err
    assert [p.name for p in sorted((workplace / "run" / "checkpoints").iterdir())] == ["00000001", "00000002"]
    assert rtg.load(workplace / "run", Leaner())(np.zeros(3, np.float32)) in (0, 1)
    assert main(["resume", "run", "--learner-class", "faulty:Leaner", "--quiet"]) == 0


def test_an_environment_that_never_ends_is_given_up(workplace, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "MAX_STEPS", 7)
    command = ("train", "faulty:Leaner", "Faulty-v0", "--steps", "16", "--num-envs", "1", "--quiet")
    assert main([*command, "--env.fault", "never ends"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "did not end" in error and "max_episode_steps" in error and "TimeLimit" in error


def test_a_parameter_that_leaves_the_numbers_has_a_name(workplace, capsys):
    with pytest.raises(NonFinite, match=r"parameter .*bias is no longer finite"):
        rtg.train(Leaner(explodes=True), "CartPole-v1", out=workplace / "run", **SMALL)
    command = ("train", "faulty:Leaner", "CartPole-v1", "--steps", "32", "--num-envs", "2", "--quiet")
    assert main([*command, "--learner.explodes", "true", "--out", "other"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("rtg: the parameter") and error.count("\n") == 1 and "learning rate" in error


class Raising(gymnasium.Env):
    observation_space, action_space = spaces.Box(-1, 1, (3,)), spaces.Discrete(2)

    def __init__(self):
        raise FileNotFoundError("no map of the maze")


if "Raising-v0" not in gymnasium.registry:
    gymnasium.register("Raising-v0", entry_point=Raising)


class Spaceless(Faulty):
    observation_space = spaces.Sequence(spaces.Discrete(2))


class Wordy(Faulty):
    observation_space = spaces.Text(5)


@pytest.mark.parametrize(
    ("make", "fragments"),
    [
        ("Raising-v0", "Raising-v0 cannot be made no map of the maze"),
        (lambda: Faulty("raises in reset"), "Faulty RuntimeError first reset the sensor is not plugged in"),
        (lambda: Faulty("wrong shape in reset"), "Faulty first reset (4,) (3,)"),
        (Spaceless, "Sequence shape Box"),
        (Wordy, "Text shape Box"),
        (lambda: 3, "cannot be made int gymnasium.Env"),
        (lambda: None, "cannot be made NoneType gymnasium.Env"),
    ],
)
def test_an_environment_that_cannot_be_used_at_all(workplace, make, fragments):
    with pytest.raises(ValueError) as caught:
        rtg.train(Leaner(), make, **SINGLE)
    assert not [fragment for fragment in fragments.split() if fragment not in str(caught.value)], caught.value
    assert not files_under(workplace)
