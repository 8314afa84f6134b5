"""DDPG, TD3, SAC, NAF and Q-learning with searched actions: targets and gradients against float64 by hand, and reductions."""

from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import first_gradient, jit
from rewardtogo.core import Batch, Environment, EnvSpec, Timestep, Transition, env_spec, from_space
from rewardtogo.data import Dataset
from rewardtogo.envs.probes import QuadraticReward
from rewardtogo.envs.reward_wrappers import ScaleReward
from rewardtogo.envs.time_limit import TimeLimit
from rewardtogo.loops import RandomPolicy, begin
from rewardtogo.ops import Linear
from rewardtogo.runner.config import build, describe
from rewardtogo.value.critics import Critics, from_units, to_units
from rewardtogo.value.naf import NAFNetwork

KEY = jax.random.key(0)
LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)
CENTRE, HALF = (LOW + HIGH) / 2, (HIGH - LOW) / 2
SPEC = EnvSpec(from_space(spaces.Box(-9, 9, (3,), np.float32)), from_space(spaces.Box(LOW, HIGH)))
NET = rtg.MLP(5)
GAMMA = 0.9
rng = np.random.default_rng(0)
S, NEXT = rng.normal(size=(4, 3)).astype(np.float32), rng.normal(size=(4, 3)).astype(np.float32)
A = rng.uniform(LOW, HIGH, (4, 2)).astype(np.float32)
R = np.array([0.5, -1.0, 2.0, 0.0], np.float32)
TERMINATED, TRUNCATED = np.array([False, True, False, False]), np.array([False, False, True, False])
WEIGHTS = np.array([1.0, 0.5, 2.0, 1.0], np.float32)


def batch() -> Batch:
    t = Transition(*(jnp.asarray(x) for x in (S, A, R, TERMINATED, TRUNCATED, NEXT)), {})
    return Batch(t, jnp.arange(4, dtype=jnp.int32), jnp.asarray(WEIGHTS))


def shaken(state: Any, seed: int = 1) -> Any:
    """The state with other numbers in all networks, targets unlike what they follow: fresh ones are too near 0 to tell cases apart."""
    noise = np.random.default_rng(seed)
    shake = lambda x: jnp.asarray(x + 0.7 * noise.normal(size=x.shape), jnp.float32)  # noqa: E731
    names = [n for n in ("actor", "critics", "target_actor", "target_critics", "network", "target") if n in vars(state)]
    for name in names:
        state = eqx.tree_at(lambda s: getattr(s, name), state, jax.tree.map(shake, getattr(state, name)))  # noqa: B023
    return state


def dense(layers: Any, head: Any, x: np.ndarray) -> np.ndarray:
    """An MLP with tanh, in float64."""
    for layer in layers:
        x = np.tanh(x @ np.float64(layer.weight).T + np.float64(layer.bias))
    return x @ np.float64(head.weight).T + np.float64(head.bias)


def mu(actor: Any, s: np.ndarray) -> np.ndarray:
    """The deterministic action, in units."""
    return np.tanh(dense(actor.torso.layers, actor.head, np.float64(s)))


