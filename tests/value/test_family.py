"""The DQN family: heads, outputs, corrections and traces, each against the same thing written another way."""

import dataclasses
from typing import Any

import equinox as eqx
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit, lstm
from rewardtogo.core import Batch, EnvSpec, Transition, from_space
from rewardtogo.nn import NoisyLinear, perturbed
from rewardtogo.ops import categorical_projection, compress, expand, quantile_huber
from rewardtogo.value.dqn import DQNState
from rewardtogo.value.q_network import QHead, greedy_probabilities

KEY = jax.random.key(0)
SPEC = EnvSpec(from_space(spaces.Box(-9, 9, (2,), np.float32)), from_space(spaces.Discrete(3)))
T, N, GAMMA = 5, 4, 0.9
LINEAR = rtg.MLP()


def sequences(carry: Any = None) -> Batch:
    """Random steps `[T, N]` in which an episode ends, one is cut, and probabilities are kept."""
    rng = np.random.default_rng(3)
    seen = rng.normal(size=(T + 1, N, 2)).astype(np.float32)
    terminated, truncated = np.zeros((T, N), bool), np.zeros((T, N), bool)
    terminated[2, 0] = truncated[1, 1] = True
    extras: dict[str, Any] = {"log_prob": jnp.log(jnp.asarray(rng.uniform(0.3, 0.9, (T, N)), jnp.float32))}
    if carry is not None:
        extras["carry"] = jax.tree.map(lambda x: jnp.broadcast_to(x, (T, N, *x.shape)) + 0.1, carry)
    arrays = (seen[:-1], rng.integers(0, 3, (T, N)).astype(np.int32), rng.normal(size=(T, N)).astype(np.float32))
    t = Transition(*(jnp.asarray(x) for x in (*arrays, terminated, truncated, seen[1:])), extras)
    return Batch(t, jnp.zeros(N, jnp.int32), jnp.ones(N))


def flat(batch: Batch) -> Batch:
    """The same steps as transitions `[T N]`."""
    t = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch.transitions)
    return Batch(t, jnp.zeros(T * N, jnp.int32), jnp.ones(T * N))


def begun(learner: rtg.DQN) -> DQNState:
    """A state whose target is another network."""
    state = learner.init(SPEC, KEY)
    return eqx.tree_at(lambda s: s.target, state, learner.init(SPEC, jax.random.key(1)).network)


def learn(learner: rtg.DQN, batch: Batch, state: DQNState | None = None) -> tuple[Any, dict[str, jax.Array], Any]:
    return jit(lambda s, b: learner.update(s, b, KEY))(begun(learner) if state is None else state, batch)


def table(network: Any, observation: jax.Array) -> np.ndarray:
    """Outputs at any number of observations, without a memory."""
    lead = observation.shape[:-1]
    found = jax.vmap(lambda o: network((), o)[1])(observation.reshape(-1, 2))
    return np.asarray(found).reshape(*lead, *found.shape[1:])


# --- heads -----------------------------------------------------------------------------------------------------------


def test_dueling_streams_add_up(item):
    head = QHead.of(4, 3, 2, KEY, (5,), dueling=True, noisy=False)
    x = jax.random.normal(KEY, (4,))
    through = lambda layers: layers[1](jax.nn.relu(layers[0](x)))  # noqa: E731
    value, advantage = through(head.value), through(head.layers).reshape(3, 2)
    with item("6.28") as check:
        expected = value[None] + advantage - advantage.mean(0, keepdims=True)
        check(np.abs(head(x) - expected).max(), "<=", 1e-6, "Q = V + A - mean A")
        check(np.abs(head(x).mean(0) - value).max(), "<=", 1e-6, "the mean over actions is V")


