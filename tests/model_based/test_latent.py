"""Latent models of pictures: the terms of the objective by hand, its collapse as printed, and what one picture cannot tell."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import rewardtogo as rtg
from algorithms_under_test import jit
from rewardtogo.core import Batch, EnvSpec, Spec, env_spec
from rewardtogo.envs import FrameStack, MaskObservation, Pendulum
from rewardtogo.loops import RandomPolicy, begin
from rewardtogo.model_based import Ensemble, LatentMBRL
from rewardtogo.model_based.ensembles import gaussian_nll
from rewardtogo.model_based.latent import Dense, LatentNetworks, Latents, followed, sequence_terms

KEY = jax.random.key(0)
L, O, A, T, N = 2, 5, 1, 4, 6


@jit
def networks_of(seed: int) -> LatentNetworks:
    keys = jax.random.split(jax.random.key(seed), 4)
    return LatentNetworks(
        Dense.of(O, (7,), L, keys[0]), Dense.of(L + A, (7,), L, keys[1]),
        Dense.of(L + A, (7,), 2, keys[2]), Dense.of(L, (7,), O, keys[3]),
    )  # fmt: skip


def data_of(seed: int) -> tuple[jax.Array, ...]:
    """Observations, actions, rewards, ends and cuts: sequence 0 ends after its second step, sequence 1 is cut there."""
    rng = np.random.default_rng(seed)
    f = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    ended = np.zeros((T, N))
    ended[1, 0] = 1
    cut = ended.copy()
    cut[1, 1] = 1
    return (
        f(rng.normal(size=(T + 1, N, O))),
        f(rng.normal(size=(T, N, A))),
        f(rng.normal(size=(T, N))),
        f(ended),
        f(cut),
    )


def by_hand(networks: LatentNetworks, data: tuple[jax.Array, ...], weights: np.ndarray) -> dict[str, float]:
    """The terms with loops."""
    vectors, actions, rewards, ended, cut = data
    raw = np.asarray(jax.vmap(jax.vmap(networks.encoder))(vectors), np.float64)
    latents = (raw - raw.mean((0, 1))) / raw.std((0, 1))
    sums = {name: 0.0 for name in ("latent", "reward", "encoded", "followed", "end")}
    counts = dict.fromkeys(sums, 0.0)

    def add(name: str, value: float, n: int) -> None:
        sums[name] += weights[n] * value
        counts[name] += weights[n]

    decode = lambda s: np.asarray(networks.decoder(jnp.asarray(s, jnp.float32)))  # noqa: E731
    for n in range(N):
        s, going = latents[0, n], True
        add("encoded", ((decode(s) - vectors[0, n]) ** 2).sum(), n)
        for t in range(T):
            if not going:
                break
            after, outcome = followed(networks, jnp.asarray(s, jnp.float32), actions[t, n])
            s = np.asarray(after)
            add("reward", (float(outcome[0]) - float(rewards[t, n])) ** 2, n)
            add("end", float(np.logaddexp(0, outcome[1]) - ended[t, n] * outcome[1]), n)
            going = not cut[t, n]
            if going:
                add("latent", ((s - latents[t + 1, n]) ** 2).sum(), n)
                add("encoded", ((decode(latents[t + 1, n]) - vectors[t + 1, n]) ** 2).sum(), n)
                add("followed", ((decode(s) - vectors[t + 1, n]) ** 2).sum(), n)
    mean = {name: sums[name] / counts[name] for name in sums}
    observation = 0.5 * (mean["encoded"] + mean["followed"])
    return {"latent": mean["latent"], "reward": mean["reward"], "observation": observation, "end": mean["end"]}


TERMS = jit(sequence_terms, static_argnames="standardise")


def test_terms_by_hand(item):
    """With an end, a cut and a sequence that must not be used; the derivatives reach all four networks."""
    networks, data = networks_of(0), data_of(0)
    weights = jnp.ones(N).at[2].set(0.0)
    vectors, actions, rewards, ended, cut = data
    found = TERMS(networks, *data, weights)[0]
    expected = by_hand(networks, data, np.asarray(weights))
    gap = max(abs(float(vars(found)[name]) - value) for name, value in expected.items())
    total = lambda n: sum(jax.tree.leaves(sequence_terms(n, vectors, actions, rewards, ended, cut, weights)[0]))  # noqa: E731
    slope = jit(jax.grad(total))(networks)
    way = jax.tree.map(lambda x: jax.random.normal(KEY, x.shape), networks)
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, w: (g * w).sum(), slope, way)))
    value = jit(total)
    at = lambda h: value(jax.tree.map(lambda x, w: x + h * w, networks, way))  # noqa: E731
    with item("8.66") as check:
        check(gap, "<=", 1e-4, "terms of the objective, rewards and ends among them, from loops by hand")
    with item("8.68") as check:
        least = min(
            float(rtg.nn.global_norm(vars(slope)[name])) for name in ("encoder", "change", "outcome", "decoder")
        )
        check(least, ">", 1e-3, "norm of the gradient of each of the four networks, the least")
        numeric = float(at(1e-3) - at(-1e-3)) / 2e-3
        check(
            abs(float(along) / numeric - 1), "<=", 0.02, "derivative in a random direction, from a difference quotient"
        )


def shrunk(networks: LatentNetworks, k: float) -> LatentNetworks:
    """The same model of the observations with latents k times as large: what reads a latent undoes it."""
    head, change = networks.encoder.layers[-1], networks.change.layers
    read = lambda w: w.at[:, :L].divide(k)  # noqa: E731
    return eqx.tree_at(
        lambda n: (
            n.encoder.layers[-1], n.change.layers[0].weight, n.change.layers[-1],
            n.outcome.layers[0].weight, n.decoder.layers[0].weight,
        ),
        networks,
        (
            jax.tree.map(lambda x: k * x, head), read(change[0].weight), jax.tree.map(lambda x: k * x, change[-1]),
            read(networks.outcome.layers[0].weight), networks.decoder.layers[0].weight / k,
        ),
    )  # fmt: skip


def test_the_printed_objective_rewards_collapse(item):
    """With the best variance for each scale, k < 1 gains -log k a latent number (erratum E8.17); standardised latents gain nothing."""
    networks, data, weights = networks_of(1), data_of(1), jnp.ones(N)
    likelihood = lambda n: -0.5 * np.log(float(TERMS(n, *data, weights, standardise=False)[0].latent) / L)  # noqa: E731
    gains = [likelihood(shrunk(networks, k)) - likelihood(networks) for k in (0.1, 0.01, 0.001)]
    # What ours sees of an encoder is the same at any scale.
    scaled = eqx.tree_at(
        lambda n: n.encoder.layers[-1], networks, jax.tree.map(lambda x: 0.01 * x, networks.encoder.layers[-1])
    )
    ours, there = TERMS(networks, *data, weights)[0], TERMS(scaled, *data, weights)[0]
    with item("8.68") as check:
        error = np.abs(np.array(gains) - np.log([10.0, 100.0, 1000.0])).max()
        check(error, "<=", 1e-3, "gain of the printed objective from shrinking by k = .1, .01, .001, from -log k")
        gap = max(abs(float(a - b)) for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(there), strict=True))
        check(gap, "<=", 1e-3, "change of the guarded objective when the encoder shrinks by 100")


def test_nothing_collapses_in_training(item):
    """Some updates on pictures of random play: latents stay spread, and the model predicts."""
    env = rtg.make("PixelPendulum", 8)
    policy = RandomPolicy(env_spec(env))
    play = lambda key: rtg.collect(env, policy, begin(env, policy, key), key, 200)[1].transitions  # noqa: E731
    steps = jit(play)(KEY)
    learner = LatentMBRL(latent_size=4, encoder_sizes=(32,), sizes=(32,))

    def sampled(key: jax.Array) -> Batch:
        first = jax.random.randint(key, (32,), 0, 197)
        rows, columns = first[None] + jnp.arange(3)[:, None], jnp.broadcast_to(jnp.arange(32) % 8, (3, 32))
        return Batch(jax.tree.map(lambda x: x[rows, columns], steps), first, jnp.ones(32))

    update = lambda learned, key: learner.update(learned, sampled(key), key)[:2]  # noqa: E731
    start = jit(lambda key: learner.init(env_spec(env), key))(KEY)
    learned, metrics = jax.jit(lambda s: jax.lax.scan(update, s, jax.random.split(KEY, 300)))(start)
    model = learner.model(learned)
    latents = jit(jax.vmap(lambda o: model.encode(o).latent))(sampled(KEY).transitions.observation[0])
    with item("8.68") as check:
        check(float(latents.std(0).min()), ">=", 0.5, "standard deviation of the latents after training, the least")
    assert float(metrics["reward_error"][-20:].mean()) < 0.5 and float(metrics["latent_error"][-20:].mean()) < 0.5


def one_step_error(stack: int) -> float:
    """Mean squared error of the next (cos, sin) on fresh data, of a network that saw the last `stack` of them and the action."""
    env = rtg.vectorize(FrameStack(MaskObservation(Pendulum(), keep=(0, 1)), stack), 16)
    policy = RandomPolicy(env_spec(env))

    def play(key):
        t = rtg.collect(env, policy, begin(env, policy, key), key, 250)[1].transitions
        flat = lambda x: x.reshape(-1, x.shape[-1])  # noqa: E731
        inputs = jnp.concatenate([flat(t.observation), flat(t.action)], 1)
        return inputs, flat(t.next_observation)[:, -2:] - flat(t.observation)[:, -2:]

    (x, y), (fresh_x, fresh_y) = (jax.jit(play)(jax.random.key(seed)) for seed in (1, 2))
    ensemble, rule, scale = Ensemble.of(x.shape[1], 2, (64,), 1, KEY), optax.adam(3e-3), y.std()

    def step(loop, key):
        ensemble, state = loop
        rows = jax.random.randint(key, (256,), 0, len(x))
        loss = lambda e: gaussian_nll(e(x[rows][None]), y[rows] / scale, 1.0).mean()  # noqa: E731
        change, state = rule.update(jax.grad(loss)(ensemble), state)
        return (optax.apply_updates(ensemble, change), state), None

    fit = jax.jit(lambda e: jax.lax.scan(step, (e, rule.init(e)), jax.random.split(KEY, 3000))[0][0])
    return float(((fit(ensemble)(fresh_x[None]).mean[0] * scale - fresh_y) ** 2).mean())


def test_what_one_frame_cannot_tell(item):
    with item("8.72") as check:
        check(one_step_error(2) / one_step_error(1), "<=", 0.1, "one-step squared error of two frames over that of one")


def test_the_model_by_hand():
    """Encoding is standardised, rewards come in their own units, and an end stops them."""
    spec = EnvSpec(Spec("box", (O,), low=(-1.0,), high=(1.0,)), Spec("box", (A,), low=(-2.0,), high=(2.0,)))
    learner = LatentMBRL(latent_size=L, encoder_sizes=(7,), sizes=(7,))
    state = jit(lambda key: learner.init(spec, key))(KEY)
    latents = Latents(jnp.asarray([1.0, -1.0]), jnp.asarray([4.0, 9.0]), jnp.ones((), jnp.int32))
    rewards = state.rewards.update(jnp.asarray([[1.0], [5.0]]))
    state = eqx.tree_at(lambda s: (s.latents, s.rewards), state, (latents, rewards))
    model, o, a = learner.model(state), jnp.linspace(-1, 1, O), jnp.asarray([1.0])
    first = model.encode(o)
    raw = state.networks.encoder(o)
    assert np.allclose(first.latent, (raw - jnp.asarray([1.0, -1.0])) / jnp.asarray([2.0, 3.0]), atol=1e-5)
    second = model.transition(first, a, KEY)
    after, outcome = followed(state.networks, first.latent, jnp.asarray([0.5]))
    assert np.allclose(second.latent, after) and float(second.reward) == pytest.approx(
        3 + 2 * float(outcome[0]), rel=1e-4
    )
    third = model.transition(eqx.tree_at(lambda s: s.alive, second, jnp.zeros(())), a, KEY)
    assert float(third.reward) == 0 and bool(model.terminal(third)) and not bool(model.terminal(first))


def test_refusals():
    with pytest.raises(ValueError, match="latent_size"):
        LatentMBRL(latent_size=0)
    with pytest.raises(ValueError, match="observation_scale"):
        LatentMBRL(observation_scale=0.0)