def q_of(critics: Any, s: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Q of every critic, `[E, N]`."""
    x = np.concatenate([units, s], -1)
    one = lambda e: dense(*jax.tree.map(lambda w: w[e], (critics.each.torso.layers, critics.each.head)), x)[..., 0]  # noqa: E731
    return np.stack([one(e) for e in range(critics.number)])


UNITS = (A - CENTRE) / HALF


def update(learner: Any, state: Any) -> Any:
    return jax.device_get(jit(lambda s, b: learner.update(s, b, KEY))(state, batch()))


# --- boxes ------------------------------------------------------------------------------------------------------------


def test_boxes_become_units_and_come_back():
    np.testing.assert_allclose(to_units(SPEC.action, jnp.asarray(A)), UNITS, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(from_units(SPEC.action, jnp.asarray(UNITS, jnp.float32)), A, rtol=1e-6, atol=1e-6)
    assert from_units(SPEC.action, jnp.full((5, 2), 1.0000001)).max(0).tolist() == [2.0, 10.0]


LEARNERS = {"DDPG": rtg.DDPG, "TD3": rtg.TD3, "SAC": rtg.SAC, "NAF": rtg.NAF, "CEMQ": rtg.CEMQ}
each_learner = pytest.mark.parametrize("name", LEARNERS)


@each_learner
@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=repr)
def test_choices_are_refused(name, space):
    with pytest.raises(ValueError, match=f"{name} chooses box actions, and this environment wants"):
        LEARNERS[name]().init(EnvSpec(SPEC.observation, from_space(space)), KEY)


@pytest.mark.parametrize("name", ["DDPG", "TD3", "SAC", "CEMQ"])
def test_boxes_without_bounds_are_refused(name):
    open_box = from_space(spaces.Box(np.array([-1, 0], np.float32), np.array([1, np.inf], np.float32)))
    with pytest.raises(
        ValueError, match=rf"{name} chooses actions between bounds, and entry \[1\] .* lies in \[0, inf\]"
    ):
        LEARNERS[name]().init(EnvSpec(SPEC.observation, open_box), KEY)


@each_learner
def test_boxes_without_room_are_refused(name):
    for low, high, sentence in (([0.0, 1.0], [1.0, 1.0], r"take entry \[1\] out"), ([], [], "actions without entries")):
        box = from_space(spaces.Box(np.array(low, np.float32), np.array(high, np.float32)))
        with pytest.raises(ValueError, match=sentence):
            LEARNERS[name](network=NET).init(EnvSpec(SPEC.observation, box), KEY)


@each_learner
def test_several_steps_and_a_memory_are_refused_together(name):
    with pytest.raises(ValueError, match="n_step=3 takes steps out of their sequence"):
        LEARNERS[name](network=rtg.GRU(4), n_step=3)


def test_naf_takes_boxes_without_bounds():
    free = EnvSpec(SPEC.observation, from_space(spaces.Box(-np.inf, np.inf, (2,), np.float32)))
    learner = rtg.NAF(network=NET)
    state = shaken(learner.init(free, KEY), 5)
    policy = learner.policy(state, explore=False)
    actions = jax.vmap(lambda s: policy(policy.init(KEY), s, KEY)[1])(9 * jnp.asarray(S))
    assert np.abs(actions).max() > 1.0  # not squashed


# --- DDPG -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["target", "online"])
def test_ddpg_targets_are_those_worked_out_by_hand(form, item):
    learner = rtg.DDPG(network=NET, gamma=GAMMA, target_policy=form, target_rate=0.25)
    state = shaken(learner.init(SPEC, KEY))
    new, metrics, priorities = update(learner, state)
    q = q_of(state.critics, S, UNITS)[0]
    y = {
        name: R + GAMMA * (1 - TERMINATED) * q_of(state.target_critics, NEXT, mu(actor, NEXT))[0]
        for name, actor in (("target", state.target_actor), ("online", state.actor))
    }
    with item("6.25") as check:
        check(
            np.abs(priorities - np.abs(q - y[form])).max(),
            "<=",
            1e-5,
            f"errors with the next action of the {form} actor",
        )
        # The two forms of erratum E6.6 are not the same.
        check(
            np.abs(y["target"] - y["online"]).max(), ">", 0.1, "difference of the text's target and of Algorithm 14's"
        )
    assert float(metrics["q_loss"]) == pytest.approx(np.mean(WEIGHTS * 0.5 * (q - y[form]) ** 2), rel=1e-4)
    for target, old, online in (
        (new.target_critics, state.target_critics, new.critics),
        (new.target_actor, state.target_actor, new.actor),
    ):
        jax.tree.map(lambda t, o, n: np.testing.assert_allclose(t, 0.75 * o + 0.25 * n, atol=1e-6), target, old, online)


def test_ddpg_actor_gradient_is_that_of_finite_differences(item):
    """Step 6 of Algorithm 14: dQ/da is taken at the actor's own action (erratum E6.6), not at the one in the replay."""
    learner = rtg.DDPG(network=NET, gamma=GAMMA, max_grad_norm=1e9)
    state = shaken(learner.init(SPEC, KEY))
    new, _, _ = update(learner, state)
    found = -np.asarray(first_gradient(new.actor_optimiser, new.actor).torso.layers[0].weight, np.float64)
    weight = np.float64(state.actor.torso.layers[0].weight)

    def differences(objective: Any, h: float = 1e-5) -> np.ndarray:
        slope = np.zeros_like(weight)
        for index in np.ndindex(*weight.shape):
            ends = []
            for sign in (1, -1):
                moved = weight.copy()
                moved[index] += sign * h
                ends.append(objective(eqx.tree_at(lambda a: a.torso.layers[0].weight, state.actor, moved)))
            slope[index] = (ends[0] - ends[1]) / (2 * h)
        return slope

    right = differences(lambda actor: q_of(new.critics, S, mu(actor, S))[0].mean())
    step = 1e-5 * np.eye(2)
    at_replay = np.stack(
        [(q_of(new.critics, S, UNITS + d)[0] - q_of(new.critics, S, UNITS - d)[0]) / 2e-5 for d in step], -1
    )
    wrong = differences(lambda actor: (mu(actor, S) * at_replay).sum(-1).mean())
    size = np.abs(right).max()
    with item("6.25") as check:
        check(np.abs(found - right).max() / size, "<=", 1e-4, "actor's gradient against finite differences, relative")
        check(
            np.abs(found - wrong).max() / size, ">", 0.1, "dQ/da at the replay's action instead (E6.6): relative error"
        )


# --- TD3 --------------------------------------------------------------------------------------------------------------


def test_td3_takes_the_least_of_its_critics():
    learner = rtg.TD3(network=NET, gamma=GAMMA, smoothing=0.0)
    state = shaken(learner.init(SPEC, KEY))
    level = q_of(state.target_critics, NEXT, mu(state.target_actor, NEXT)).mean(1, keepdims=True)
    bias = lambda s: s.target_critics.each.head.bias  # noqa: E731
    state = eqx.tree_at(bias, state, bias(state) - jnp.asarray(level, jnp.float32))
    _, metrics, priorities = update(learner, state)
    following = q_of(state.target_critics, NEXT, mu(state.target_actor, NEXT))
    assert len({*following.argmin(0).tolist()}) == 2  # either is the least somewhere
    y = R + GAMMA * (1 - TERMINATED) * following.min(0)
    errors = q_of(state.critics, S, UNITS) - y
    np.testing.assert_allclose(priorities, np.abs(errors).mean(0), atol=1e-5)
    assert float(metrics["q_loss"]) == pytest.approx((WEIGHTS * 0.5 * errors**2).mean(), rel=1e-4)


def test_td3_smooths_within_its_limit():
    """With huge noise the target's action is a limit off, up or down, in each entry, unless the box ends before."""
    learner = rtg.TD3(network=NET, gamma=1.0, smoothing=1e6, smoothing_limit=0.25, critics=1)
    state = shaken(learner.init(SPEC, KEY))
    _, _, priorities = update(learner, state)
    chosen = mu(state.target_actor, NEXT)
    corners = [np.clip(chosen + 0.25 * np.array(d), -1, 1) for d in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    q = q_of(state.critics, S, UNITS)[0]
    possible = np.stack([np.abs(q - R - (1 - TERMINATED) * q_of(state.target_critics, NEXT, c)[0]) for c in corners])
    np.testing.assert_allclose(np.abs(possible - priorities).min(0), 0, atol=1e-5)


def test_td3_moves_actor_and_targets_every_other_update():
    learner = rtg.TD3(network=NET, policy_delay=2)
    step = jit(lambda s, b: learner.update(s, b, KEY)[0])
    states = [shaken(learner.init(SPEC, KEY))]
    for _ in range(4):
        states.append(step(states[-1], batch()))
    first = lambda part, i: jax.tree.leaves(getattr(states[i], part))[0]  # noqa: E731
    moved = lambda part, i: not np.array_equal(first(part, i), first(part, i - 1))  # noqa: E731
    for part in ("actor", "target_actor", "target_critics"):
        assert [moved(part, i) for i in (1, 2, 3, 4)] == [False, True, False, True], part
    assert all(moved("critics", i) for i in (1, 2, 3, 4))


def test_td3_without_its_three_mends_is_ddpg():
    results = []
    for learner in (
        rtg.DDPG(network=NET, gamma=GAMMA),
        rtg.TD3(network=NET, gamma=GAMMA, critics=1, smoothing=0.0, policy_delay=1),
    ):
        state = shaken(learner.init(SPEC, KEY))
        step = jit(lambda s, b: learner.update(s, b, KEY)[0])  # noqa: B023
        results.append(jax.device_get(step(step(state, batch()), batch())))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), *results)


