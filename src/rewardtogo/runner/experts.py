"""Experts by name: the policy of a run, or a function of somebody's own (`--expert RUN|module:function`)."""

from pathlib import Path
from typing import Any

from ..core import EnvSpec, Policy
from ..data.checks import require_spec
from ..imitation.experts import as_expert, require_expert
from .config import resolve
from .policy import load

PERSON = "person"
"""The name of the expert who answers between two rounds, by way of files: `rtg label`."""


def expert_of(source: Any, spec: EnvSpec) -> Policy:
    """The expert that is named or given, checked against the spaces it is to act in.

    - `source`: a run's folder, whose best action counts; `module:name` of a function of an observation, or of a `Policy`;
      or either of these as an object. A name may lead to code, and so is never taken from a file.

    Raises `ValueError` where there is no such expert, or where it knows another environment.
    """
    if isinstance(source, Path) or (isinstance(source, str) and Path(source).exists()):
        loaded = load(source)
        require_spec(loaded.spec, spec, "the expert")
        expert = loaded.policy()
        require_expert(expert, spec)
        return expert
    if isinstance(source, str):
        if not is_code(source):
            raise ValueError(f"there is no run folder {source}: an expert is the folder of a run, or module:function")
        source = resolve(source)
    return as_expert(source, spec)


def is_code(source: str) -> bool:
    """Whether a name of an expert is one of code, and not a folder's."""
    return ":" in source and not Path(source).exists()
