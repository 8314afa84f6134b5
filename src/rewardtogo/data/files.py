"""Trees of arrays in files: names from the tree's own paths, numbers in safetensors, never a pickle.

A file holds numbers and names only. Structure, shapes and types come from the program that reads it (`jax.eval_shape`
of what made the tree), and a file that does not fit is refused by name. Random keys are stored as their data, with the
name of their generator.
"""

import json
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

FORMAT = 1
"""Version of the files written here. A reader refuses newer ones."""


class Damaged(ValueError):
    """A file of a run cannot be used: it is damaged, newer than this library, or of something else."""


def is_key(leaf: Any) -> bool:
    """Whether a leaf holds new-style random keys."""
    return isinstance(leaf, (jax.Array, jax.ShapeDtypeStruct)) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def named_leaves(tree: PyTree) -> dict[str, Any]:
    """Every leaf under the path that leads to it, such as `.learner.network.head.weight`."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def sync(path: Path) -> None:
    """Make sure that a file, or a folder's list of files, is on the disk; Windows needs no such call for folders."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a small file whole or not at all: a temporary name, synced, renamed."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    sync(temporary)
    os.replace(temporary, path)


def write_json(path: Path, data: Any) -> None:
    """Write plain data as JSON, whole or not at all."""
    write_text(path, json.dumps(data, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read plain data; raises `Damaged` where the file is not JSON, `FileNotFoundError` where there is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise Damaged(f"{path} is damaged: it is not JSON") from error


def save_tree(path: Path, tree: PyTree, header: dict[str, str] | None = None) -> None:
    """Write a tree's arrays to a safetensors file, whole or not at all. An array that stands in it twice is stored once."""
    arrays: dict[str, np.ndarray] = {}
    metadata = {"format": str(FORMAT), **(header or {})}
    seen: dict[int, str] = {}
    for name, leaf in named_leaves(tree).items():
        if isinstance(leaf, bool | int | float):
            # A number of Python's has the type that it has in a compiled program, where it will be looked for.
            arrays[name] = np.asarray(jnp.asarray(leaf))
            continue
        if id(leaf) in seen:
            metadata[f"same:{name}"] = seen[id(leaf)]
            continue
        seen[id(leaf)] = name
        if is_key(leaf):
            metadata[f"key:{name}"] = str(jax.random.key_impl(leaf))
            leaf = jax.random.key_data(leaf)
        # safetensors silently writes the memory of a non-contiguous array in the wrong order.
        arrays[name] = np.ascontiguousarray(jax.device_get(leaf)).reshape(np.shape(leaf))
    temporary = path.with_name(f".{path.name}.tmp")
    save_file(arrays, temporary, metadata)
    sync(temporary)
    os.replace(temporary, path)


def load_tree(path: Path, like: PyTree) -> PyTree:
    """Read a tree of the structure, shapes and types of `like` (arrays or `jax.ShapeDtypeStruct`s).

    Raises `Damaged` where the file is damaged, newer, or holds something else, naming the first thing that differs.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except FileNotFoundError:
        raise Damaged(f"{path} is missing") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise Damaged(f"{path} is damaged and cannot be read ({error})") from error
    if not metadata.get("format", "").isdigit():
        raise Damaged(f"{path} was not written by rewardtogo")
    if int(metadata["format"]) > FORMAT:
        raise Damaged(
            f"{path} has format {metadata['format']}, which is newer than this library's {FORMAT}: "
            "install a newer rewardtogo"
        )
    extra = sorted(set(arrays) - {metadata.get(f"same:{name}", name) for name in named_leaves(like)})
    if extra:
        raise Damaged(
            f"{path} has {extra[0]}, which was not expected: it belongs to another algorithm, network or environment"
        )
    leaves = [_restore(path, name, leaf, arrays, metadata) for name, leaf in named_leaves(like).items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _restore(path: Path, name: str, like: Any, arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> jax.Array:
    stored = metadata.get(f"same:{name}", name)
    if stored not in arrays:
        raise Damaged(f"{path} has no {name}: it belongs to another algorithm, network or environment")
    array = arrays[stored]
    if is_key(like):
        generator = metadata.get(f"key:{stored}")
        if generator is None:
            raise Damaged(f"{path}: {name} should be a random key and is not")
        value = jax.random.wrap_key_data(jnp.asarray(array), impl=generator)
    else:
        value = array
    if value.shape != tuple(like.shape) or value.dtype != like.dtype:
        raise Damaged(
            f"{path}: {name} is {value.dtype}{list(value.shape)}, and {like.dtype}{list(like.shape)} was "
            "expected: it belongs to another algorithm, network or environment"
        )
    return jnp.asarray(value)