# --- SAC --------------------------------------------------------------------------------------------------------------


def test_sac_targets_are_soft(item):
    """With a standard deviation of e^-10 the action is known, and the temperature only adds its share of the entropy."""
    actor = rtg.SAC(network=NET).init(SPEC, KEY).actor
    weight = 0.5 * jnp.ones((4, 5)) * jnp.asarray([[1.0], [1.0], [0.0], [0.0]])
    bias = jnp.asarray([0.3, -0.2, -99.0, -99.0])
    tight = eqx.tree_at(lambda a: (a.head.weight, a.head.bias), actor, (weight, bias))
    found = {}
    for alpha in (1e-9, 0.5):
        learner = rtg.SAC(network=NET, gamma=GAMMA, temperature=alpha, learn_temperature=False)
        state = eqx.tree_at(lambda s: s.actor, shaken(learner.init(SPEC, KEY)), tight)
        # Rewards so large that errors have a known sign.
        b = eqx.tree_at(lambda b: b.transitions.reward, batch(), jnp.asarray(R + 1000.0))
        priorities = np.asarray(jit(lambda s, b: learner.update(s, b, KEY)[2])(state, b))  # noqa: B023
        found[alpha] = priorities + q_of(state.critics, S, UNITS).mean(0)
    outputs = dense(tight.torso.layers, tight.head, NEXT)[:, :2]
    following = q_of(state.target_critics, NEXT, np.tanh(outputs)).min(0)
    hard = R + 1000.0 + GAMMA * (1 - TERMINATED) * following
    entropy = (found[0.5] - found[1e-9]) / 0.5
    # -log p of N(u, e^-20) at u + e^-10 eps, squashed: 10 less than 2 log sqrt(2 pi) - eps^2 / 2, and the squashing's part.
    squash = np.log1p(-(np.tanh(outputs) ** 2)).sum(-1)
    rest = entropy / GAMMA - squash - 2 * (-10.0 + 0.5 * np.log(2 * np.pi))
    with item("6.28") as check:
        check(np.abs(found[1e-9] - hard).max(), "<=", 2e-3, "SAC without a temperature: target against the one by hand")
        check(np.abs(entropy[TERMINATED]).max(), "<=", 1e-3, "no entropy after a terminal state")
        check(rest[~TERMINATED].min(), ">=", -1e-2, "what is left of -log p, eps^2 / 2 summed, is not negative")
        check(rest[~TERMINATED].max(), "<=", 12.0, "and no more than noise can be")


