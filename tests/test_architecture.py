"""What the source may look like: who imports whom, and what is nowhere to be found. Read with `ast`; nothing is imported but names."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import rewardtogo
from rewardtogo.catalogue import ALGORITHMS, LOOPS

SOURCE = Path(rewardtogo.__file__).parent
FILES = sorted(SOURCE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}

CHAPTERS = {
    "imitation",
    "policy_gradient",
    "actor_critic",
    "value",
    "planning",
    "model_based",
    "variational",
    "inference",
    "inverse",
    "transfer",
    "exploration",
    "offline",
}
LAYERS: tuple[set[str], ...] = (
    {"core"},
    {"ops", "nn", "data"},
    {"envs"},
    {"exact"},
    {"loops"},
    CHAPTERS,
    {"runner"},
    {"label"},
    {"figures", "cli"},
)
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
SIDEWAYS = {
    ("nn", "ops"),
    ("data", "ops"),
    ("cli", "figures"),
    ("actor_critic", "policy_gradient"),
    ("model_based", "planning"),
    ("inverse", "policy_gradient"),
    ("inverse", "inference"),
    ("offline", "value"),
    ("exploration", "value"),
    ("transfer", "value"),
}
"""Who may import whom within a layer; nobody else."""
TOP = {"catalogue": LEVEL["envs"], "presets": LEVEL["runner"], "": LEVEL["runner"]}
"""The modules beside the rooms (`""` is the package itself), and from which layer upwards they may be imported."""
BELOW_RUNNER = {room for room, level in LEVEL.items() if level < LEVEL["runner"]}
PROTOCOL_BASES = {"Configured"}
"""Modules that are there to be inherited from although no method of theirs is abstract. They have no fields."""
REFLECTION = {"runner/config.py", "runner/plan.py"}
"""Where the name or the home of a foreign object is asked for, which it may not have; nowhere else."""


def room_of(path: Path) -> str:
    parts = path.relative_to(SOURCE).parts
    return parts[0] if len(parts) > 1 else ""


def name_of(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def module_of(path: Path) -> tuple[str, ...]:
    """The dotted name inside the package, as a tuple; of a package's `__init__` the package."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def file_of(module: tuple[str, ...]) -> Path | None:
    for path in (
        SOURCE.joinpath(*module).with_suffix(".py") if module else None,
        SOURCE.joinpath(*module, "__init__.py"),
    ):
        if path is not None and path in TREES:
            return path
    return None


def imports(path: Path) -> Iterator[tuple[tuple[str, ...], str, str, int]]:
    """Module, name, name here and line of everything that a file imports from the package, wherever in it."""
    package = module_of(path) if path.name == "__init__.py" else module_of(path)[:-1]
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.ImportFrom):
            if node.level:
                base = package[: len(package) - node.level + 1]
            elif (node.module or "").split(".")[0] == "rewardtogo":
                base = ()
            else:
                continue
            module = tuple((node.module or "").split(".")) if node.module else ()
            module = base + (module[1:] if not node.level else module)
            for alias in node.names:
                yield module, alias.name, alias.asname or alias.name, node.lineno
        if isinstance(node, ast.Import):
            for alias in node.names:
                assert alias.name.split(".")[0] != "rewardtogo", f"{name_of(path)}:{node.lineno}: import it relatively"