def test_noise_is_factorised():
    layer = NoisyLinear.of(3, 4, KEY, sigma=0.6)
    drawn = layer.sample(KEY)
    noise = np.asarray((drawn.weight - layer.mean.weight) / layer.spread.weight)
    assert np.linalg.matrix_rank(noise, tol=1e-4) == 1
    np.testing.assert_allclose(layer.spread.weight, 0.6 / np.sqrt(3), rtol=1e-6)
    # f(x) = sign(x) sqrt|x| of a normal number has mean 0 and second moment E|x|.
    many = jax.vmap(lambda k: layer.sample(k).bias / layer.spread.bias)(jax.random.split(KEY, 4000))
    np.testing.assert_allclose((many**2).mean(), np.sqrt(2 / np.pi), rtol=0.05)
    np.testing.assert_allclose(many.mean(), 0.0, atol=0.03)
    gradient = jax.grad(lambda layer: layer.sample(KEY)(jnp.ones(3)).sum())(layer)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))


def test_noise_is_for_exploring_only():
    learner = rtg.DQN(network=LINEAR, noisy=True, epsilon=0.0)
    state, o = learner.init(SPEC, KEY), jnp.asarray([0.3, -0.2])
    act = lambda policy: jax.vmap(lambda k: policy((), o, k)[1])(jax.random.split(KEY, 200))  # noqa: E731
    explored, greedy = jit(lambda s: (act(learner.policy(s, True)), act(learner.policy(s, False))))(state)
    assert len(set(np.asarray(explored).tolist())) > 1
    assert set(np.asarray(greedy).tolist()) == {int(jnp.argmax(state.network((), o)[1][:, 0]))}
    quiet = rtg.MLP(3).build(SPEC.observation, KEY)
    jax.tree.map(np.testing.assert_array_equal, perturbed(quiet, KEY), quiet)


# --- outputs ---------------------------------------------------------------------------------------------------------


def test_distributions_are_learnt_from_their_targets():
    """Loss of C51 and of quantiles, against loops over a batch."""
    batch = flat(sequences())
    t = batch.transitions
    discount = GAMMA * (1 - np.asarray(t.terminated))
    atoms = jnp.linspace(-2.0, 2.0, 7)
    for outputs in (rtg.C51(7, -2.0, 2.0), rtg.Quantiles(7)):
        learner = rtg.DQN(network=LINEAR, outputs=outputs, gamma=GAMMA, epsilon=0.1, huber=0.5)
        state = begun(learner)
        now, ahead = table(state.network, t.observation), table(state.target, t.next_observation)
        losses, errors = [], []
        for i, action in enumerate(np.asarray(t.action)):
            if isinstance(outputs, rtg.C51):
                p = np.asarray(jax.nn.softmax(ahead[i], axis=-1))
                best = p[(p @ atoms).argmax()]
                target = categorical_projection(t.reward[i] + discount[i] * atoms, jnp.asarray(best), atoms)
                losses.append(-target @ jax.nn.log_softmax(now[i, action]))
                errors.append((jax.nn.softmax(now[i, action]) - target) @ atoms)
            else:
                target = t.reward[i] + discount[i] * ahead[i, ahead[i].mean(-1).argmax()]
                losses.append(quantile_huber(jnp.asarray(now[i, action]), jnp.asarray(target), 0.5))
                errors.append(now[i, action].mean() - target.mean())
        _, metrics, priorities = learn(learner, batch, state)
        np.testing.assert_allclose(metrics["q_loss"], np.mean(losses), rtol=1e-4)
        np.testing.assert_allclose(priorities, np.abs(errors), rtol=1e-3, atol=1e-5)


def test_a_support_that_is_no_interval_is_refused():
    with pytest.raises(ValueError, match="5 is not below 1"):
        rtg.C51(51, 5.0, 1.0)


# --- several steps ---------------------------------------------------------------------------------------------------