def test_the_temperature_goes_where_the_entropy_is_wanted():
    moves = []
    for wanted in (-50.0, 50.0):
        learner = rtg.SAC(network=NET, entropy_per_entry=wanted, temperature=0.3, temperature_learning_rate=0.01)
        new, metrics, _ = update(learner, shaken(learner.init(SPEC, KEY)))
        assert float(metrics["temperature"]) == pytest.approx(0.3, rel=1e-5)
        moves.append(float(new.log_temperature) - np.log(0.3))
    # Too much entropy, a lower temperature; too little, a higher one; Adam's first step is its rate.
    np.testing.assert_allclose(moves, [-0.01, 0.01], rtol=1e-3)


# --- NAF --------------------------------------------------------------------------------------------------------------


def test_naf_knows_its_maximum_exactly(item):
    """Erratum E6.7: Q = V - 1/2 (a - mu)^T L L^T (a - mu), L lower triangular with an exponential on its diagonal."""
    network = shaken(rtg.NAF(network=NET).init(SPEC, KEY)).network
    q = jax.vmap(lambda s: network.read(network.torso((), s)[1]))(jnp.asarray(5 * S))
    at = jax.vmap(lambda q, a: q(a))
    factor, mean = np.float64(q.factor), np.float64(q.mean)
    others = np.random.default_rng(2).uniform(-1, 1, (500, 2)).astype(np.float32)
    with item("6.24") as check:
        check(np.abs(at(q, q.mean) - q.value).max(), "==", 0.0, "Q(s, mu(s)) - V(s)")
        slope = jax.vmap(lambda q: jax.grad(lambda a: q(a))(q.mean))(q)
        check(np.abs(slope).max(), "==", 0.0, "dQ/da at mu(s)")
        best = np.stack([at(q, jnp.broadcast_to(a, (4, 2))) for a in others]).max(0)
        check((best - q.value).max(), "<", 0.0, "Q of 500 other actions against V")
        check(np.abs(factor[:, 0, 1]).max(), "==", 0.0, "above the diagonal of L")
        check(np.linalg.eigvalsh(factor @ factor.swapaxes(1, 2)).min(), ">", 0.0, "least eigenvalue of L L^T")
    d = UNITS - mean
    by_hand = q.value - 0.5 * np.einsum("ni,nij,nkj,nk->n", d, factor, factor, d)
    np.testing.assert_allclose(at(q, jnp.asarray(UNITS, jnp.float32)), by_hand, rtol=1e-5)


