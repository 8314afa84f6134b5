r"""Which part of the observation does the expert look at? One policy for every graph of causes, and interventions to choose one.

Behavioural cloning is free to use whatever predicts the expert's action, its effects included (a brake light that shows the last action).
Among n entries there are 2^n candidate graphs G in {0, 1}^n of what causes the action. De Haan et al. (2019) fit one policy to all,

$$\max_\theta\; \mathbb{E}_{(o, a^\star) \sim D}\, \mathbb{E}_{G \sim U\{0, 1\}^n}\, \log \pi_\theta(a^\star \mid [o \odot G,\, G]),$$

and then find the right one by acting, with $p(G) \propto e^{\langle w, G \rangle / \tau}$, which factorises over the entries:

    by return     draw G ~ p, act with pi(. | G) and take the mean return as its score            (their algorithm 2)
    by queries    ask the expert once about states where the graphs disagree most; the score of G is the mean
                  log-likelihood of its answers                                                   (their algorithm 1)
    either way    w is the least-squares slope of the scores of all draws so far

The result is the likeliest graph. Neither needs to fit the policy anew.

Deviations: scores are standardised before the regression, so that tau has the same meaning in every environment; a small ridge keeps w
finite while fewer graphs than entries were drawn. Entries are those of a vector: de Haan et al. find them in pictures by a beta-VAE.

Source: notes, section 2.3.1, erratum E2.10; de Haan, Jayaraman and Levine (2019).
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core import Action, Carry, EnvSpec, Observation, Policy, PRNGKey, Spec, VectorEnv
from ..data.episodes import Dataset
from ..data.noise import EXPERT
from ..loops.collect import begin, collect
from ..nn.actor import StochasticPolicy
from ..nn.entries import entries_of
from ..ops.distributions import Distribution


def with_random_graphs(dataset: Dataset, entries: tuple[int, ...], key: PRNGKey, copies: int = 4) -> Dataset:
    """The data to fit pi(a | o * G, G) to: every episode `copies` times, each time through a random G over `entries`, `[o * G, G]`.

    A graph holds for a whole episode, so that networks with a memory can learn from it. Entries that are not named are left out.

    Raises `ValueError` where the observation is no vector or has no such entries.
    """
    if copies < 1:
        raise ValueError(f"each episode is there at least once, not {copies} times")
    spec = _graph_spec(dataset.spec, entries)
    t = dataset.transitions
    chosen = np.array(entries)
    graphs = jax.random.bernoulli(key, 0.5, (copies * dataset.num_episodes, len(entries))).astype(jnp.float32)
    graphs = graphs[np.repeat(np.arange(len(graphs)), np.tile(dataset.lengths, copies))]
    repeat = lambda x: jnp.tile(x, (copies,) + (1,) * (x.ndim - 1))  # noqa: E731
    t = jax.tree.map(repeat, t)
    shown = lambda o: jnp.concatenate([o[:, chosen] * graphs, graphs], 1)  # noqa: E731
    kept = {EXPERT: t.extras[EXPERT]} if EXPERT in t.extras else {}
    seen, following = shown(t.observation), shown(t.next_observation)
    return Dataset.of(dataclasses.replace(t, observation=seen, next_observation=following, extras=kept), spec)


def _graph_spec(spec: EnvSpec, entries: tuple[int, ...]) -> EnvSpec:
    low, high = entries_of(spec.observation, entries).bounds()
    both = lambda values, bound: (*np.ravel(values).tolist(), *(bound,) * len(entries))  # noqa: E731
    low, high = both(np.minimum(low, 0.0), 0.0), both(np.maximum(high, 0.0), 1.0)
    return dataclasses.replace(spec, observation=Spec("box", (2 * len(entries),), "float32", low=low, high=high))


class GraphPolicy(Policy):
    """The policy that was fitted to all graphs, looking through one of them at an observation of the environment."""

    policy: Policy
    graph: Float[Array, "n"]
    entries: tuple[int, ...] = eqx.field(static=True)

    def init(self, key: PRNGKey) -> Carry:
        return self.policy.init(key)

    def __call__(self, carry: Carry, observation: Observation, key: PRNGKey) -> tuple[Carry, Action, dict[str, Array]]:
        return self.policy(carry, self.shown(observation), key)

    def inspect(self, carry: Carry, observation: Observation) -> dict[str, Array]:
        return self.policy.inspect(carry, self.shown(observation))

    def shown(self, observation: Float[Array, "O"]) -> Float[Array, "n2"]:
        """What the policy inside sees."""
        return jnp.concatenate([observation[np.array(self.entries)] * self.graph, self.graph])


class GraphChoice(eqx.Module):
    """What an intervention found: the likeliest `graph`, the weights w, and which graphs were tried `[R, n]` with which scores `[R]`."""

    graph: Bool[np.ndarray, "n"]
    weights: Float[np.ndarray, "n"]
    tried: Bool[np.ndarray, "R n"]
    scores: Float[np.ndarray, "R"]


def choose_graph_by_return(
    env: VectorEnv,
    policy: Policy,
    entries: tuple[int, ...],
    key: PRNGKey,
    *,
    rounds: int = 20,
    steps: int = 200,
    temperature: float = 0.5,
) -> GraphChoice:
    """The graph whose policy earns most, by acting: `rounds` graphs, `steps` steps in each environment for each.

    Raises `ValueError` where no episode ends within these steps.
    """

    def score(graph: np.ndarray, key: PRNGKey) -> float:
        total, count = _play(env, GraphPolicy(policy, jnp.asarray(graph, jnp.float32), entries), key, steps)
        if not count:
            raise ValueError(
                f"no episode ended within {steps} steps, so that there is no return to choose by: give more steps"
            )
        return float(total) / float(count)

    return _search(score, len(entries), key, rounds, temperature)


def choose_graph_by_queries(
    env: VectorEnv,
    policy: StochasticPolicy,
    expert: Policy,
    entries: tuple[int, ...],
    key: PRNGKey,
    *,
    rounds: int = 20,
    steps: int = 200,
    queries: int = 32,
    temperature: float = 0.5,
) -> GraphChoice:
    """The graph that explains the expert's answers best, in the `queries` states where the graphs disagree most.

    - `policy`: what was fitted to all graphs, without a memory, as it explores.
    - `expert`: asked `queries` times in all. It must not remember: the states are not in order.

    States come from random graphs, a new one in each of `rounds`. Graphs disagree by the mean of KL(pi_G || mean over graphs of pi),
    estimated by one action that each of them draws.
    Raises `ValueError` for fewer states than queries.
    """
    if rounds * steps * env.num_envs < queries:
        raise ValueError(
            f"{rounds * steps * env.num_envs} states are fewer than {queries} queries: give more steps or ask less"
        )

    draw_key, visit_key, judge_key, ask_key, search_key = jax.random.split(key, 5)
    graphs = jax.random.bernoulli(draw_key, 0.5, (rounds, len(entries))).astype(jnp.float32)
    seen = _visit(env, policy, entries, graphs, visit_key, steps)
    asked = seen[jnp.argsort(-_disagreement(policy, entries, graphs, seen, judge_key))[:queries]]
    labels = _answers(expert, asked, jax.random.split(ask_key, queries))
    score = lambda graph, key: float(_explained(policy, entries, jnp.asarray(graph, jnp.float32), asked, labels))  # noqa: E731
    return _search(score, len(entries), search_key, rounds, temperature)


@partial(jax.jit, static_argnames="steps")
def _play(env: VectorEnv, policy: GraphPolicy, key: PRNGKey, steps: int) -> tuple[Array, Array]:
    begin_key, act_key = jax.random.split(key)
    episodes = collect(env, policy, begin(env, policy, begin_key), act_key, steps)[2]
    return episodes.return_sum, episodes.count


@partial(jax.jit, static_argnames=("entries", "steps"))
def _visit(
    env: VectorEnv, policy: StochasticPolicy, entries: tuple[int, ...], graphs: Array, key: PRNGKey, steps: int
) -> Float[Array, "N O"]:
    """What is observed under each of the graphs."""

    def one(graph: Array, key: Array) -> Array:
        begin_key, act_key = jax.random.split(key)
        acting = GraphPolicy(policy, graph, entries)
        return collect(env, acting, begin(env, acting, begin_key), act_key, steps)[1].transitions.observation

    seen = jax.lax.map(lambda pair: one(*pair), (graphs, jax.random.split(key, len(graphs))))
    return seen.reshape(-1, seen.shape[-1])


def _law(policy: StochasticPolicy, entries: tuple[int, ...], graph: Array, observation: Array) -> Distribution:
    return policy.look(policy.network.init(), GraphPolicy(policy, graph, entries).shown(observation))[1]


@partial(jax.jit, static_argnames="entries")
def _disagreement(
    policy: StochasticPolicy, entries: tuple[int, ...], graphs: Array, seen: Array, key: PRNGKey
) -> Float[Array, "N"]:
    """The mean over graphs of KL(pi_G || their mean) in each state, estimated by one action of each graph."""

    def at(observation: Array, key: Array) -> Array:
        law = jax.vmap(lambda graph: _law(policy, entries, graph, observation))(graphs)
        action = jax.vmap(lambda one, k: one.sample(k))(law, jax.random.split(key, len(graphs)))
        # [i, j]: of the action of graph i under graph j.
        table = jax.vmap(lambda a: jax.vmap(lambda one: one.log_prob(a))(law))(action)
        mean = jax.nn.logsumexp(table, axis=1) - jnp.log(float(len(graphs)))
        return (jnp.diagonal(table) - mean).mean()

    return jax.vmap(at)(seen, jax.random.split(key, len(seen)))


@jax.jit
def _answers(expert: Policy, asked: Array, keys: Array) -> Action:
    return jax.vmap(lambda o, k: expert(expert.init(k), o, k)[1])(asked, keys)


@partial(jax.jit, static_argnames="entries")
def _explained(
    policy: StochasticPolicy, entries: tuple[int, ...], graph: Array, asked: Array, labels: Action
) -> Float[Array, ""]:
    return jax.vmap(lambda o, a: _law(policy, entries, graph, o).log_prob(a))(asked, labels).mean()


def _search(
    score: Callable[[np.ndarray, PRNGKey], float], size: int, key: PRNGKey, rounds: int, temperature: float
) -> GraphChoice:
    """Draws graphs from p(G), and fits the weights to the scores of all that were drawn."""
    if rounds < 2:
        raise ValueError(f"graphs are compared, so that there are at least 2 rounds, not {rounds}")
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
    weights, tried, scores = np.zeros(size), [], []
    for i in range(rounds):
        # Every entry is seen both ways before p(G) says otherwise: a slope needs both.
        chance = 1 / (1 + np.exp(-weights / temperature))
        graph = rng.random(size) < chance if i >= 2 else (rng.random(size) < 0.5 if i == 0 else ~tried[0])
        tried.append(graph)
        scores.append(score(graph, jax.random.fold_in(key, i)))
        weights = _slopes(np.array(tried, float), np.array(scores))
    return GraphChoice(weights > 0, weights, np.array(tried), np.array(scores))


def _slopes(graphs: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Least-squares slopes of standardised scores."""
    spread = scores.std()
    y = (scores - scores.mean()) / spread if spread > 0 else np.zeros(len(scores))
    x = graphs - graphs.mean(0)
    return np.linalg.solve(x.T @ x + 1e-3 * np.eye(x.shape[1]), x.T @ y)
