"""The documentation: its Python runs, its options exist, its tables say what the code does, its links lead somewhere."""

import functools
import os
import re
import runpy
import shlex
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import rewardtogo as rtg
from rewardtogo.catalogue import ALGORITHMS, LOOPS, Row
from rewardtogo.cli.main import _nested, _parsers
from rewardtogo.core import Transition, env_spec
from rewardtogo.data.episodes import Dataset
from rewardtogo.planning import Distill, SelfPlay
from rewardtogo.runner.config import PARTS, build, merge, options, resolve
from rewardtogo.runner.plan import search_model

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
EXAMPLES = ROOT / "examples"
PAGES = sorted(p for p in [*ROOT.glob("*.md"), *DOCS.rglob("*.md")] if p.name != "coverage.md")
CHAPTERS = sorted((DOCS / "chapters").glob("*.md"))
CHAPTER = DOCS / "chapters" / "01-introduction.md"
RUN = [
    ROOT / "README.md",
    *CHAPTERS,
    *(DOCS / f"{name}.md" for name in ("tour", "environments", "networks", "learners", "callbacks", "notation")),
]
"""Pages whose Python runs from top to bottom."""

TABLE = _parsers()[1]
OPTIONS = {name: {o for a in parser._actions for o in a.option_strings} for name, parser in TABLE.items()}


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page, with included files in their places."""
    found = re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [
        re.sub(r'^--8<-- "(.*?)"$', lambda m: (ROOT / m[1]).read_text(encoding="utf-8"), b, flags=re.M) for b in found
    ]


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Pages share what they compile."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    old = {name: jax.config.values[name] for name in names}
    for name, value in zip(names, (str(tmp_path_factory.mktemp("programs")), 0.1), strict=True):
        jax.config.update(name, value)
    yield
    for name, value in old.items():
        jax.config.update(name, value)


# --- what runs -----------------------------------------------------------------------------------------------------------------


def execute(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Run a page's blocks in one module, in an empty folder; how many there were."""
    monkeypatch.chdir(folder)
    module = types.ModuleType(f"page_{re.sub(r'[^a-z0-9]', '_', page.stem.lower())}")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    found = blocks(page, "python")
    for number, block in enumerate(found, 1):
        exec(compile(block, f"{name_of(page)}, block {number}", "exec"), vars(module))
    return len(found)


@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch, item):
    if page != CHAPTER:
        assert execute(page, tmp_path, monkeypatch) > 0
        return
    with item("1.26") as check:
        check(execute(page, tmp_path, monkeypatch), ">=", 10, what="snippets run")


def test_primer_has_a_notation_table(item):
    text = (DOCS / "notation.md").read_text(encoding="utf-8")
    rows = ["| $s_t$ | $x_t$ |", "| $a_t$ | $u_t$ |", "| $r(s_t, a_t)$ | $-c(x_t, u_t)$ |", "**Time counts from 0.**"]
    with item("1.26") as check:
        check(sum(row in text for row in rows), "==", 4, what="notations explained: state, action, cost, time")


def test_start_page_shows_what_the_readme_shows():
    assert blocks(DOCS / "index.md", "python") == [
        b.replace(", one observation or a batch", "") for b in blocks(ROOT / "README.md", "python")
    ]


def test_python_elsewhere_is_none():
    silent = [p for p in PAGES if p not in RUN and p != DOCS / "index.md"]
    assert not [name_of(p) for p in silent if blocks(p, "python")]


def test_quickstart_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rtg, "train", functools.partial(rtg.train, steps=20_000, quiet=True), raising=False)
    runpy.run_path(str(EXAMPLES / "quickstart.py"), run_name="__main__")
    assert "probabilities" in capsys.readouterr().out


def test_command_finds_a_module_in_the_current_folder():
    command = [str(Path(sys.executable).parent / "rtg"), "train", "actor_critic:A2C", "CartPole-v1", "--help"]
    done = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0 and "--learner.gae-lambda" in done.stdout, done.stderr


# --- options -------------------------------------------------------------------------------------------------------------------


def commands() -> list[tuple[str, str]]:
    """Every line of a shell block that calls `rtg`, and its page."""
    lines = [(name_of(p), line) for p in PAGES for b in blocks(p, "bash") for line in b.splitlines()]
    return [(page, line.split("#")[0].strip()) for page, line in lines if line.startswith("rtg ")]


def class_of(algorithm: str) -> type:
    return resolve(algorithm if ":" in algorithm else ALGORITHMS[algorithm].path)