def test_naf_targets_are_those_worked_out_by_hand():
    learner = rtg.NAF(network=NET, gamma=GAMMA)
    state = shaken(learner.init(SPEC, KEY))
    _, _, priorities = update(learner, state)
    read = lambda n, s: jax.vmap(lambda s: n.read(n.torso((), s)[1]))(jnp.asarray(s))  # noqa: E731
    q = jax.vmap(lambda q, a: q(a))(read(state.network, S), jnp.asarray(UNITS, jnp.float32))
    y = R + GAMMA * (1 - TERMINATED) * np.asarray(read(state.target, NEXT).value)
    np.testing.assert_allclose(priorities, np.abs(q - y), rtol=1e-4, atol=1e-5)


def test_naf_of_three_entries_has_six_numbers_for_its_factor():
    spec = EnvSpec(SPEC.observation, from_space(spaces.Box(-1, 1, (3,), np.float32)))
    network = NAFNetwork.of(NET, spec, KEY)
    factor = np.asarray(network.read(jnp.ones(5)).factor)
    assert network.factor_head.bias.shape == (6,)
    assert np.count_nonzero(factor) == 6 and np.array_equal(factor, np.tril(factor))


# --- Q with a search --------------------------------------------------------------------------------------------------


def test_searched_targets_are_the_largest_q(item):
    """Against a fine grid of the same target critics."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 81)] * 2), -1).reshape(-1, 2)
    with item("6.23") as check:
        for maximiser in (rtg.Sampled(4000), rtg.Ascent(16, 40), rtg.CEM(8, 64, 8)):
            learner = rtg.CEMQ(network=NET, gamma=GAMMA, maximiser=maximiser)
            state = shaken(learner.init(SPEC, KEY))
            b = eqx.tree_at(lambda b: b.transitions.reward, batch(), jnp.asarray(R + 1000.0))
            priorities = jit(lambda s, b: learner.update(s, b, KEY)[2])(state, b)  # noqa: B023
            y = priorities + q_of(state.critics, S, UNITS).mean(0)
            best = np.array(
                [q_of(state.target_critics, np.repeat(s[None], len(grid), 0), grid).min(0).max() for s in NEXT]
            )
            error = np.abs(y - (R + 1000.0 + GAMMA * (1 - TERMINATED) * best)).max()
            check(error, "<=", 0.02, f"{type(maximiser).__name__}: target against the largest on a grid")


# --- memories, and critics of all kinds -------------------------------------------------------------------------------


def test_replayed_values_are_those_of_acting():
    """With a memory: what the critics see along a stored sequence is what they saw when acting, to the bit of float32."""
    learner = rtg.TD3(network=rtg.GRU(4, rtg.MLP(3)), noise=rtg.OU())
    env = rtg.make("Pendulum-v1", 2)
    loop = rtg.OffPolicy(env, learner, rtg.UniformReplay(40), unroll=4, warm_up=24, batch_size=3, length=5)

    def compare(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = loop.init(key)
        batch = loop.replay.sample_sequences(state.replay, key, 3, 5)
        t, critics = batch.transitions, state.learner.critics
        first = jax.tree.map(lambda x: x[0], t.extras["carry"])
        along = critics.see_along(first.policy.critics, t)[0]
        acted = jax.vmap(jax.vmap(lambda c, o: critics.see(c, o)))(t.extras["carry"].policy.critics, t.observation)
        return along, jnp.moveaxis(acted, 2, 0)

    along, acted = jit(compare)(KEY)
    np.testing.assert_allclose(along, acted, atol=1e-6)
    assert np.abs(along).max() > 0.01


def test_critics_read_everything_together():
    """A dictionary of a picture, a choice and numbers, a bare module, and a memory: Q depends on every part of it and on the action."""
    mixed = spaces.Dict(
        picture=spaces.Box(0, 255, (8, 8, 1), np.uint8),
        choice=spaces.Discrete(3),
        numbers=spaces.Box(-1, 1, (2,), np.float32),
    )
    spec = EnvSpec(from_space(mixed), SPEC.action)
    o = {"picture": jnp.zeros((8, 8, 1), jnp.uint8), "choice": jnp.asarray(0), "numbers": jnp.zeros(2)}
    changes = {"picture": jnp.full((8, 8, 1), 200, jnp.uint8), "choice": jnp.asarray(2), "numbers": jnp.ones(2)}
    for network in (rtg.CNN((4,), (4,), (2,), (16,)), rtg.GRU(8, rtg.CNN((4,), (4,), (2,), (16,)))):
        critics = Critics.of(network, spec, KEY, 2)
        look = jit(lambda o, a: critics(critics.see(critics.init(), o), a))  # noqa: B023
        base = look(o, jnp.zeros(2))
        assert base.shape == (2,)
        for name, other in changes.items():
            assert np.any(look(o | {name: other}, jnp.zeros(2)) != base), name
        assert np.any(look(o, jnp.ones(2)) != base)
    bare = Critics.of(rtg.nn.Custom(lambda spec, key: eqx.nn.Linear(3, 4, key=key)), SPEC, KEY, 2)
    q = bare(bare.see((), jnp.ones(3)), jnp.zeros(2)), bare(bare.see((), jnp.ones(3)), jnp.ones(2))
    assert np.any(q[0] != q[1])


def test_noises_and_searches_are_plain_data_and_back():
    learner = rtg.CEMQ(maximiser=rtg.Ascent(3, newton=True), noise=rtg.OU(0.3, dt=0.5))
    data = describe(learner)
    assert data["noise"] == {"class": "OU", "sigma": 0.3, "theta": 0.15, "dt": 0.5}
    again = build(rtg.CEMQ, data)
    assert describe(again) == data and isinstance(again.maximiser, rtg.Ascent)
    named = build(rtg.TD3, {"noise": {"class": "ou", "sigma": "linear:0.4:0.1"}})
    assert named.noise.sigma == Linear(0.4, 0.1)


# --- what they learn --------------------------------------------------------------------------------------------------


class Regulator(Environment):
    """s' = 0.9 s + 0.5 u + noise, r = -(s^2 + 0.2 u^2), cut after 20 steps: its best policy is u = -K s."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-2.0, 2.0, (1,), np.float32)

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        state = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return state, state

    def step(self, state: Any, action: Any, key: jax.Array) -> tuple[Any, Timestep]:
        reward = -(state[0] ** 2 + 0.2 * action[0] ** 2)
        state = 0.9 * state + 0.5 * action + 0.05 * jax.random.normal(key, (1,))
        never = jnp.zeros((), bool)
        return state, Timestep(state, reward, never, never, state, {})


