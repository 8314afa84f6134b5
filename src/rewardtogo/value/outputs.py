r"""What the outputs of a Q network say of the return after one action: its expectation, or its whole distribution.

| | M outputs an action | target from an action's outputs at s' | loss |
|---|---|---|---|
| `Expectation` | Q | $r + \gamma Q'$ | Huber (notes, Algorithm 13) |
| `C51` | logits of M fixed atoms $z_i$ | the atoms $r + \gamma z_i$, projected on the $z_i$ | cross entropy (Bellemare et al. 2017) |
| `Quantiles` | M quantiles $\theta_i$ | $r + \gamma \theta'_i$ | quantile Huber (Dabney et al. 2018) |

$\gamma$ is 0 after a terminal state (erratum E1.5). All act by the expectation: for control a distribution is another loss, whose
minimum has the same mean.
"""

from abc import abstractmethod

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core import Configured, Number, number, setting
from ..ops.distributional import categorical_projection, quantile_huber
from ..ops.rescale import compress, expand
from ..ops.td import huber


class Outputs(Configured):
    """A kind of outputs. `mean` takes any leading axes, the rest one state and action."""

    @property
    @abstractmethod
    def size(self) -> int:
        """M, the numbers an action has."""

    @abstractmethod
    def mean(self, outputs: Float[Array, "*N M"]) -> Float[Array, "*N"]:
        """The expected return."""

    @abstractmethod
    def target(
        self, reward: Float[Array, ""], discount: Float[Array, ""], following: Float[Array, "M"]
    ) -> Float[Array, "M"]:
        """What to regress on, from the outputs of the action that is taken where the step led to."""

    @abstractmethod
    def loss(self, outputs: Float[Array, "M"], target: Float[Array, "M"], delta: Number) -> Float[Array, ""]:
        """How far the outputs are from the target; errors beyond `delta` count linearly, where there are errors."""

    @abstractmethod
    def error(self, outputs: Float[Array, "M"], target: Float[Array, "M"]) -> Float[Array, ""]:
        """Expected return less the target's, on the scale that is learned: what priorities are made of."""


class Expectation(Outputs):
    """Q(s, a) itself."""

    rescale: bool = setting(
        False, "learn sign(x) (sqrt(|x| + 1) - 1) + x / 1000 of the return, for returns of any size"
    )

    @property
    def size(self) -> int:
        return 1

    def mean(self, outputs: Float[Array, "*N M"]) -> Float[Array, "*N"]:
        return expand(outputs[..., 0]) if self.rescale else outputs[..., 0]

    def target(
        self, reward: Float[Array, ""], discount: Float[Array, ""], following: Float[Array, "M"]
    ) -> Float[Array, "M"]:
        y = reward + discount * self.mean(following)
        return (compress(y) if self.rescale else y)[None]

    def loss(self, outputs: Float[Array, "M"], target: Float[Array, "M"], delta: Number) -> Float[Array, ""]:
        return huber(outputs - target, delta)[0]

    def error(self, outputs: Float[Array, "M"], target: Float[Array, "M"]) -> Float[Array, ""]:
        return (outputs - target)[0]


class C51(Outputs):
    """Probabilities of returns between `least` and `most`, which must hold what can be earned (51 atoms in the paper)."""

    atoms: int = setting(51, "returns that have a probability, equally spaced", at_least=2)
    least: Number = number(0.0, "the smallest return that can be told from smaller ones")
    most: Number = number(100.0, "the greatest return that can be told from greater ones")

    @property
    def size(self) -> int:
        return self.atoms

    def __check_init__(self) -> None:
        if isinstance(self.least, float) and isinstance(self.most, float) and self.least >= self.most:
            raise ValueError(
                f"C51 spreads its atoms from least to most, and {self.least:g} is not below {self.most:g}: "
                "give the range of discounted returns of the environment"
            )

    def support(self) -> Float[Array, "M"]:
        """The atoms."""
        return self.least + (self.most - self.least) * jnp.linspace(0.0, 1.0, self.atoms)

    def mean(self, outputs: Float[Array, "*N M"]) -> Float[Array, "*N"]:
        return jax.nn.softmax(outputs, axis=-1) @ self.support()

    def target(
        self, reward: Float[Array, ""], discount: Float[Array, ""], following: Float[Array, "M"]
    ) -> Float[Array, "M"]:
        atoms = self.support()
        return categorical_projection(reward + discount * atoms, jax.nn.softmax(following), atoms)

    def loss(self, outputs: Float[Array, "M"], target: Float[Array, "M"], delta: Number) -> Float[Array, ""]:
        del delta
        return -jnp.sum(target * jax.nn.log_softmax(outputs))

    def error(self, outputs: Float[Array, "M"], target: Float[Array, "M"]) -> Float[Array, ""]:
        return self.mean(outputs) - target @ self.support()


class Quantiles(Outputs):
    """Quantiles of the return at the levels (i + 1/2) / M: no range has to be known."""

    count: int = setting(51, "quantiles of each action's return (200 in the paper)", at_least=1)

    @property
    def size(self) -> int:
        return self.count

    def mean(self, outputs: Float[Array, "*N M"]) -> Float[Array, "*N"]:
        return outputs.mean(-1)

    def target(
        self, reward: Float[Array, ""], discount: Float[Array, ""], following: Float[Array, "M"]
    ) -> Float[Array, "M"]:
        return reward + discount * following

    def loss(self, outputs: Float[Array, "M"], target: Float[Array, "M"], delta: Number) -> Float[Array, ""]:
        return quantile_huber(outputs, target, delta)

    def error(self, outputs: Float[Array, "M"], target: Float[Array, "M"]) -> Float[Array, ""]:
        return outputs.mean() - target.mean()
