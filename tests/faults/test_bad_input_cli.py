"""Requests that cannot be met, on the command line: status 2 and one sentence with what was given and what would do."""

import jax
import pytest

PPO = "train ppo CartPole-v1 --preset none"
DQN = "train dqn CartPole-v1"

CASES = [
    # Names that nobody knows, with the nearest.
    ("trian ppo CartPole-v1", "'trian' train"),
    ("train ppoo CartPole-v1", "'ppoo' ppo module:Class"),
    ("train DQM CartPole-v1", "'DQM' dqn"),
    ("train ppo CartPol-v1", "'CartPol-v1' CartPole-v1"),
    ("train ppo Pendulun-v1", "'Pendulun-v1' Pendulum-v1"),
    ("train nosuchmodule:X CartPole-v1", "'nosuchmodule' imported"),
    ("train math:cosinus CartPole-v1", "'math' 'cosinus' cos"),
    ("train math:pi.real CartPole-v1", "'math' 'pi.real'"),
    ("train math:sin CartPole-v1", "math:sin rewardtogo.Learner"),
    ("train rewardtogo.core:Learner CartPole-v1", "Learner abstract"),
    ("train :X CartPole-v1", "':X' module:Class"),
    ("train ppo nosuchmodule:Thing-v0", "nosuchmodule:Thing-v0 nosuchmodule"),
    ("train ppo math:Thing-v0", "math:Thing-v0 Thing"),
    (f"{PPO} --learner.gama 0.9", "PPO 'gama' gamma"),
    (f"{PPO} --loop.unrol 3", "OnPolicy 'unrol' unroll"),
    (f"{PPO} --learner.network mpl", "PPO.network 'mpl' mlp"),
    (f"{PPO} --learner.network.actvation relu", "MLP 'actvation' activation"),
    (f"{PPO} --learner.network.activation sigmod", "'sigmod' relu"),
    ("train reinforce CartPole-v1 --learner.baseline valu", "PolicyGradient.baseline 'valu' value"),
    (f"{DQN} --loop.replay uniformm", "OffPolicy.replay 'uniformm' uniformreplay"),
    (f"{PPO} --backend jaxx", "'jaxx' jax gymnasium"),
    ("train ppo CartPole-v1 --preset good", "'good' auto none ppo/CartPole-v1"),
    (f"{PPO} --stepps 3", "'--stepps' --steps"),
    ("list --env", "'--env' --envs"),
    ("eval run --sed 3", "'--sed' --seed"),
    ("figure 99.9", "'99.9' `rtg figure`"),
    ("figure tightropes", "'tightropes' tightrope?"),
    # An algorithm against a space, a loop against data, a backend against an environment.
    ("train dqn Pendulum-v1", "DQN discrete box `rtg list`"),
    ("train dqn MountainCarContinuous-v0 --steps 100", "DQN discrete box"),
    ("train dqn Pendulum-v1 --backend gymnasium", "DQN discrete box"),
    ("train ddpg CartPole-v1", "DDPG box discrete `rtg list`"),
    ("train sac CartPole-v1 --steps 2000", "SAC box discrete"),
    ("train td3 Pendulum-v1 --learner.noise gausian", "TD3.noise 'gausian' gaussian"),
    ("train td3 Pendulum-v1 --learner.noise mlp", "TD3.noise 'mlp' gaussian, ou."),
    ("train ddpg Pendulum-v1 --learner.noise.sd -1", "Gaussian.sd -1"),
    ("train ddpg Pendulum-v1 --learner.noise ou --learner.noise.theta 3", "OU theta=3 below 2"),
    ("train cem_q Pendulum-v1 --learner.maximiser ou", "CEMQ.maximiser 'ou' ascent, cem, sampled."),
    ("train cem_q Pendulum-v1 --learner.maximiser.elites 99", "CEM 99 elites 16 samples"),
    ("train sac Pendulum-v1 --learner.critics 0", "SAC.critics [1, inf) 0"),
    ("train naf Pendulum-v1 --learner.value-scale 0", "NAF.value_scale (0, inf) 0"),
    (f"{PPO} --learner.network cnn", "CNN pictures MLP"),
    ("train bc CartPole-v1", "bc dataset `rtg collect --data"),
    ("train bc CartPole-v1 --data nowhere", "nowhere dataset collect"),
    ("train ppo", "ppo environment CartPole-v1"),
    ("train ppo OneStep --backend gymnasium", "OneStep --backend jax"),
    ("train ppo Acrobot-v0 --backend jax", "Acrobot-v0 twin Acrobot-v1"),
    (f"{PPO} --env.sutton_barto_reward true --backend jax", "sutton_barto_reward gymnasium"),
    (f"{PPO} --env.colour red", "CartPole-v1 colour"),
    ("train q_learning CartPole-v1", "table box dqn FrozenLake-v1"),
    ("train double_q_learning Pendulum-v1", "QLearning discrete box"),
    ("train fqi CartPole-v1", "fqi dataset `rtg collect --data"),
    ("train q_learning FrozenLake-v1 --learner.exploration epsilon", "QLearning.exploration 'epsilon' epsilongreedy"),
    ("train q_learning FrozenLake-v1 --learner.exploration.epsilon 2", "EpsilonGreedy.epsilon [0, 1] 2"),
    ("train q_learning FrozenLake-v1 --env.map_name 16x16", "FrozenLake-v1 map_name='16x16' is_slippery"),
    ("solve CartPole-v1", "CartPole-v1 table FrozenLake-v1 `rtg train`"),
    ("solve FrozenLak-v1", "FrozenLak FrozenLake"),
    ("solve FrozenLake-v1 --method valueiteration", "'valueiteration' value_iteration"),
    ("solve FrozenLake-v1 --gamma 1.5", "discount [0, 1] 1.5"),
    ("solve FrozenLake-v1 --gamma nan", "discount [0, 1] nan"),
    ("solve FrozenLake-v1 --tolerance 0", "tolerance more than 0"),
    ("solve FrozenLake-v1 --horizon 5", "value_iteration backward_induction --horizon 5"),
    ("solve FrozenLake-v1 --method backward_induction --horizon 0", "horizon 0 at least 1"),
    ("solve CliffWalking-v1 --method backward_induction", "CliffWalking-v1 limit --horizon 100"),
    ("solve FrozenLake-v1 --env.slippery 3", "slippery=3 is_slippery"),
    ("solve FrozenLake-v1 --learner.gamma 3", "'--learner.gamma' --env.NAME"),
    ("solve FrozenLake-v1 --out lake.txt", ".png lake.txt"),
    ("solve", "ENV"),
    # Numbers: negative, zero, NaN, infinite, huge, not whole, no numbers at all.
    (f"{PPO} --steps 0", "steps at least 1 0"),
    (f"{PPO} --steps -5", "steps at least 1 -5"),
    (f"{PPO} --steps nan", "steps at least 1 nan"),
    (f"{PPO} --steps inf", "steps at least 1 inf"),
    (f"{PPO} --steps 1.5", "steps whole 1.5"),
    (f"{PPO} --steps many", "--steps number 'many'"),
    (f"{PPO} --steps 1e18", "1e+18 1e15"),
    (f"{PPO} --steps 1e15 --loop.unroll 1 --num-envs 1 --learner.minibatches 1", "iterations 2^31 --loop.unroll"),
    (f"{PPO} --seed -1", "seed -1 2^32"),
    (f"{PPO} --seed 4294967296", "seed 4294967296 2^32"),
    (f"{PPO} --seed 1.5", "--seed whole '1.5'"),
    (f"{PPO} --seed 4294967295 --num-seeds 2", "seed 4294967296 2^32"),
    (f"{PPO} --num-seeds 0", "seeds at least 1 0"),
    (f"{PPO} --num-seeds -2", "seeds at least 1 -2"),
    (f"{PPO} --num-seeds 1000000000000", "seeds at most 1000000000000"),
    (f"{PPO} --num-envs 0", "at least one environment 0"),
    (f"{PPO} --num-envs -3", "at least one environment -3"),
    (f"{PPO} --num-envs 2.5", "--num-envs whole '2.5'"),
    (f"{PPO} --num-envs 1000000000000", "too large smaller"),
    (f"{PPO} --num-envs 1000000000000 --backend gymnasium", "1000000000000 Gymnasium at most"),
    (f"{PPO} --stop-at-return nan", "return finite nan"),
    (f"{PPO} --time-limit 0", "time limit more than 0 seconds"),
    (f"{PPO} --time-limit -1", "time limit more than 0 seconds -1"),
    (f"{PPO} --time-limit nan", "time limit more than 0 seconds nan"),
    (f"{PPO} --checkpoint-every 0", "checkpoints more than 0 seconds"),
    (f"{PPO} --checkpoint-every soon", "--checkpoint-every number 'soon'"),
    (f"{PPO} --learner.gamma 1.5", "PPO.gamma [0, 1] 1.5"),
    (f"{PPO} --learner.gamma nan", "PPO.gamma 'nan' finite"),
    (f"{PPO} --learner.gamma half", "PPO.gamma 'half' number schedule"),
    (f"{PPO} --learner.learning-rate 0", "PPO.learning_rate (0, inf) 0"),
    (f"{PPO} --learner.learning-rate -1", "PPO.learning_rate (0, inf) -1"),
    (f"{PPO} --learner.learning-rate inf", "PPO.learning_rate 'inf' finite"),
    (f"{PPO} --learner.learning-rate lnear:1:0", "PPO.learning_rate 'lnear:1:0' linear"),
    (f"{PPO} --learner.learning-rate linear:1", "PPO.learning_rate 'linear:1' linear:1:0.05"),
    (f"{PPO} --learner.learning-rate linear:1:-1", "PPO.learning_rate [0, inf) -1"),
    (f"{PPO} --learner.learning-rate linear:1:0@0", "PPO.learning_rate horizon 0"),
    (f"{PPO} --learner.epochs 0", "PPO.epochs [1, inf) 0"),
    (f"{PPO} --learner.epochs 2.5", "PPO.epochs whole '2.5'"),
    (f"{PPO} --learner.epochs 1e400", "PPO.epochs whole '1e400'"),
    (f"{PPO} --learner.epochs 100000000000000000000", "PPO.epochs 2^31 100000000000000000000"),
    (f"{PPO} --learner.minibatches 100000", "1024 steps 100000 minibatches=1024"),
    (f"{PPO} --learner.normalise-advantages maybe", "PPO.normalise_advantages true false 'maybe'"),
    (f"{PPO} --learner.network.sizes 0", "MLP at least 1 (0,)"),
    (f"{PPO} --learner.network.sizes -4 64", "MLP at least 1 -4"),
    (f"{PPO} --learner.network.sizes 64 none", "MLP.sizes whole '64 none'"),
    (f"{PPO} --learner.network.sizes 1000000000000", "MLP.sizes 2^31 1000000000000"),
    (f"{PPO} --learner.network.sizes 1000000000 1000000000", "GB network smaller"),
    (f"{PPO} --loop.unroll 0", "OnPolicy.unroll [1, inf) 0"),
    (f"{PPO} --loop.unroll 2e9", "too large smaller"),
    (f"{DQN} --loop.replay.capacity 0", "UniformReplay.capacity [1, inf) 0"),
    (f"{DQN} --loop.replay.capacity 1 --loop.unroll 4", "replay of 1 at least 4"),
    (f"{DQN} --loop.replay.capacity 2e9", "GB replay smaller"),
    (f"{DQN} --loop.replay mlp", "OffPolicy.replay 'mlp' uniform prioritised"),
    (f"{DQN} --loop.replay.frames 4", "frames=4 pictures float32 frames=0"),
    (f"{DQN} --loop.replay.alpha 1", "UniformReplay 'alpha'"),
    ("train per_dqn CartPole-v1 --loop.replay.alpha 2", "PrioritisedReplay.alpha [0, 1] 2"),
    ("train per_dqn CartPole-v1 --loop.replay.beta linear:0.4:1.5", "PrioritisedReplay.beta [0, 1] 1.5"),
    (f"{DQN} --loop.batch-size 0", "OffPolicy.batch_size [1, inf) 0"),
    (f"{DQN} --loop.batch-size 1e30", "OffPolicy.batch_size 2^31"),
    (f"{DQN} --preset none --loop.replay.capacity 32", "replay of 32 batch of 64 at least 64"),
    (f"{DQN} --learner.traces retrace --learner.n-step 3", "traces='retrace' n_step=3 one or the other"),
    (f"{DQN} --learner.traces watkins", "DQN.traces retrace tree_backup 'watkins'"),
    (f"{DQN} --preset none --learner.correction adaptive", "correction='adaptive' n_step=1 larger"),
    (f"{DQN} --learner.outputs c52", "'c52' c51"),
    (f"{DQN} --learner.outputs c51 --learner.outputs.atoms 1", "C51.atoms [2, inf) 1"),
    (f"{DQN} --learner.outputs c51 --learner.outputs.least 100", "C51 100 below 100"),
    (f"{DQN} --learner.burn-in 4", "burn_in=4 memory GRU"),
    (f"{DQN} --learner.head-sizes 0", "head_sizes at least 1 (0,)"),
    ("train c51 Pendulum-v1", "DQN discrete box"),
    ("eval run --episodes 0", "episode at least one 0"),
    ("eval run --episodes 1000000000000", "episode at most 1000000000000"),
    ("eval run --seed -1", "seed 2^32 -1"),
    ("collect run --episodes -1", "episode at least one -1"),
    # Options that hang in the air.
    ("train", "ALGORITHM"),
    ("resume", "RUN"),
    ("plot", "RUN"),
    (f"{PPO} extra", "'extra' --name"),
    (f"{PPO} --steps", "--steps"),
    (f"{PPO} --learner.gamma", "--learner.gamma value"),
    (f"{PPO} --learner 3", "'--learner' --learner.NAME"),
    (f"{PPO} --learner.gamma.x 3", "PPO.gamma 'x'"),
    (f"{PPO} --learner.network.sizes.x 3", "MLP.sizes 'x'"),
    ("resume run extra", "'extra'"),
]