def regulator_gain(gamma: float) -> float:
    """K of the discounted Riccati equation, by iterating it."""
    p = 0.0
    for _ in range(500):
        gain = gamma * 0.9 * 0.5 * p / (0.2 + gamma * 0.25 * p)
        p = 1.0 + 0.2 * gain**2 + gamma * p * (0.9 - 0.5 * gain) ** 2
    return gain


def test_ddpg_finds_the_linear_quadratic_gain_and_the_argmax(item):
    """Item 6.25: the gain of the exact solution. Item 6.27: DDPG is DQN with a learned argmax, so that mu(s) is the best action of Q."""
    gamma, iterations = 0.9, 10_000
    learner = rtg.DDPG(
        network=rtg.MLP(32, 32), gamma=gamma, learning_rate=Linear(3e-3, 1e-4), actor_learning_rate=Linear(1e-3, 1e-4),
        noise=rtg.Gaussian(0.3), target_rate=0.02,
    )  # fmt: skip
    env = rtg.vectorize(TimeLimit(Regulator(), 20), 4)
    loop = rtg.OffPolicy(
        env, learner, rtg.UniformReplay(20_000), unroll=1, updates=4, batch_size=64, warm_up=1000
    ).with_horizon(iterations)
    grid = jnp.linspace(-1, 1, 801)

    def train(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        step = lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0]  # noqa: E731
        state = jax.lax.fori_loop(0, iterations, step, loop.init(key))
        policy = loop.policy(state)
        _, rollout, _ = rtg.collect(env, policy, begin(env, policy, key), key, 100)
        seen = rollout.transitions.observation.reshape(-1, 1)
        chosen = jax.vmap(lambda s: policy.inspect(policy.init(key), s)["mean"][0])(seen)
        q = jax.vmap(lambda s: jax.vmap(lambda u: state.learner.critics(s, u[None])[0])(grid))(seen)
        return seen[:, 0], chosen, 2.0 * grid[q.argmax(1)]

    seen, chosen, best = jax.device_get(jit(train)(KEY))
    gain = -(seen * chosen).sum() / (seen * seen).sum()
    with item("6.25") as check:
        check(abs(gain / regulator_gain(gamma) - 1), "<=", 0.05, "gain of the linear-quadratic problem, relative error")
    with item("6.27") as check:
        near = np.mean(np.abs(chosen - best) < 0.05)
        check(
            near, ">=", 0.95, "share of visited states with |mu(s) - argmax_a Q(s, a)| < 0.05, by a grid over the box"
        )