def rooms_imported(path: Path) -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Room (or module beside the rooms), whole path and line of each import."""
    for module, name, _, line in imports(path):
        whole = (*module, name) if file_of((*module, name)) is not None else module
        yield whole[0] if whole else "", whole, line


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def fail(found: list[str]) -> None:
    assert not found, "\n".join(found)


def test_every_room_has_a_layer():
    rooms = {room_of(path) for path in FILES} - {""}
    assert rooms <= set(LEVEL), rooms - set(LEVEL)
    assert {path.stem for path in FILES if room_of(path) == ""} == {"__init__", "catalogue", "presets"}


def test_imports_go_downwards():
    found = []
    for path in FILES:
        room = room_of(path)
        for other, _, line in rooms_imported(path):
            if room == "":
                allowed = name_of(path) == "__init__.py"
            elif other in TOP:
                allowed = LEVEL[room] >= TOP[other]
            else:
                allowed = other == room or LEVEL[other] < LEVEL[room] or (room, other) in SIDEWAYS
            if not allowed:
                found.append(f"{name_of(path)}:{line} imports {other or 'the package itself'}")
    fail(found)


def test_only_the_command_knows_the_labelling_room():
    fail(
        [
            f"{name_of(path)}:{line} imports {'.'.join(whole)}"
            for path in FILES
            if room_of(path) not in ("label", "cli")
            for other, whole, line in rooms_imported(path)
            if other == "label"
        ]
    )


def test_the_labelling_room_stands_on_a_few_others():
    below = {"label", "imitation", "runner", "envs", "core", "data", "catalogue"}
    found = [
        f"{name_of(path)}:{line} imports {other}"
        for path in FILES
        if room_of(path) == "label"
        for other, _, line in rooms_imported(path)
        if other not in below
    ]
    fail(found)


def test_chapter_rooms_know_no_concrete_environment():
    """They are written against `core`: of `envs` they may use what is none: MDP, POMDP and their sparse kin."""
    fail(
        [
            f"{name_of(path)}:{line} imports {'.'.join(whole)}"
            for path in FILES
            if room_of(path) in CHAPTERS
            for other, whole, line in rooms_imported(path)
            if other == "envs" and whole[:2] not in (("envs", "tabular"), ("envs", "sparse"))
        ]
    )


def test_only_data_and_the_top_read_files_and_surroundings():
    modules = {"os", "sys", "pathlib", "shutil", "tempfile", "io", "subprocess", "argparse", "glob"}
    found = []
    for path in FILES:
        if room_of(path) not in BELOW_RUNNER - {"data"}:
            continue
        for node in ast.walk(TREES[path]):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            found += [f"{name_of(path)}:{node.lineno} imports {n}" for n in names if n.split(".")[0] in modules]  # type: ignore[attr-defined]
        found += [f"{name_of(path)}:{call.lineno} opens a file" for name, call in calls(path) if name == "open"]
    fail(found)


def test_nothing_is_printed_below_the_runner():
    fail(
        [
            f"{name_of(path)}:{call.lineno} calls {name}"
            for path in FILES
            if room_of(path) in BELOW_RUNNER
            for name, call in calls(path)
            if name == "print" or name.startswith(("jax.debug", "debug."))
        ]
    )


def test_no_pickle_no_super_no_assert():
    found = []
    for path in FILES:
        found += [f"{name_of(path)}:{call.lineno} calls super()" for name, call in calls(path) if name == "super"]
        for node in ast.walk(TREES[path]):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            bad = {n for n in names if n.split(".")[0] in ("pickle", "cloudpickle", "dill", "shelve", "marshal")}
            found += [f"{name_of(path)}:{node.lineno} imports {n}" for n in bad]  # type: ignore[attr-defined]
            if isinstance(node, ast.Assert):
                found.append(f"{name_of(path)}:{node.lineno} asserts: raise ValueError with a sentence")
    fail(found)


def test_no_feature_tests():
    """`getattr` with a computed name walks over fields; with a written one, like `hasattr`, it asks what an object can do."""
    found = []
    for path in FILES:
        if name_of(path) in REFLECTION:
            continue
        for name, call in calls(path):
            written = len(call.args) > 1 and isinstance(call.args[1], ast.Constant)
            if name == "hasattr" or (name == "getattr" and written):
                found.append(f"{name_of(path)}:{call.lineno} {ast.unparse(call)}")
    fail(found)


# --- classes ---------------------------------------------------------------------------------------------------------

CLASSES = {
    (module_of(path), node.name): node
    for path in FILES
    for node in ast.walk(TREES[path])
    if isinstance(node, ast.ClassDef)
}
Name = tuple[tuple[str, ...], str]


def top_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a module, those under an `if` included."""
    for node in body:
        yield node
        if isinstance(node, ast.If):
            yield from top_level(node.body + node.orelse)


def resolve(module: tuple[str, ...], name: str, depth: int = 0) -> Name | None:
    """Where a name that a module sees was defined; None outside the package."""
    path = file_of(module)
    if path is None or depth > 8:
        return None
    for node in top_level(TREES[path].body):
        defined = isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name
        if defined or (isinstance(node, ast.Assign) and any(ast.unparse(t) == name for t in node.targets)):
            return module, name
    for source, original, here, _ in imports(path):
        if here == name:
            return resolve(source, original, depth + 1)
    return None


def bases(cls: Name) -> list[Name | str]:
    """Base classes: names in the package, and the text of foreign ones."""
    texts = [ast.unparse(base).split("[")[0] for base in CLASSES[cls].bases]
    found = [(text, resolve(cls[0], text)) for text in texts]
    return [place if place in CLASSES else text for text, place in found]  # type: ignore[misc]


def is_module(cls: Name | str) -> bool:
    return cls in ("eqx.Module", "Module") if isinstance(cls, str) else any(is_module(base) for base in bases(cls))


def abstract_methods(cls: Name | str) -> set[str]:
    """The methods that are still to be written."""
    if isinstance(cls, str):
        return set()
    body = CLASSES[cls].body
    methods = {node.name: node for node in body if isinstance(node, ast.FunctionDef)}
    own = {n for n, m in methods.items() if any("abstractmethod" in ast.unparse(d) for d in m.decorator_list)}
    fields = {ast.unparse(node.target) for node in body if isinstance(node, ast.AnnAssign)}
    inherited = set().union(*(abstract_methods(base) for base in bases(cls)))
    return (inherited - set(methods) - fields) | own


def fields_of(cls: Name) -> list[str]:
    """Its own fields; an `AbstractVar` is a promise of one, not one."""
    own = [node for node in CLASSES[cls].body if isinstance(node, ast.AnnAssign)]
    return [ast.unparse(node.target) for node in own if "AbstractVar" not in ast.unparse(node.annotation)]


