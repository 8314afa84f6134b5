"""How fast this library is beside its peers: the same settings, the same machine, one run, contenders in turns.

    make bench                                             everything, about half an hour on two quiet cores
    .venv/bin/python benchmarks/bench.py --quick           short runs: shows that everything works, not how fast it is
    .venv/bin/python benchmarks/bench.py --only ppo dqn    some groups
    .venv/bin/python benchmarks/bench.py --write           also replaces the table in docs/results.md

The peers' pins clash, so each gets a virtual environment of its own beside this one. Every measurement is a process of its own; A B A B,
so that a busy moment of the machine hits all; medians.
"""

import argparse
import datetime
import json
import os
import platform
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
RESULTS = ROOT / "docs" / "results.md"
START, END = "<!-- bench:start -->", "<!-- bench:end -->"
BIN = "Scripts" if os.name == "nt" else "bin"
PEERS = {
    "sb3": "Stable-Baselines3",
    "sbx": "SBX",
    "rejax": "rejax",
    "quantecon": "quantecon",
    "mdptoolbox": "pymdptoolbox",
    "mctx": "mctx",
    "crocoddyl": "crocoddyl",
    "torch": "PyTorch",
    "imitation": "imitation",
}
ZOO = (
    "--preset none --num-envs 8 --loop.unroll 32 --learner.epochs 20 --learner.minibatches 1 --learner.gamma 0.98 "
    "--learner.gae-lambda 0.8 --learner.learning-rate linear:0.001:0 --learner.clip linear:0.2:0"
).split()

Result = dict[str, Any]


# --- the peers' virtual environments -----------------------------------------------------------------------------------------------


def peer_python(peer: str) -> Path:
    """The interpreter of a peer's virtual environment."""
    return ROOT / f".venv-{peer}" / BIN / ("python.exe" if os.name == "nt" else "python")


def requirements(peer: str) -> list[Path]:
    """What is installed, in this order: PyTorch by itself first, so that nothing else decides which build it is."""
    return [
        *([HERE / "peers" / "torch.txt"] if peer in ("sb3", "sbx", "imitation") else []),
        HERE / "peers" / f"{peer}.txt",
    ]


def peer_name(peer: str) -> str:
    """`SBX 0.28.0`: the first requirement says which."""
    version = re.search(r"==(\S+)", (HERE / "peers" / f"{peer}.txt").read_text(encoding="utf-8"))
    return f"{PEERS[peer]} {version.group(1) if version else ''}".strip()


def install(peer: str) -> str | None:
    """Build a peer's virtual environment, once for each state of its requirements; the reason where that cannot be done."""
    files, python = requirements(peer), peer_python(peer)
    wanted = "".join(file.read_text(encoding="utf-8") for file in files)
    stamp = ROOT / f".venv-{peer}" / ".installed"
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted:
        return None
    say(f"installing {peer_name(peer)}")
    commands = [] if python.exists() else [[sys.executable, "-m", "venv", str(ROOT / f".venv-{peer}")]]
    commands += [[str(python), "-m", "pip", "install", "--quiet", "-r", str(file)] for file in files]
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return last_line(done.stderr)[:200] or "pip failed"
    stamp.write_text(wanted, encoding="utf-8")
    return None


# --- measuring ---------------------------------------------------------------------------------------------------------------------


@dataclass
class Contender:
    """Something that can be run and timed. `command` is made anew for each run; `peer` names whose environment it needs."""

    command: Callable[[], list[str]]
    peer: str | None = None
    environment: dict[str, str] = field(default_factory=dict)
    before: Callable[[], None] | None = None


@dataclass
class Row:
    """A line of the table."""

    what: str
    ours: str
    peer: str
    ratio: float | None
    required: str
    met: bool | None

    def cells(self) -> list[str]:
        """Text, one a column."""
        met = "" if self.met is None else "yes" if self.met else "NO"
        ratio = "" if self.ratio is None else f"{self.ratio:.2f}"
        return [self.what, self.ours, self.peer, ratio, self.required, met]


COLUMNS = ["what", "ours", "peer", "ratio", "required", "met?"]