@pytest.mark.parametrize(("command", "fragments"), CASES, ids=[command for command, _ in CASES])
def test_a_bad_request_is_refused_in_one_sentence(refused, command, fragments):
    sentence = refused(*command.split())
    missing = [fragment for fragment in fragments.split() if fragment not in sentence]
    assert not missing, f"{missing} not in: {sentence}"


FILES = [
    ("{", "not JSON"),
    ("[1]", "object learner"),
    ('{"lerner": {}}', "'lerner' learner"),
    ('{"learner": 3}', "'learner' object 3"),
    ('{"steps": "many"}', "'steps' whole 'many'"),
    ('{"steps": true}', "'steps' whole True"),
    ('{"steps": 1e999}', "'steps' whole inf"),
    ('{"num_envs": 1.5}', "'num_envs' whole 1.5"),
    ('{"learner": {"gamma": true}}', "PPO.gamma True"),
    ('{"learner": {"epochs": null}}', "PPO.epochs whole None"),
    ('{"learner": {"learning_rate": 1e999}}', "PPO.learning_rate inf"),
    ('{"learner": {"learning_rate": NaN}}', "PPO.learning_rate nan"),
    ('{"learner": {"epochs": 1' + "0" * 400 + "}}", "PPO.epochs 2^31"),
    ('{"learner": {"network": {"class": "MLP", "sizes": 3}}}', "MLP.sizes list 3"),
    ('{"learner": {"network": {"class": "os.system"}}}', "PPO.network 'os.system'"),
    ('{"learner": {"normalise_advantages": 3}}', "PPO.normalise_advantages true false 3"),
    ('{"learner": {"network": {"class": "MLP", "activation": 3}}}', "MLP.activation 3"),
    ("\x00\x01", "not JSON"),
]