def test_retrace_along_a_batch():
    """Against a loop over the definition; pi is epsilon-greedy by the target network."""
    learner = rtg.DQN(
        network=LINEAR, traces="retrace", trace_decay=0.8, target_epsilon=0.2, gamma=GAMMA, epsilon=0.1, huber=1e9
    )
    batch, state = sequences(), begun(learner)
    t = batch.transitions
    now = table(state.network, t.observation)[..., 0]
    here, ahead = table(state.target, t.observation)[..., 0], table(state.target, t.next_observation)[..., 0]
    pi_here, pi_ahead = (np.asarray(greedy_probabilities(jnp.asarray(q), 0.2, t.observation)) for q in (here, ahead))
    action, mu = np.asarray(t.action), np.exp(t.extras["log_prob"])
    errors = np.zeros((T, N))
    for n in range(N):
        after = 0.0
        for s in reversed(range(T)):
            a, discount = action[s, n], GAMMA * (1 - float(t.terminated[s, n]))
            delta = t.reward[s, n] + discount * (pi_ahead[s, n] @ ahead[s, n]) - here[s, n, a]
            stops = s == T - 1 or bool(t.terminated[s, n] | t.truncated[s, n])
            c = 0.0 if stops else 0.8 * min(1.0, pi_here[s + 1, n, action[s + 1, n]] / mu[s + 1, n])
            after = delta + discount * c * after
            errors[s, n] = now[s, n, a] - (here[s, n, a] + after)
    _, metrics, priorities = learn(learner, batch, state)
    np.testing.assert_allclose(metrics["td_error"], np.abs(errors).mean(), rtol=1e-4)
    np.testing.assert_allclose(priorities, np.abs(errors), rtol=1e-4, atol=1e-6)


def test_traces_of_no_length_are_one_step():
    one = rtg.DQN(network=LINEAR, gamma=GAMMA, epsilon=0.1)
    traced = dataclasses.replace(one, traces="tree_backup", trace_decay=0.0)
    batch = sequences()
    assert (one.batch, traced.batch) == ("transitions", "sequences")
    found = [learn(learner, b, begun(one))[1] for learner, b in ((one, flat(batch)), (traced, batch))]
    for name in ("q_loss", "td_error", "q_mean"):
        np.testing.assert_allclose(found[0][name], found[1][name], rtol=1e-5)


@pytest.mark.parametrize("correction", ["adaptive", "importance"])
def test_corrections_along_a_batch(correction):
    """Three-step targets against a loop over the definition; greedy is what the online network says."""
    learner = rtg.DQN(
        network=LINEAR, n_step=3, correction=correction, max_importance=2.0, gamma=GAMMA, epsilon=0.1, huber=1e9
    )
    batch, state = sequences(), begun(learner)
    t = batch.transitions
    now, ahead = table(state.network, t.observation)[..., 0], table(state.target, t.next_observation)[..., 0]
    best, action, mu = now.argmax(-1), np.asarray(t.action), np.exp(t.extras["log_prob"])
    total, losses = 0.0, []
    for n in range(N):
        for s in range(T - 2):
            y, scale, weight = 0.0, 1.0, 1.0
            for k in range(s, s + 3):
                if k > s:
                    weight *= (action[k, n] == best[k, n]) / mu[k, n]
                y, scale = y + scale * t.reward[k, n], scale * GAMMA * (1 - float(t.terminated[k, n]))
                strays = correction == "adaptive" and k + 1 < s + 3 and action[k + 1, n] != best[k + 1, n]
                if strays or k == s + 2 or t.terminated[k, n] or t.truncated[k, n]:
                    y += scale * ahead[k, n].max()
                    break
            error = now[s, n, action[s, n]] - y
            total += abs(error)
            losses.append((min(weight, 2.0) if correction == "importance" else 1.0) * error**2 / 2)
    _, metrics, _ = learn(learner, batch, state)
    np.testing.assert_allclose(metrics["td_error"], total / len(losses), rtol=1e-4)
    np.testing.assert_allclose(metrics["q_loss"], np.mean(losses), rtol=1e-4)