def say(text: str) -> None:
    """For whoever waits."""
    print(text, file=sys.stderr, flush=True)


def last_line(text: str) -> str:
    """The last line that says something."""
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    return lines[-1] if lines else ""


def once(contender: Contender) -> Result:
    """Run a contender: the JSON line that it printed, and the seconds of its process; or why there is none."""
    reason = install(contender.peer) if contender.peer else None
    if reason:
        return {"error": f"not installed: {reason}"}
    if contender.before:
        contender.before()
    # An installed library has its bytecode, whatever this machine wants of a checkout.
    quiet = {"PYTHONWARNINGS": "ignore", "TF_CPP_MIN_LOG_LEVEL": "3", "PYTHONDONTWRITEBYTECODE": ""}
    environment = {**os.environ, **quiet, **contender.environment}
    started = time.perf_counter()
    done = subprocess.run(contender.command(), capture_output=True, text=True, cwd=ROOT, env=environment)
    seconds = time.perf_counter() - started
    if done.returncode:
        return {"error": last_line(done.stderr)[:200] or f"exit status {done.returncode}"}
    line = last_line(done.stdout)
    printed = json.loads(line) if line.startswith("{") else {}
    return {**printed, "process_seconds": printed.get("process_seconds") or seconds}


def measure(contenders: dict[str, Contender], repeats: int) -> dict[str, Result]:
    """All contenders in turns, `repeats` times; the median of every number."""
    found: dict[str, list[Result]] = {name: [] for name in contenders}
    for lap in range(repeats):
        for name, contender in contenders.items():
            if found[name] and "error" in found[name][-1]:
                continue
            found[name].append(once(contender))
            say(f"  {lap + 1}/{repeats} {name}: {show(found[name][-1])}")
    return {name: middle(results) for name, results in found.items()}


def middle(results: Sequence[Result]) -> Result:
    """The median of every number; of a contender that failed, why."""
    errors = [r for r in results if "error" in r]
    if errors:
        return errors[0]
    numbers = [k for k, v in results[0].items() if isinstance(v, (int, float)) and not isinstance(v, bool)]
    return {name: statistics.median(r[name] for r in results) for name in numbers}


def show(result: Result) -> str:
    """A result in a few words."""
    if "error" in result:
        return result["error"]
    return ", ".join(f"{k} {v:,.4g}" for k, v in result.items() if isinstance(v, (int, float)))


def ours(*arguments: Any, **more: Any) -> Contender:
    """A measurement by `ours.py`."""
    return Contender(lambda: [sys.executable, str(HERE / "ours.py"), *map(str, arguments)], **more)


def script(name: str, *arguments: Any, peer: str | None = None) -> Contender:
    """A measurement by a script beside this one, or by one of a peer's."""
    python = lambda: sys.executable if peer is None else str(peer_python(peer))  # noqa: E731
    return Contender(lambda: [python(), str(HERE / name), *map(str, arguments)], peer)


def sb3(task: str, steps: int, library: str = "sb3") -> Contender:
    """A run of Stable-Baselines3 or SBX."""
    script = str(HERE / "peers" / "run_sb3.py")
    base = [str(peer_python(library)), script, task, "--library", library, "--steps", str(steps)]
    return Contender(lambda: [*base, "--began", repr(time.time())], library)


def rejax(task: str, steps: int) -> Contender:
    """A run of rejax."""
    return script("peers/run_rejax.py", task, "--steps", steps, peer="rejax")


# --- rows --------------------------------------------------------------------------------------------------------------------------


def speed_cell(result: Result) -> str:
    """Steps a second, whole process, final return."""
    if "error" in result:
        return result["error"]
    return f"{result['rate']:,.0f} steps/s (process {result['process_seconds']:.1f} s, return {result['return']:.0f})"


def against(what: str, mine: Result, label: str, other: Result, least: float | None) -> Row:
    """A row of steps a second."""
    failed = "error" in mine or "error" in other
    ratio = None if failed else mine["rate"] / other["rate"]
    met = None if least is None or ("error" in other and "error" not in mine) else ratio is not None and ratio >= least
    return Row(what, speed_cell(mine), f"{label}: {speed_cell(other)}", ratio, f"≥ {least:g} x" if least else "", met)