class Ends(Environment):
    """Two probes in one: an episode of one step with reward 1, and a loop of reward 1 that is cut after 10 steps."""

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: jax.Array) -> tuple[Any, Any]:
        kind = jax.random.bernoulli(key, 0.5).astype(jnp.float32)[None]
        return (kind, jnp.zeros((), jnp.int32)), kind

    def step(self, state: Any, action: Any, key: jax.Array) -> tuple[Any, Timestep]:
        kind, taken = state
        loops = kind[0] > 0
        step = Timestep(kind, jnp.ones(()), ~loops, loops & (taken >= 9), kind, {})
        return (kind, taken + 1), step


@each_learner
def test_an_end_is_worth_nothing_and_a_cut_changes_nothing(name, item):
    options = {"temperature": 1e-6, "learn_temperature": False} if name == "SAC" else {}
    learner = LEARNERS[name](
        network=rtg.MLP(8),
        gamma=GAMMA,
        learning_rate=Linear(2e-2, 1e-4),
        target_rate=0.1,
        max_grad_norm=10.0,
        **options,
    )
    loop = rtg.OffPolicy(
        rtg.vectorize(Ends(), 4), learner, rtg.UniformReplay(400), unroll=4, updates=4, batch_size=32, warm_up=200
    ).with_horizon(250)

    def train(key: jax.Array) -> jax.Array:
        step = lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0]  # noqa: E731
        policy = loop.policy(jax.lax.fori_loop(0, 250, step, loop.init(key)))
        return jnp.stack([policy.inspect(policy.init(key), jnp.full(1, kind))["value"] for kind in (0.0, 1.0)])

    value = np.asarray(jit(train)(KEY))
    with item("1.25") as check:
        for found, exact, what in zip(value, (1.0, 1 / (1 - GAMMA)), ("an end", "a cut"), strict=True):
            check(abs(found / exact - 1), "<=", 0.03, f"{name}: relative error of V before {what}")


