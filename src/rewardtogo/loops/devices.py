"""Several devices: the axis of environments spread over them, in a program that is written as if there were one.

    with jax.set_mesh(jax.make_mesh((2,), ("devices",), axis_types=(jax.sharding.AxisType.Auto,))):
        rtg.train("ppo", "CartPole-v1", num_envs=16)

Without a mesh nothing here does anything. Numbers agree with those of one device up to rounding.
"""

from typing import TypeVar

import jax
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array

Tree = TypeVar("Tree")


def shard(tree: Tree, axis: int = 0) -> Tree:
    """Spread `axis` of every array over the devices of the ambient mesh; what does not divide evenly stays whole on each.

    Raises `ValueError` where the mesh wants each array's place written in its type.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return tree
    if AxisType.Explicit in mesh.axis_types:
        raise ValueError(
            "the mesh has explicit axes, and the loops leave the placing of arrays to the compiler: "
            "make it with axis_types=(jax.sharding.AxisType.Auto,)"
        )
    names = tuple(name for name, kind in zip(mesh.axis_names, mesh.axis_types, strict=True) if kind == AxisType.Auto)
    count = 1
    for name in names:
        count *= mesh.shape[name]

    def spread(x: Array) -> Array:
        if x.ndim <= axis or x.shape[axis] == 0 or x.shape[axis] % count:
            return x
        return jax.lax.with_sharding_constraint(x, PartitionSpec(*(None,) * axis, names))

    return jax.tree.map(spread, tree)