def limit(what: str, result: Result, name: str, most: float, unit: str, peer: str = "") -> Row:
    """A row that has an upper bound of its own."""
    if "error" in result:
        return Row(what, result["error"], peer, None, f"≤ {most:g} {unit}", False)
    value = result[name]
    return Row(what, f"{value:.3g} {unit}", peer, None, f"≤ {most:g} {unit}", value <= most)


def ppo(size: "Size") -> list[Row]:
    """PPO, compiled and through the door to Gymnasium, beside the three peers."""
    found = measure(
        {
            "ours": ours("train", "ppo", "--steps", size.ppo),
            "rejax": rejax("ppo", size.ppo),
            "sb3": sb3("ppo", size.ppo),
            "gymnasium": ours("train", "ppo", "--steps", size.ppo, "--backend", "gymnasium"),
            "sbx": sb3("ppo", size.ppo, "sbx"),
        },
        size.repeats,
    )
    what = f"PPO, CartPole-v1, 8 x 128 steps, 4 x 4 minibatches, 64x64 tanh, {size.ppo:,} steps"
    door = f"the same through `--backend gymnasium`, {size.ppo:,} steps"
    return [
        against(what, found["ours"], peer_name("sb3"), found["sb3"], 12),
        against(what, found["ours"], peer_name("sbx"), found["sbx"], None),
        against(what, found["ours"], peer_name("rejax"), found["rejax"], 1),
        against(door, found["gymnasium"], peer_name("sb3"), found["sb3"], 1.8),
    ]


def dqn(size: "Size") -> list[Row]:
    """DQN beside the three peers."""
    found = measure(
        {
            "ours": ours("train", "dqn", "--steps", size.dqn),
            "rejax": rejax("dqn", size.dqn),
            "rejax, 4 environments": rejax("dqn4", size.dqn),
            "sb3": sb3("dqn", size.dqn),
            "sbx": sb3("dqn", size.dqn, "sbx"),
        },
        size.repeats,
    )
    what = f"DQN, CartPole-v1, 1 environment, batch 64 every 4 steps, 64x64 ReLU, replay 100k, {size.dqn:,} steps"
    one, four = found["rejax"], found["rejax, 4 environments"]
    return [
        against(what, found["ours"], peer_name("sb3"), found["sb3"], 12),
        against(what, found["ours"], peer_name("sbx"), found["sbx"], None),
        against(what, found["ours"], f"{peer_name('rejax')} (learns every step)", one, 10),
        against(what, found["ours"], f"{peer_name('rejax')} (4 environments, so every 4 steps)", four, None),
    ]


def one_against(name: str, size: "Size", steps: int, what: str, peer: str, least: float) -> list[Row]:
    """One algorithm beside one of Stable-Baselines3's."""
    found = measure({"ours": ours("train", name, "--steps", steps), "sb3": sb3(name, steps)}, size.repeats)
    return [against(f"{what}, {steps:,} steps", found["ours"], peer, found["sb3"], least)]


def a2c(size: "Size") -> list[Row]:
    """A2C beside Stable-Baselines3's."""
    return one_against("a2c", size, size.ppo, "A2C, CartPole-v1, 8 x 5 steps, 64x64 tanh", peer_name("sb3"), 15)


def trpo(size: "Size") -> list[Row]:
    """TRPO beside sb3-contrib's."""
    what = "TRPO, CartPole-v1, 8 x 256 steps, 15 iterations of conjugate gradients, 64x64 tanh"
    return one_against("trpo", size, size.ppo, what, "sb3-contrib", 8)


def recurrent(size: "Size") -> list[Row]:
    """PPO with a memory beside sb3-contrib's."""
    what = "recurrent PPO, CartPole without velocities, LSTM of 64, 8 x 128 steps, 4 x 4 minibatches"
    return one_against("recurrent", size, size.recurrent, what, "sb3-contrib", 10)


