"""The commands that open a page for a person: `rtg label` and `rtg demonstrate`."""

import argparse
import contextlib
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import Any

from ..catalogue import ENVIRONMENTS
from .main import RequestError, value_of


def _require_web(given: argparse.Namespace) -> None:
    """Raise `RequestError` where a page cannot be served as it is asked for."""
    if importlib.util.find_spec("starlette") is None or importlib.util.find_spec("uvicorn") is None:
        raise RequestError("the page needs a small web server: pip install 'rewardtogo[web]'")
    if not 0 <= given.pause <= 3600:
        raise RequestError(f"the pause must be 0 to 3600 seconds, not {given.pause:g}")


def _names(given: argparse.Namespace) -> tuple[str, ...]:
    return tuple(name.strip() for name in given.actions.split(",")) if given.actions else ()


def _say_aloud(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def demonstrate(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    """Play an environment on a page, and keep the episodes as demonstrations (`rtg demonstrate`)."""
    _require_web(given)
    from ..label.playing import EPISODES, start_playing
    from ..label.stage import serve_playing
    from ..label.web import listen, new_token

    token = new_token(given.token)
    with contextlib.closing(listen(given.host, given.port)) as listening:
        playing = start_playing(
            given.env,
            out=given.out,
            episodes=EPISODES if given.episodes is None else given.episodes,
            seed=given.seed,
            backend=given.backend or "auto",
            env_kwargs={k: value_of(v) for k, v in groups["env"].items()},
        )
        with playing:
            if not given.quiet and playing.kept:
                _say_aloud(f"{playing.dataset.path} has {playing.kept} of {playing.episodes} episodes")
            options = {"rate": given.rate, "pause": given.pause, "actions": _names(given), "say": _say_aloud}
            path, found = serve_playing(playing, listening, token, **options)
    if given.json:
        print(json.dumps({"dataset": str(path), **found}))
    else:
        print(
            f"{path}   return {found['return_mean']:.2f} in {found['episodes']} episodes of {found['length_mean']:.1f} steps"
        )


def label(given: argparse.Namespace, groups: dict[str, dict[str, Any]]) -> None:
    """Label observations in rounds of DAgger, on a page (`rtg label`)."""
    _require_web(given)
    from ..label.run import ROUND_SIZE, ROUNDS, open_labelling, start_labelling
    from ..label.server import serve
    from ..label.web import listen, new_token

    token = new_token(given.token)
    known = (Path(given.run) / "config.json").exists()
    begins = {
        **{f"--{name}": vars(given)[name.replace("-", "_")] for name in ("size", "votes", "num-envs", "seed", "out")},
        **{f"--{name}": vars(given)[name] for name in ("backend", "data")},
        **{f"--{name}.{next(iter(group), '')}": group or None for name, group in groups.items()},
    }
    set_already = [name for name, value in begins.items() if value is not None]
    if known and set_already:
        raise RequestError(f"{given.run} is a run whose {set_already[0]} is settled already: leave the option out")
    if not known and (Path(given.run).is_dir() or os.sep in given.run) and given.run not in ENVIRONMENTS:
        # Atari's names have a slash too.
        if Path(given.run).is_dir() or not given.run.startswith("ALE/"):
            raise RequestError(f"{given.run} is no run folder: it has no config.json")
    with contextlib.closing(listen(given.host, given.port)) as listening:
        if known:
            run = open_labelling(given.run, rounds=given.rounds, quiet=given.quiet)
        else:
            run = start_labelling(
                given.run,
                out=given.out,
                rounds=ROUNDS if given.rounds is None else given.rounds,
                size=ROUND_SIZE if given.size is None else given.size,
                votes=1 if given.votes is None else given.votes,
                num_envs=1 if given.num_envs is None else given.num_envs,
                seed=given.seed or 0,
                backend=given.backend or "auto",
                learner=groups["learner"],
                loop=groups["loop"],
                env_kwargs={k: value_of(v) for k, v in groups["env"].items()},
                data=given.data,
                command=["rtg", *given.arguments],
                quiet=given.quiet,
            )
        with run:
            found = serve(run, listening, token, pause=given.pause, actions=_names(given), say=_say_aloud)
            if given.json:
                print(json.dumps({"run": str(found.path), **(found.evaluation or {})}))
