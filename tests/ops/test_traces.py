import jax
import jax.numpy as jnp
import numpy as np

from rewardtogo.ops.traces import Experience, backward_view, forward_view, no_trace, td_lambda, traced_change

T, GAMMA, RATE = 25, 0.9, 0.05


def network(parameters, observation):
    """A small value function with two kinds of parameters."""
    return jnp.tanh(parameters["w"] @ observation) @ parameters["head"]


def table(parameters, observation):
    return parameters[observation]


def weights(seed=0):
    rng = np.random.default_rng(seed)
    return {"w": jnp.asarray(rng.normal(size=(4, 3))), "head": jnp.asarray(rng.normal(size=4))}


def stream(seed, states=None):
    """Episodes one after another, ended both ways, the last one unfinished."""
    rng = np.random.default_rng(seed)
    draw = (lambda: rng.normal(size=(T, 3))) if states is None else (lambda: rng.integers(states, size=T))
    terminated, truncated = rng.random(T) < 0.1, rng.random(T) < 0.1
    now, after, cut = draw(), draw(), terminated | truncated
    # Inside an episode a step begins where the one before led.
    after[:-1] = np.where(cut[:-1].reshape(-1, *[1] * (now.ndim - 1)), after[:-1], now[1:])
    return Experience(*map(jnp.asarray, (now, rng.normal(size=T), GAMMA * (1.0 - terminated), after, cut)))