def cheetah(size: "Size") -> list[Row]:
    """PPO in a MuJoCo environment, from the shell's prompt to the shell's prompt."""
    steps = size.cheetah
    options = (
        "--preset none --num-envs 8 --loop.unroll 256 --learner.epochs 10 --learner.minibatches 32 "
        "--learner.learning-rate 3e-4 --quiet --json"
    ).split()
    base = [str(Path(sys.executable).with_name("rtg")), "train", "ppo", "HalfCheetah-v5", "--steps", str(steps)]
    with tempfile.TemporaryDirectory() as folder:
        number = iter(range(10**6))
        contenders = {
            backend: Contender(
                lambda backend=backend: [*base, *options, "--backend", backend, "--out", f"{folder}/{next(number)}"]
            )
            for backend in ("gymnasium", "envpool")
        }
        found = measure({**contenders, "sb3": sb3("cheetah", steps)}, size.repeats)
    rows, theirs = [], found["sb3"]
    for backend in contenders:
        mine = found[backend]
        failed = "error" in mine or "error" in theirs
        ratio = None if failed else theirs["process_seconds"] / mine["process_seconds"]
        rows.append(
            Row(
                f"`rtg train ppo HalfCheetah-v5 --backend {backend}`, whole process, {steps:,} steps, 8 x 256, 10 x 32 minibatches",
                mine.get("error") or f"{mine['process_seconds']:.1f} s (return {mine['return_mean']:.0f})",
                f"{peer_name('sb3')}: " + (theirs.get("error") or f"{theirs['process_seconds']:.1f} s"),
                ratio,
                "≥ 1.5 x",
                None if "error" in theirs else ratio is not None and ratio >= 1.5,
            )
        )
    return rows


def continuous(size: "Size") -> list[Row]:
    """SAC and TD3 beside SB3, and beside the products of matrices that they need."""
    rows = []
    for name in ("sac", "td3"):
        found = measure(
            {"ours": ours("train", name, "--steps", size.continuous), "sb3": sb3(name, size.continuous)}, size.repeats
        )
        what = (
            f"{name.upper()}, Pendulum-v1, 1 environment, batch 256 every step, 256x256 ReLU, {size.continuous:,} steps"
        )
        rows.append(against(what, found["ours"], peer_name("sb3"), found["sb3"], 2))
        result = measure({"dots": ours("dots", name, "--repeats", size.laps)}, 1)["dots"]
        title = f"{name.upper()}, a whole step against `jnp.dot` on the shapes it needs, in a scan"
        if "error" in result:
            rows.append(Row(title, result["error"], "", None, "≥ 0.6", False))
            continue
        mine, other = f"{result['step_ms']:.2f} ms, {result['gflops']:.0f} GFLOP/s", f"{result['dots_ms']:.2f} ms"
        rows.append(Row(title, mine, other, result["ratio"], "≥ 0.6", result["ratio"] >= 0.6))
    return rows


def zoo(size: "Size") -> list[Row]:
    """From the shell's prompt to the shell's prompt."""
    steps = size.zoo
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        number = iter(range(10**6))
        rtg = lambda: [  # noqa: E731
            str(Path(sys.executable).with_name("rtg")), "train", "ppo", "CartPole-v1", "--steps", str(steps), *ZOO,
            "--out", f"{folder}/run-{next(number)}", "--quiet", "--json",
        ]  # fmt: skip
        environment = {"RTG_CACHE": str(cache)}
        other = sb3("zoo", steps)
        saved = Contender(lambda: [*other.command(), "--save", f"{folder}/model-{next(number)}"], "sb3")
        first = Contender(rtg, None, environment, lambda: shutil.rmtree(cache, ignore_errors=True))
        found = measure({"first": first, "cached": Contender(rtg, None, environment), "sb3": saved}, size.repeats)
    theirs = found["sb3"]
    peer = theirs.get("error") or f"{theirs['process_seconds']:.1f} s (return {theirs['return']:.0f})"
    rows = []
    for name, least in (("first", 3), ("cached", 5)):
        mine = found[name]
        cell = mine.get("error") or f"{mine['process_seconds']:.1f} s (return {mine['return_mean']:.0f})"
        failed = "error" in mine or "error" in theirs
        ratio = None if failed else theirs["process_seconds"] / mine["process_seconds"]
        rows.append(
            Row(
                f"`rtg train ppo CartPole-v1`, whole process to {steps:,} steps with rl-zoo's settings, {name}",
                cell,
                f"{peer_name('sb3')}: {peer}",
                ratio,
                f"≥ {least} x",
                None if "error" in theirs else ratio is not None and ratio >= least,
            )
        )
    return rows


