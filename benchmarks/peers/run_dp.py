"""Value iteration of quantecon or pymdptoolbox on a random decision process; prints one JSON line."""

import argparse
import json
import time

import numpy as np
import scipy.sparse as sparse


def problem(states: int, actions: int, width: int) -> tuple:
    """The process that `ours.py dp` solves: the same numbers in the same order."""
    rng = np.random.default_rng(0)
    successors = rng.integers(0, states, (states, actions, width))
    probabilities = rng.dirichlet(np.ones(width), (states, actions))
    return successors, probabilities, rng.normal(size=(states, actions))


def quantecon(successors, probabilities, rewards, gamma: float, epsilon: float) -> dict:
    from quantecon.markov import DiscreteDP

    states, actions, width = successors.shape
    rows = np.repeat(np.arange(states * actions), width)
    matrix = sparse.csr_matrix((probabilities.ravel(), (rows, successors.ravel())), (states * actions, states))
    pairs = np.divmod(np.arange(states * actions), actions)
    ddp = DiscreteDP(rewards.ravel(), matrix, gamma, *pairs)
    solve = lambda: ddp.solve(method="value_iteration", v_init=np.zeros(states), epsilon=epsilon, max_iter=100_000)  # noqa: E731
    solve()  # Numba compiles
    began = time.perf_counter()
    found = solve()
    return {"seconds": time.perf_counter() - began, "sweeps": found.num_iter, "value": float(found.v.mean())}


def mdptoolbox(successors, probabilities, rewards, gamma: float, epsilon: float) -> dict:
    import mdptoolbox.mdp as mdp

    states, actions, width = successors.shape
    rows = np.repeat(np.arange(states), width)
    matrices = [
        sparse.csr_matrix((probabilities[:, a].ravel(), (rows, successors[:, a].ravel())), (states, states))
        for a in range(actions)
    ]
    began = time.perf_counter()
    solver = mdp.ValueIteration(matrices, rewards, gamma, epsilon=epsilon)
    made = time.perf_counter()
    solver.run()
    # Making it checks the input and bounds the number of sweeps, which takes longer than the sweeps.
    return {
        "seconds": time.perf_counter() - began,
        "run": time.perf_counter() - made,
        "sweeps": solver.iter,
        "value": float(np.mean(solver.V)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("library", choices=("quantecon", "mdptoolbox"))
    for name, kind, default in (("states", int, 10_000), ("actions", int, 10), ("width", int, 10)):
        parser.add_argument(f"--{name}", type=kind, default=default)
    parser.add_argument("--gamma", type=float, default=0.95)
    parser.add_argument("--epsilon", type=float, default=0.01)
    given = parser.parse_args()
    solve = {"quantecon": quantecon, "mdptoolbox": mdptoolbox}[given.library]
    print(json.dumps(solve(*problem(given.states, given.actions, given.width), given.gamma, given.epsilon)))
