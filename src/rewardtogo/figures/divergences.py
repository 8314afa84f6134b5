r"""Which methods diverge: Baird's seven states on the left, the two states w, 2w on the right (items 5.27, 5.28 and 5.32).

On the left expected updates, states updated evenly while the policy always goes to the last one: semi-gradient TD blows up although V* = 0
can be said exactly; GTD2, TDC and the residual gradient go down, and so does a table,
each of whose values goes a tenth of the way. On the right the size of w after each fit, for
several discounts: 6γ/5 a fit, so that 5/6 is the border.

Source: notes, section 5.4; Baird 1995; Sutton et al. 2009; Tsitsiklis and Van Roy 1996.
"""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ..value.divergence import Chain, baird, fit_on, follow, w_2w

SWEEPS, GAMMA = 2000, 0.9
COLOURS = ("#d55e00", "#0072b2", "#56b4e9", "#cc79a7", "#009e73")
GAMMAS = (0.7, 0.8, 5 / 6, 0.9, 0.95)


def errors(gamma: float = GAMMA, sweeps: int = SWEEPS) -> dict[str, Float[np.ndarray, "K"]]:
    """The largest |V| after each sweep, by method."""
    chain = baird(gamma)
    table = Chain(chain.transitions, chain.rewards, np.eye(7), chain.weights, gamma, chain.features @ chain.start)
    paths = {
        "semi-gradient TD": chain.features @ follow(chain, 0.1, sweeps).T,
        "TDC": chain.features @ follow(chain, 0.1, sweeps, "tdc", 0.5).T,
        "GTD2": chain.features @ follow(chain, 0.1, sweeps, "gtd2", 0.5).T,
        "residual gradient": chain.features @ follow(chain, 0.1, sweeps, "residual_gradient").T,
        "semi-gradient TD, a table": follow(table, 0.7, sweeps).T,
    }
    return {name: np.abs(values).max(0) for name, values in paths.items()}


def draw(seed: int) -> Figure:
    """The two panels; nothing in them is random."""
    del seed
    figure = Figure(figsize=(10.6, 4.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (name, values), colour, style in zip(errors().items(), COLOURS, ("-", "--", ":", "-.", "-"), strict=True):
        left.plot(values, color=colour, lw=2.0, ls=style, label=name)
    left.set(
        xlabel="sweeps over all states", ylabel="largest |V|; V* = 0", yscale="log", xlim=(0, SWEEPS), ylim=(1e-3, 3e5)
    )
    left.set_title(f"Baird's example, γ = {GAMMA:g}", fontsize=11)
    left.legend(frameon=False, fontsize=9, loc="upper right", ncols=2)
    for gamma, colour in zip(GAMMAS, ("#009e73", "#56b4e9", "#333333", "#e69f00", "#d55e00"), strict=True):
        name = "5/6" if gamma == 5 / 6 else f"{gamma:g}"
        right.plot(fit_on(w_2w(gamma), 100)[:, 0], color=colour, lw=1.8, label=f"γ = {name}")
    right.set(xlabel="fits", ylabel="w; V* is w = 0", yscale="log", xlim=(0, 100))
    right.set_title("w, 2w: fitted value iteration", fontsize=11)
    right.legend(frameon=False, fontsize=9)
    for axes in (left, right):
        axes.grid(alpha=0.25, lw=0.6)
    return figure