def seeds(size: "Size") -> list[Row]:
    """Many seeds in one program."""
    rows = []
    for name, most in (("ppo", 0.85), ("dqn", 0.65)):
        result = measure({name: ours("seeds", name, "--repeats", size.laps)}, 1)[name]
        alone = "" if "error" in result else f"64 x one seed: {1e3 * result['alone']:.1f} ms"
        row = limit(
            f"64 seeds in one program, {name.upper()}, an iteration", result, "ratio", most, "of the time", alone
        )
        rows.append(row)
    return rows


def door(size: "Size") -> list[Row]:
    """What the way to Gymnasium costs."""
    result = measure({"door": ours("door", "--repeats", size.laps)}, 1)["door"]
    plain = "" if "error" in result else f"the environment's own step: {result['plain']:.3f} ms"
    return [limit("the door to Gymnasium alone, a step of 8 CartPoles", result, "door", 0.2, "ms", plain)]


def start(size: "Size") -> list[Row]:
    """How long until something happens."""
    found: dict[str, Result] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("ppo", "dqn"):
            cache = Path(folder) / name
            environment = {"RTG_CACHE": str(cache)}
            found |= measure(
                {
                    name: ours("start", name, environment=environment, before=lambda c=cache: shutil.rmtree(c, True)),
                    f"{name}, cached": ours("start", name, environment=environment),
                },
                size.repeats,
            )
    command = Contender(lambda: [str(Path(sys.executable).with_name("rtg")), "--help"])
    helped = measure({"help": command}, 2 * size.repeats + 1)["help"]
    limits = {"ppo": 6, "ppo, cached": 1.6, "dqn": 4, "dqn, cached": 1.1}
    title = "`init` and first chunk in a fresh process, "
    rows = [
        limit(title + name.replace("ppo", "PPO").replace("dqn", "DQN"), found[name], "seconds", most, "s")
        for name, most in limits.items()
    ]
    return [*rows, limit("`rtg --help`", helped, "process_seconds", 0.5, "s")]


def memory(size: "Size") -> list[Row]:
    """What a run needs beside its arrays."""
    result = measure({"memory": ours("memory", "--steps", size.memory)}, 1)["memory"]
    arrays = "" if "error" in result else f"arrays {result['arrays']:.0f} MB, peak {result['peak']:.0f} MB"
    row = limit(
        "memory beside the arrays, DQN with a replay of 1,000,000 CartPole transitions", result, "beside", 600, "MB"
    )
    row.ours += f" ({arrays})" if arrays else ""
    return [row]


def planning(size: "Size") -> list[Row]:
    """Value iteration on a random decision process, beside tabular packages. Each stops by its own rule for the same ε; ours by both."""
    contenders = {
        "ours": ours("dp", "--repeats", size.laps),
        **{name: script("peers/run_dp.py", name, peer=name) for name in ("quantecon", "mdptoolbox")},
    }
    found = measure(contenders, size.repeats)
    mine, rows = found["ours"], []
    what = "value iteration, 10,000 states, 10 actions, 10 successors, γ = 0.95, ε = 0.01, stopped by "
    # quantecon stops by the norm of the change, pymdptoolbox by its spread; bounds, which promise as much, are our default.
    for name, stop, least in (("quantecon", "bounds", 1), ("quantecon", "norm", None), ("mdptoolbox", "bounds", 20)):
        other = found[name]
        failed = "error" in mine or "error" in other
        ratio = None if failed else other["seconds"] / mine[stop]
        cell = mine.get("error") or f"{1e3 * mine[stop]:.1f} ms, {mine[f'{stop}_sweeps']:.0f} sweeps"
        theirs = other.get("error") or f"{1e3 * other['seconds']:.1f} ms, {other['sweeps']:.0f} sweeps"
        met = None if least is None or "error" in other else ratio is not None and ratio >= least
        rows.append(Row(what + stop, cell, f"{peer_name(name)}: {theirs}", ratio, f"≥ {least} x" if least else "", met))
    return rows