def test_sac_comes_to_the_entropy_that_is_asked_for(item):
    """On one step with r = -20 (a - 0.5)^2: the mean goes to the best action, and the entropy to -1 nat for its one entry."""
    learner = rtg.SAC(network=rtg.MLP(16), learning_rate=1e-2, actor_learning_rate=3e-3, temperature_learning_rate=1e-2)
    env = rtg.vectorize(ScaleReward(QuadraticReward(0.5), 20.0), 4)
    loop = rtg.OffPolicy(env, learner, rtg.UniformReplay(4000), unroll=4, updates=4, batch_size=64, warm_up=1000)
    loop = loop.with_horizon(600)

    def train(key: jax.Array) -> Any:
        step = lambda i, s: loop.step(s, jax.random.fold_in(key, i))[0]  # noqa: E731
        policy = loop.policy(jax.lax.fori_loop(0, 600, step, loop.init(key)))
        return policy.inspect(policy.init(key), jnp.zeros(1))

    found = jax.device_get(jit(train)(KEY))
    with item("6.28") as check:
        check(abs(found["entropy"] + 1.0), "<=", 0.1, "SAC: entropy against the one asked for, -1")
        check(abs(found["mean"][0] - 0.5), "<=", 0.06, "SAC: action against the best, 0.5")


@each_learner
def test_learns_from_a_dataset(name):
    """Offline on 64 random steps of Pendulum: the same update without an environment; two of them from sequences."""
    env = rtg.make("Pendulum-v1", 1)
    spec = env_spec(env)
    policy = RandomPolicy(spec)
    t = rtg.collect(env, policy, begin(env, policy, KEY), KEY, 64)[1].transitions
    t = jax.tree.map(lambda x: x[:, 0], t)
    t = eqx.tree_at(lambda t: t.truncated, t, t.truncated.at[-1].set(True))
    network = rtg.GRU(3, rtg.MLP(3)) if name in ("DDPG", "NAF") else rtg.MLP(4)
    loop = rtg.Offline(Dataset.of(t, spec), LEARNERS[name](network=network), batch_size=4, updates=2, length=3)
    state, (metrics, _) = jit(lambda k: loop.step(loop.init(k), k))(KEY)
    assert all(np.isfinite(v) for v in metrics.values()), metrics
    assert int(state.learner.updates) == 2