MODULES = [cls for cls in CLASSES if is_module(cls)]


def inheritance_faults(classes: list[Name]) -> list[str]:
    found = []
    for cls in classes:
        for base in bases(cls):
            if not isinstance(base, str) and base[1] not in PROTOCOL_BASES and not abstract_methods(base):
                found.append(f"{'.'.join(cls[0])}.{cls[1]} inherits {base[1]}, which is final")
        if (abstract_methods(cls) or cls[1] in PROTOCOL_BASES) and fields_of(cls):
            found.append(f"{'.'.join(cls[0])}.{cls[1]} is abstract and has fields {fields_of(cls)}")
    return found


def test_modules_are_abstract_or_final():
    assert len(MODULES) > 40
    fail(inheritance_faults(MODULES))


def test_the_rule_finds_what_it_forbids(monkeypatch):
    """The rule above, on classes made to break it: one that inherits a final one, and an abstract one with a field."""
    text = """
class Final(eqx.Module):
    x: int
class Child(Final):
    y: int
class Abstract(eqx.Module):
    z: int
    @abstractmethod
    def method(self): ...
"""
    path = SOURCE / "core" / "made_up.py"
    monkeypatch.setitem(TREES, path, ast.parse(text))
    made = [(("core", "made_up"), node.name) for node in TREES[path].body if isinstance(node, ast.ClassDef)]
    for cls, node in zip(made, TREES[path].body, strict=True):
        monkeypatch.setitem(CLASSES, cls, node)
    assert all(is_module(cls) for cls in made)
    assert len(inheritance_faults(made)) == 2


# --- what is public --------------------------------------------------------------------------------------------------


def exported() -> Iterator[Name]:
    """Every name that a package's `__init__` hands out, where it is defined."""
    for path in FILES:
        if path.name == "__init__.py":
            for module, name, here, _ in imports(path):
                if not here.startswith("_") and file_of((*module, name)) is None:
                    place = resolve(module, name)
                    assert place is not None, f"{name_of(path)} hands out {name}, which is nowhere defined"
                    yield place


def test_public_symbols_have_docstrings():
    found = []
    for module, name in sorted(set(exported())):
        path = file_of(module)
        assert path is not None
        body = TREES[path].body
        for i, node in enumerate(body):
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
                if not ast.get_docstring(node):
                    found.append(f"{name_of(path)}:{node.lineno} {name} has no docstring")
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name and name.isupper():
                after = body[i + 1] if i + 1 < len(body) else None
                if not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)):
                    found.append(f"{name_of(path)}:{node.lineno} {name} has no docstring under it")
    fail(found)


def test_modules_have_docstrings():
    empty_package = lambda path: path.name == "__init__.py" and not TREES[path].body  # noqa: E731
    fail([name_of(p) for p in FILES if not empty_package(p) and not ast.get_docstring(TREES[p])])


def defines(path_and_name: str) -> bool:
    module, _, name = path_and_name.partition(":")
    return resolve(tuple(module.split(".")[1:]), name) in CLASSES


def test_catalogue_paths_resolve():
    paths = [row.path for row in ALGORITHMS.values()] + list(LOOPS.values())
    fail([path for path in paths if not defines(path)])
    fail([f"{row.name}: no loop {row.loop}" for row in ALGORITHMS.values() if row.loop not in LOOPS])
    fail([f"{key} is called {row.name}" for key, row in ALGORITHMS.items() if row.name != key])


def test_lazy_names_resolve_and_agree_with_the_typed_ones():
    homes = {name: tuple(home.split(".")) for name, home in rewardtogo._HOME.items()}
    fail([f"{name} is not in {'.'.join(home)}" for name, home in homes.items() if resolve(home, name) is None])
    init = SOURCE / "__init__.py"
    typed = {here: resolve(module, name) for module, name, here, _ in imports(init)}
    assert typed == {name: resolve(home, name) for name, home in homes.items()}
    packages = {p.parent.name for p in FILES if p.name == "__init__.py"} - {"rewardtogo", "cli"}
    assert packages == set(rewardtogo._ROOMS)


@pytest.mark.parametrize(
    "program",
    [
        "import rewardtogo",
        "from rewardtogo.cli.main import main; main(['--help'])",
        "from rewardtogo.cli.main import main; main(['list'])",
        "from rewardtogo.cli.main import main; main(['list', '--envs'])",
        "from rewardtogo.cli.main import main; main(['--version'])",
    ],
)
def test_nothing_imports_jax_that_does_not_need_it(program):
    code = f"import sys\ntry:\n    {program}\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
    code += "heavy = {'jax', 'equinox', 'gymnasium', 'matplotlib', 'starlette', 'uvicorn'} & set(sys.modules)\nassert not heavy, heavy"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_names_of_test_files_are_unique():
    """pytest imports test files by their names alone."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert len(names) == len(set(names)), sorted({name for name in names if names.count(name) > 1})