def mcts(size: "Size") -> list[Row]:
    """Tree search with a network, beside mctx: the same rules, network and positions."""
    other = script("peers/run_mctx.py", "--repeats", size.laps, peer="mctx")
    found = measure({"ours": ours("mcts", "--repeats", size.laps), "mctx": other}, size.repeats)
    mine, other = found["ours"], found["mctx"]
    failed = "error" in mine or "error" in other
    ratio = None if failed else other["seconds"] / mine["seconds"]
    what = "tree search with PUCT, Connect Four, 64 roots, 64 simulations, 128x128 ReLU, a decision for all roots"
    cell = lambda result: result.get("error") or f"{1e3 * result['seconds']:.1f} ms"  # noqa: E731
    met = None if "error" in other else ratio is not None and ratio >= 1
    return [Row(what, cell(mine), f"{peer_name('mctx')}: {cell(other)}", ratio, "≥ 1 x", met)]


def faster(what: str, mine: Result, name: str, label: str, other: Result, theirs: str, least: float | None) -> Row:
    """A row of seconds: `mine[name]` beside `other[theirs]`."""
    cell = lambda result, key: result.get("error") or f"{1e3 * result[key]:.3g} ms"  # noqa: E731
    failed = "error" in mine or "error" in other
    ratio = None if failed else other[theirs] / mine[name]
    met = None if least is None or ("error" in other and "error" not in mine) else ratio is not None and ratio >= least
    return Row(what, cell(mine, name), f"{label}: {cell(other, theirs)}", ratio, f"≥ {least:g} x" if least else "", met)


def control(size: "Size") -> list[Row]:
    """Planning and control: iLQR beside crocoddyl, regulators beside NumPy, CEM beside PyTorch and the products it needs."""
    rows, peer = [], peer_name("crocoddyl")
    for name in ("pendulum", "cartpole", "quadrotor", "unicycle"):
        both = measure(
            {
                "ours": script("control.py", "ilqr", name, "--repeats", size.laps),
                "crocoddyl": script("peers/run_crocoddyl.py", name, "--repeats", size.laps, peer="crocoddyl"),
            },
            size.repeats,
        )
        mine, other = both["ours"], both["crocoddyl"]
        if name == "unicycle":
            what = "iLQR, unicycle, 40 steps, each of 64 problems in one program, beside a model in C++"
            rows.append(faster(what, mine, "each", peer, other, "seconds", 1))
        else:
            rows.append(faster(f"iLQR, {name}, one problem", mine, "seconds", peer, other, "seconds", 1))
    numbers = measure({"lqr": script("control.py", "lqr", "--repeats", size.laps)}, size.repeats)["lqr"]
    what = "LQR, 12 states, 4 actions, 100 steps, 1,000 problems in one program, beside NumPy one after another"
    rows.append(faster(what, numbers, "seconds", "NumPy", numbers, "numpy", 20))
    both = measure(
        {
            "ours": script("control.py", "cem", "--repeats", size.laps),
            "torch": script("peers/run_torch_cem.py", "--repeats", size.laps, peer="torch"),
        },
        size.repeats,
    )
    mine, other = both["ours"], both["torch"]
    what = "CEM through 5 networks of 200x200, 500 candidates, 25 steps, 5 generations, a decision"
    rows.append(faster(what, mine, "seconds", peer_name("torch"), other, "seconds", None))
    rows.append(faster(f"{what}, against `jnp.dot` on the shapes it needs", mine, "seconds", "dots", mine, "dots", 0.5))
    return rows


def cloning(size: "Size") -> list[Row]:
    """Behavioural cloning beside `imitation`."""
    both = measure(
        {"ours": script("cloning.py"), "imitation": script("peers/run_imitation.py", peer="imitation")}, size.repeats
    )
    what = "BC, 100,000 transitions of 17 numbers, 10 epochs, batches of 256, 256x256 tanh, compilation included"
    return [faster(what, both["ours"], "seconds", peer_name("imitation"), both["imitation"], "seconds", 3)]