def apart(one, other):
    return max(
        float(jnp.max(jnp.abs(a - b))) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def plain_forward(e, lambda_):
    """(G - V) grad V of the network, the lambda-return by its definition and the gradient by hand."""
    p = weights()
    w, head = np.asarray(p["w"]), np.asarray(p["head"])
    now, r, discount, after, cut = map(np.asarray, (e.observation, e.r, e.discount, e.next_observation, e.cut))
    v, following = np.tanh(now @ w.T) @ head, np.tanh(after @ w.T) @ head
    total = {"w": np.zeros((4, 3)), "head": np.zeros(4)}
    for t in range(T):
        ends = np.flatnonzero(cut[t:])
        left = ends[0] + 1 if len(ends) else T - t
        target = 0.0
        for n in range(1, left + 1):
            product = np.concatenate([[1.0], np.cumprod(discount[t : t + n])])
            n_step = product[:-1] @ r[t : t + n] + product[-1] * following[t + n - 1]
            target += lambda_ ** (n - 1) * (1.0 if n == left else 1.0 - lambda_) * n_step
        hidden = np.tanh(w @ now[t])
        total["head"] += (target - v[t]) * hidden
        total["w"] += (target - v[t]) * np.outer(head * (1 - hidden**2), now[t])
    return total


def test_forward_and_backward_view_agree(item, x64):
    views = [jax.jit(lambda p, e, l, view=view: view(network, p, e, l)) for view in (backward_view, forward_view)]
    for_table = [jax.jit(lambda p, e, l, view=view: view(table, p, e, l)) for view in (backward_view, forward_view)]
    worst = by_hand = tabular = one = zero = 0.0
    for seed in range(5):
        e, states = stream(seed), stream(seed, states=4)
        for lambda_ in (0.0, 0.3, 0.9, 1.0):
            backward, forward = (view(weights(), e, lambda_) for view in views)
            worst, by_hand = (
                max(worst, apart(backward, forward)),
                max(by_hand, apart(backward, plain_forward(e, lambda_))),
            )
            values = jnp.arange(4.0)
            tabular = max(tabular, apart(*(view(values, states, lambda_) for view in for_table)))
        one = max(one, apart(views[0](weights(), e, 1.0), monte_carlo(e)))
        v, after = (jax.vmap(lambda o: network(weights(), o))(o) for o in (e.observation, e.next_observation))
        zero = max(zero, apart(views[0](weights(), e, 0.0), slopes(e, e.r + e.discount * after - v)))
    with item("4.35") as check:
        check(worst, "<=", 1e-12, "sum of delta e against lambda-returns, a network, 5 streams, 4 lambdas")
        check(tabular, "<=", 1e-12, "the same for a table")
        check(by_hand, "<=", 1e-12, "sum of delta e against the definition, without either")
        check(one, "<=", 1e-12, "lambda 1 against Monte Carlo, (return - V) grad V")
        check(zero, "<=", 1e-12, "lambda 0 against delta grad V")


def slopes(e, errors):
    """Sum of error times grad V."""
    each = jax.vmap(lambda o: jax.grad(network)(weights(), o))(e.observation)
    return jax.tree.map(lambda g: jnp.einsum("t,t...->...", errors, g), each)


def monte_carlo(e):
    """The rewards to the end of each episode, with the value where it was cut."""
    v, after = (np.asarray(jax.vmap(lambda o: network(weights(), o))(o)) for o in (e.observation, e.next_observation))
    returns, ahead = np.zeros(T), after[-1]
    for t in reversed(range(T)):
        ahead = after[t] if e.cut[t] else ahead
        returns[t] = ahead = e.r[t] + e.discount[t] * ahead
    return slopes(e, jnp.asarray(returns - v))


def test_online_updates(item, x64):
    """Against the two lines of erratum E4.12, written out for a table."""
    e, worst = stream(3, states=4), 0.0
    for lambda_ in (0.0, 0.8, 1.0):
        w, trace = np.arange(4.0), np.zeros(4)
        for t in range(T):
            s, after = int(e.observation[t]), int(e.next_observation[t])
            delta = float(e.r[t] + e.discount[t] * w[after] - w[s])
            if t:
                trace = np.zeros(4) if e.cut[t - 1] else float(e.discount[t - 1]) * lambda_ * trace
            trace[s] += 1.0
            w = w + RATE * delta * trace
        found, _ = td_lambda(table, jnp.arange(4.0), jnp.zeros(4), e, lambda_, RATE)
        worst = max(worst, apart(found, w))
    offline, far = backward_view(network, weights(), stream(0), 0.8), []
    for rate in (1e-3, 1e-4):
        found, _ = td_lambda(network, weights(), no_trace(weights()), stream(0), 0.8, rate)
        moved = jax.tree.map(lambda new, old, rate=rate: (new - old) / rate, found, weights())
        far.append(apart(moved, offline))
    with item("4.35") as check:
        check(worst, "<=", 1e-12, "online: w after 25 steps against the update written out, lambda 0, .8, 1")
        check(
            abs(far[0] / far[1] - 10), "<=", 0.5, "online from offline: of first order in alpha, ratio 10 at alpha / 10"
        )


def test_a_stream_may_come_in_pieces_and_ends_empty_the_trace(x64):
    e = stream(1)
    whole = td_lambda(network, weights(), no_trace(weights()), e, 0.9, RATE)
    first, rest = (jax.tree.map(lambda x, part=part: x[part], e) for part in (slice(None, 11), slice(11, None)))
    pieces = td_lambda(network, *td_lambda(network, weights(), no_trace(weights()), first, 0.9, RATE), rest, 0.9, RATE)
    assert apart(whole, pieces) <= 1e-14
    last = int(np.flatnonzero(np.asarray(e.cut))[0])
    step = jax.tree.map(lambda x: x[last], e)
    change, trace = traced_change(network, weights(), weights(1), step, 0.9)
    assert apart(trace, no_trace(trace)) == 0 and apart(change, no_trace(change)) > 0


def test_float32_stays_float32():
    e = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, stream(0))
    p = jax.tree.map(lambda x: x.astype(jnp.float32), weights())
    for lambda_ in (0.9, jnp.float32(0.9)):
        found = (*td_lambda(network, p, no_trace(p), e, lambda_, RATE), backward_view(network, p, e, lambda_))
        assert {x.dtype for x in jax.tree.leaves(found)} == {jnp.dtype("float32")}
