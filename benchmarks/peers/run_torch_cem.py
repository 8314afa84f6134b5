"""One decision by the cross-entropy method through an ensemble of networks in PyTorch, as mbrl-lib computes it; prints one JSON line.

mbrl-lib itself (0.2.0) installs and does not import: its pin of hydra-core does not know Python 3.11. The members are one batched product
a layer, a candidate has one particle a member, each keeps its member for the whole rollout, and the reward is the model's.
"""

import argparse
import json
import statistics
import sys
import time
from itertools import pairwise
from pathlib import Path

import torch
from torch.nn.functional import silu, softplus

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from control_task import ACTION, CANDIDATES, ELITES, MEMBERS, OBSERVATION, PLAN, ROUNDS, WIDTH

LEAST, MOST = -10.0, 0.5


def layers():
    """Weights and biases of the members."""
    widths = [OBSERVATION + ACTION, WIDTH, WIDTH, 2 * (OBSERVATION + 1)]
    return [(torch.randn(MEMBERS, i, o) * (2 / i) ** 0.5, torch.zeros(MEMBERS, 1, o)) for i, o in pairwise(widths)]


def decide(network, observation):
    """The first action of the best plan."""
    mean, sd = torch.zeros(PLAN, ACTION), torch.ones(PLAN, ACTION)
    for _ in range(ROUNDS):
        plans = (mean + sd * torch.randn(CANDIDATES, PLAN, ACTION)).clamp(-2.0, 2.0)
        states = observation.expand(MEMBERS, CANDIDATES, OBSERVATION)
        returns = torch.zeros(CANDIDATES)
        for t in range(PLAN):
            x = torch.cat([states, plans[:, t].expand(MEMBERS, CANDIDATES, ACTION)], -1)
            for i, (weight, bias) in enumerate(network):
                x = torch.baddbmm(bias, x, weight)
                x = silu(x) if i < len(network) - 1 else x
            centre, raw = x.chunk(2, -1)
            log_variance = MOST - softplus(MOST - raw)
            log_variance = LEAST + softplus(log_variance - LEAST)
            y = centre + torch.exp(0.5 * log_variance) * torch.randn_like(centre)
            states = states + 0.01 * y[..., :OBSERVATION]
            returns = returns + y[..., OBSERVATION].mean(0)
        elite = plans[returns.topk(ELITES).indices]
        mean, sd = 0.1 * mean + 0.9 * elite.mean(0), 0.1 * sd + 0.9 * elite.std(0)
    return mean[0]


@torch.no_grad()
def main():
    """Measure."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    torch.manual_seed(0)
    network, observation = layers(), torch.tensor([1.0, 0.0, 0.0])
    times = []
    for _ in range(1 + given.repeats):
        began = time.perf_counter()
        decide(network, observation)
        times.append(time.perf_counter() - began)
    print(json.dumps({"seconds": statistics.median(times[1:])}))


if __name__ == "__main__":
    main()