def test_r2d2_goes_on_from_the_memory_after_its_burn_in():
    """Against single steps of both networks from the stored memory, n-step targets and rescaling written out."""
    learner = rtg.DQN(
        network=lstm,
        burn_in=2,
        n_step=2,
        double=True,
        gamma=GAMMA,
        epsilon=0.1,
        huber=1e9,
        outputs=rtg.Expectation(True),
    )
    state = begun(learner)
    batch = sequences(state.network.torso.init())
    t = batch.transitions

    def walk(network: Any) -> tuple[np.ndarray, np.ndarray]:
        """Outputs here and ahead of every step, one step at a time."""
        step = jit(jax.vmap(lambda c, o, e: (*network(c, o), network(network(c, o)[0], e)[1])))
        carry, here, ahead = jax.tree.map(lambda x: x[0], t.extras["carry"]), [], []
        for s in range(T):
            carry, q, after = step(carry, t.observation[s], t.next_observation[s])
            done = t.terminated[s] | t.truncated[s]
            carry = jax.tree.map(lambda x: jnp.where(done[:, None], 0.0, x), carry)  # noqa: B023
            here.append(q[..., 0])
            ahead.append(after[..., 0])
        return np.asarray(here), np.asarray(ahead)

    now, ahead = walk(state.network)
    _, ahead_target = walk(state.target)
    errors = []
    for s in range(2, T - 1):
        for n in range(N):
            done = bool(t.terminated[s, n] | t.truncated[s, n])
            last = s if done else s + 1
            discounts = [GAMMA * (1 - float(t.terminated[k, n])) for k in range(s, last + 1)]
            y = t.reward[s, n] + (0.0 if done else discounts[0] * t.reward[s + 1, n])
            y += np.prod(discounts) * float(expand(jnp.asarray(ahead_target[last, n, ahead[last, n].argmax()])))
            errors.append(now[s, n, t.action[s, n]] - float(compress(jnp.asarray(y, jnp.float32))))
    _, metrics, _ = learn(learner, batch, state)
    np.testing.assert_allclose(metrics["td_error"], np.mean(np.abs(errors)), rtol=1e-4)


def test_probabilities_are_kept_where_they_are_needed():
    learner = rtg.DQN(network=LINEAR, traces="retrace", epsilon=0.3)
    policy = learner.policy(learner.init(SPEC, KEY), explore=True)
    actions, extras = jit(jax.vmap(lambda k: policy((), jnp.asarray([0.5, 1.0]), k)[1:]))(jax.random.split(KEY, 4000))
    for action in range(3):
        p = np.exp(extras["log_prob"][actions == action])
        assert np.ptp(p) < 1e-6
        np.testing.assert_allclose((actions == action).mean(), p[0], atol=0.03)
    plain = rtg.DQN(network=LINEAR, epsilon=0.3)
    assert plain.policy(plain.init(SPEC, KEY), explore=True)((), jnp.zeros(2), KEY)[2] == {}


def test_data_without_probabilities_is_refused():
    batch = sequences()
    t = dataclasses.replace(batch.transitions, extras={})
    for options in ({"traces": "retrace"}, {"n_step": 2, "correction": "importance"}):
        learner = rtg.DQN(network=LINEAR, epsilon=0.1, **options)
        with pytest.raises(ValueError, match="this data does not say it"):
            learner.update(learner.init(SPEC, KEY), Batch(t, batch.indices, batch.weights), KEY)


def test_a_burn_in_that_leaves_nothing_is_refused():
    learner = rtg.DQN(network=lstm, epsilon=0.1, burn_in=T)
    state = learner.init(SPEC, KEY)
    with pytest.raises(ValueError, match="burn_in=5 leaves nothing to learn from of sequences of 5 steps"):
        learner.update(state, sequences(state.network.torso.init()), KEY)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"traces": "retrace", "n_step": 3}, "use one or the other"),
        ({"traces": "retrace", "outputs": rtg.C51()}, "use outputs=Expectation"),
        ({"correction": "adaptive"}, "give a larger n_step"),
        ({"traces": "importance", "noisy": True}, "or noisy=False"),
        ({"burn_in": 3}, "use a GRU or an LSTM"),
        ({"trace_decay": 1.5}, r"in \[0, 1\], not 1.5"),
    ],
)
def test_what_cannot_be_is_refused(options, match):
    with pytest.raises(ValueError, match=match):
        rtg.DQN(**options)