@pytest.mark.parametrize(("text", "fragments"), FILES, ids=[text[:40] for text, _ in FILES])
def test_a_bad_configuration_file_is_refused(refused, workplace, text, fragments):
    (workplace / "options.json").write_text(text, encoding="utf-8")
    sentence = refused(*PPO.split(), "--config", "options.json")
    assert not [fragment for fragment in fragments.split() if fragment not in sentence], sentence


def test_a_configuration_file_that_is_none(refused, workplace):
    (workplace / "binary").write_bytes(b"\xff\xfe\x00")
    (workplace / "folder").mkdir()
    assert "nowhere.json" in refused(*PPO.split(), "--config", "nowhere.json")
    assert "not JSON" in refused(*PPO.split(), "--config", "binary")
    assert "cannot be read" in refused(*PPO.split(), "--config", "folder")


def test_a_missing_extra_is_named(refused, monkeypatch):
    from rewardtogo.runner import sinks

    def absent(module):
        raise ImportError(module)

    monkeypatch.setattr(sinks.importlib, "import_module", absent)
    assert "rewardtogo[wandb]" in refused(*PPO.split(), "--wandb")
    assert "rewardtogo[tensorboard]" in refused(*PPO.split(), "--tensorboard")


def test_a_run_that_does_not_fit_is_refused_and_leaves_nothing(refused, monkeypatch):
    """What only the compiler finds out: how much an iteration takes."""
    from rewardtogo.runner.engine import Program

    def compile(self, *_, **__):
        return self.guarded(lambda: self.nothing())

    def exhausted(self):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8000000000000 bytes.")

    monkeypatch.setattr(Program, "_compile", compile)
    monkeypatch.setattr(Program, "nothing", exhausted, raising=False)
    for more in ((), ("--out", "mine"), ("--num-seeds", "2"), ("--num-seeds", "2", "--out", "mine")):
        sentence = refused(*PPO.split(), *more)
        assert "8000000000000 bytes" in sentence and "smaller" in sentence


def test_there_are_sixty_cases_and_more():
    assert len({*CASES, *FILES}) >= 60
