"""`<!-- options:ppo -->` in a page becomes the tables of an algorithm's hyperparameters, read from the classes themselves."""

import re
from typing import Any

from rewardtogo.catalogue import ALGORITHMS, LOOPS
from rewardtogo.cli.commands import _shown
from rewardtogo.runner.config import options, resolve

MARK = re.compile(r"<!-- options:(\w+) -->")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Fill in the marks."""
    return MARK.sub(lambda match: _tables(match[1]), markdown)


def _tables(name: str) -> str:
    row = ALGORITHMS[name]
    learner, loop = resolve(row.path), resolve(LOOPS[row.loop])
    return "\n".join(
        [
            "| option | default | range | meaning |",
            "|---|---|---|---|",
            *_rows("learner", learner, row.learner),
            *_rows("loop", loop, row.loop_options),
        ]
    )


def _rows(group: str, cls: type, settings: dict[str, Any]) -> list[str]:
    found = []
    for name, field in options(cls).items():
        about: dict[str, Any] = dict(field.metadata)
        span = " or ".join(map(str, about.get("choices") or ())) or str(about.get("range", ""))
        span = "" if span == "(-inf, inf)" else span
        found.append(f"| `--{group}.{name.replace('_', '-')}` | {_shown(settings.get(name, field.default))} | {span} | {about['doc']} |")
    return found