GROUPS = {
    "ppo": ppo,
    "dqn": dqn,
    "a2c": a2c,
    "trpo": trpo,
    "recurrent": recurrent,
    "cheetah": cheetah,
    "continuous": continuous,
    "zoo": zoo,
    "seeds": seeds,
    "door": door,
    "start": start,
    "memory": memory,
    "planning": planning,
    "mcts": mcts,
    "control": control,
    "cloning": cloning,
}


@dataclass
class Size:
    """How much is measured."""

    repeats: int = 5
    laps: int = 7
    ppo: int = 204_800
    dqn: int = 30_000
    continuous: int = 4_000
    zoo: int = 100_000
    memory: int = 40_000
    recurrent: int = 61_440
    cheetah: int = 102_400


QUICK = Size(
    repeats=1, laps=3, ppo=10_240, dqn=2_000, zoo=4_096, memory=8_000, recurrent=8_192, cheetah=8_192, continuous=400
)


# --- the table ---------------------------------------------------------------------------------------------------------------------


def plain_table(rows: Sequence[Row]) -> str:
    """For a terminal: a block a row, because cells are long."""
    found = []
    for row in rows:
        cells = dict(zip(COLUMNS, row.cells(), strict=True))
        verdict = f"   ratio {cells['ratio']}" if cells["ratio"] else ""
        verdict += f"   required {cells['required']}   met? {cells['met?']}" if cells["required"] else ""
        found.append(
            f"{row.what}\n    ours {row.ours}\n" + (f"    peer {row.peer}\n" if row.peer else "") + f" {verdict}"
        )
    return "\n".join(found)


def markdown(rows: Sequence[Row], size: Size) -> str:
    """For the documentation."""
    lines = [
        f"Measured on {datetime.date.today():%Y-%m-%d}: {machine()}; medians of {size.repeats} runs in turns.",
        "",
        f"| {' | '.join(COLUMNS)} |",
        f"|{' --- |' * len(COLUMNS)}",
        *(f"| {' | '.join(cell.replace('|', '/') for cell in row.cells())} |" for row in rows),
    ]
    return "\n".join(lines)


def machine() -> str:
    """What it was measured on."""
    from importlib.metadata import version

    ours = f"rewardtogo {version('rewardtogo')}, JAX {version('jax')}, Gymnasium {version('gymnasium')}"
    return f"{os.cpu_count()} CPU cores, {platform.system()} {platform.machine()}, Python {platform.python_version()}, {ours}"


def write(table: str) -> None:
    """Put the table between its marks."""
    text = RESULTS.read_text(encoding="utf-8")
    if START not in text or END not in text:
        raise SystemExit(f"{RESULTS} has no marks {START} and {END} to put the table between: add both, each on a line")
    head, rest = text.split(START, 1)
    RESULTS.write_text(f"{head}{START}\n{table}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


def main() -> int:
    """Measure; 1 where a requirement is not met."""
    parser = argparse.ArgumentParser(description="Speed beside the peers.")
    parser.add_argument(
        "--quick", action="store_true", help="short runs: shows that everything works, not how fast it is"
    )
    parser.add_argument("--only", nargs="+", choices=GROUPS, metavar="NAME", help=f"some of {', '.join(GROUPS)}")
    parser.add_argument("--repeats", type=int, help="runs of each contender")
    parser.add_argument("--write", action="store_true", help="replace the table in docs/results.md")
    given = parser.parse_args()
    if given.write and (given.only or given.quick):
        parser.error("--write is for a whole measurement: leave --only and --quick out")
    size = QUICK if given.quick else Size()
    size.repeats = given.repeats or size.repeats
    rows: list[Row] = []
    for name in given.only or GROUPS:
        say(name)
        rows += GROUPS[name](size)
    print(plain_table(rows))
    if given.write:
        write(markdown(rows, size))
    return int(any(row.met is False for row in rows))


if __name__ == "__main__":
    sys.exit(main())