@pytest.mark.parametrize(("page", "line"), commands())
def test_command_is_one(page, line, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    _, command, *words = shlex.split(line)
    if "--help" in words:
        assert class_of(words[0])
        return
    given, rest = TABLE[command].parse_known_args(words)
    if command == "solve":
        assert set(_nested(rest, ("env",), "solve")) == {"env"}
        return
    if command != "train":
        assert not rest
        return
    groups = _nested(rest, ("learner", "loop", "env"))
    cls = class_of(given.algorithm)
    row = ALGORITHMS.get(given.algorithm)
    learner = build(cls, merge(row.learner if row else {}, groups["learner"]))
    kind = row.loop if row else "on_policy"
    assert set(groups["loop"]) <= set(options(resolve(LOOPS[kind]))), line
    assert isinstance(learner, rtg.Learner)


def known_options() -> set[str]:
    """Every option of every command, algorithm, loop and part."""
    found = set().union(
        *OPTIONS.values(),
        {"--version", "--learner.NAME", "--loop.NAME", "--env.NAME", "--env.KEY", "--env.normalise-reward"},
    )
    found |= {"--learner.FIELD", "--loop.FIELD", "--learner.network.FIELD", "--planner.FIELD"}
    classes = [("learner", class_of(name)) for name in ALGORITHMS] + [
        ("loop", resolve(path)) for path in LOOPS.values()
    ]
    for group, cls in classes:
        for name, field in options(cls).items():
            option = f"--{group}.{name.replace('_', '-')}"
            found.add(option)
            if field.metadata.get("part"):
                found |= {f"{option}.{inner.replace('_', '-')}" for part in PARTS.values() for inner in options(part)}
    return found


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_options_exist(page):
    text = page.read_text(encoding="utf-8")
    spans = [s for s in re.findall(r"`([^`\n]+)`", text) if s.startswith(("rtg ", "--"))]
    if page.name == "contract.md":
        spans += re.findall(r"^rtg .*(?:\n  .*)*", text, re.MULTILINE)
    named = {o for span in spans for o in re.findall(r"(?<![\w-])--[a-zA-Z][\w.-]*", span)}
    assert named <= known_options(), named - known_options()


def test_contract_names_every_option():
    text = (DOCS / "contract.md").read_text(encoding="utf-8")
    synopsis = re.findall(r"^rtg (\S+)(.*(?:\n  .*)*)", text, re.MULTILINE)
    for command, rest in synopsis:
        if command in OPTIONS:
            missing = {o for o in OPTIONS[command] - {"-h", "--help"} if not re.search(rf"{o}(?![\w-])", rest)}
            assert not missing, (command, missing)
    assert {command for command, _ in synopsis} >= set(TABLE)


# --- tables --------------------------------------------------------------------------------------------------------------------


def test_every_public_name_is_on_the_api_page():
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^::: rewardtogo\.(\w+)$", text, re.MULTILINE)) == set(rtg.__all__) - {"__version__"}


def algorithm_of(row: Row, env_name: str) -> rtg.Algorithm:
    """The smallest algorithm of a row of the catalogue."""
    simulated = {"dynamics": {"class": "simulator", "env": env_name}} if row.name == "fvi" else {}
    learner = build(resolve(row.path), row.learner | simulated)
    env = rtg.make("FrozenLake-v1" if isinstance(learner, rtg.QLearning) else env_name, 2)
    if row.loop == "on_policy":
        return rtg.OnPolicy(env, learner, unroll=learner.horizon if isinstance(learner, rtg.SOLAR) else 8)
    if row.loop == "asynchronous":
        return rtg.Asynchronous(env, learner, workers=2, unroll=4)
    if row.loop == "off_policy":
        return rtg.OffPolicy(env, learner, rtg.UniformReplay(64), unroll=2, warm_up=8, batch_size=4)
    if row.loop == "dagger":
        spec = env_spec(env)
        expert = rtg.as_expert(lambda observation: spec.action.zeros(), spec)
        return rtg.DAgger(env, learner, expert, unroll=2, updates=1, batch_size=2)
    if row.loop == "distill":
        return Distill(env, learner, search_model(env), simulations=2, unroll=1, updates=1, batch_size=2)
    if row.loop == "self_play":
        env = rtg.make("TicTacToe", 2)
        return SelfPlay(env, learner, search_model(env), simulations=2, max_plies=2, updates=1, batch_size=2)
    spec, steps = env_spec(env), jnp.arange(4)
    element = lambda s: jax.tree.map(lambda x: jnp.broadcast_to(x, (4, *x.shape)), s.zeros())  # noqa: E731
    observation, never = element(spec.observation), jnp.zeros(4, bool)
    whole = Transition(observation, element(spec.action), jnp.zeros(4), steps == 3, never, observation, {})
    return rtg.Offline(Dataset.of(whole, spec), learner, batch_size=4)


def metrics_of(row: Row) -> set[str]:
    found: set[str] = set()
    for kind, env in (("discrete", "CartPole-v1"), ("box", "Pendulum-v1")):
        if kind in row.actions:
            algorithm, key = algorithm_of(row, env).with_horizon(10), jax.random.key(0)
            state = jax.eval_shape(algorithm.init, key)
            found |= set(jax.eval_shape(algorithm.step, state, key)[1][0])
    return found


@pytest.mark.parametrize("name", ALGORITHMS)
def test_metrics_are_on_the_algorithms_page(name):
    text = (DOCS / "algorithms" / f"{name}.md").read_text(encoding="utf-8")
    section = text.split("\n## Metrics\n")[1].split("\n## ")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == metrics_of(ALGORITHMS[name])


def test_every_algorithm_is_in_the_tables():
    for page in (ROOT / "README.md", DOCS / "index.md", DOCS / "algorithms" / "index.md"):
        text = page.read_text(encoding="utf-8")
        assert all(f"`{name}`" in text for name in ALGORITHMS), name_of(page)


def test_changes_know_the_version():
    assert f"\n## {rtg.__version__}\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


# --- links ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`\n]*`", "", text)
    targets = [t.split("#")[0] for t in re.findall(r"\]\(([^)\s]+)\)", text) if not t.startswith(("http", "#"))]
    assert not [t for t in targets if t and not (page.parent / t).exists()]
