"""The command `rtg`. Help and lists import no JAX; every wrong request ends with one sentence on stderr and status 2."""

import argparse
import atexit
import gc
import json
import math
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from ..catalogue import ALGORITHMS, ENVIRONMENTS, nearest

INTERRUPTED, WRONG = 130, 2
BACKENDS = ("auto", "jax", "gymnasium", "envpool")
MOST_EPISODES = 1_000_000
SOLVERS = (
    "value_iteration",
    "policy_iteration",
    "modified_policy_iteration",
    "gauss_seidel",
    "prioritised_sweeping",
    "backward_induction",
)


PLANNERS = (
    "random_shooting",
    "cem",
    "mppi",
    "gradient_shooting",
    "newton_shooting",
    "ilqr",
    "ddp",
    "collocation",
)


class RequestError(Exception):
    """A request that cannot be met, in one sentence."""


class Parser(argparse.ArgumentParser):
    """An `argparse` parser whose complaints are one sentence."""

    def error(self, message: str) -> NoReturn:
        raise RequestError(message)


def _number(text: str) -> float:
    try:
        return float(text.replace("_", ""))
    except ValueError:
        raise argparse.ArgumentTypeError(f"it must be a number, not {text!r}") from None


def _whole(text: str) -> int:
    try:
        return int(text.replace("_", ""))
    except ValueError:
        raise argparse.ArgumentTypeError(f"it must be a whole number, not {text!r}") from None


def _steps(text: str) -> int:
    steps = _number(text)
    if not math.isfinite(steps) or steps < 1 or steps != int(steps):
        raise argparse.ArgumentTypeError(f"the number of steps must be a whole number of at least 1, not {text}")
    return int(steps)


def _seed(text: str) -> int:
    if not 0 <= _whole(text) < 2**32:
        raise argparse.ArgumentTypeError(f"a seed is a whole number from 0 to 2^32 - 1, not {text}")
    return _whole(text)


def _episodes(text: str) -> int:
    if not 1 <= _whole(text) <= MOST_EPISODES:
        raise argparse.ArgumentTypeError(
            f"there must be at least one episode and at most {MOST_EPISODES:,}, not {text}"
        )
    return _whole(text)


def _parsers() -> tuple[Parser, dict[str, Parser]]:
    main = Parser(
        prog="rtg",
        description="Deep reinforcement learning, compiled: train, resume, evaluate, watch, compare, export.",
    )
    main.add_argument("--version", action="store_true", help="print the version and leave")
    commands = main.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    table: dict[str, Parser] = {}

    def command(name: str, summary: str, **keywords: Any) -> Parser:
        table[name] = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False, **keywords)
        return table[name]

    def run_argument(parser: Parser) -> None:
        parser.add_argument("run", metavar="RUN", help="a run folder")

    def page(parser: Parser, pause: str) -> None:
        parser.add_argument("--actions", metavar="NAME,NAME,...", help="what the page calls the actions")
        parser.add_argument(
            "--host", default="127.0.0.1", metavar="ADDRESS", help="default 127.0.0.1: this machine alone"
        )
        parser.add_argument("--port", type=_whole, default=8765, metavar="P", help="default 8765; 0 takes any free one")
        parser.add_argument(
            "--token", metavar="TOKEN", help="what the address must have (default: a new one each time)"
        )
        parser.add_argument("--pause", type=_number, default=5.0, metavar="SECONDS", help=pause)
        parser.add_argument("--quiet", action="store_true", help="print nothing but the address")
        parser.add_argument("--json", action="store_true")

    def limits(parser: Parser) -> None:
        parser.add_argument("--steps", type=_steps, help="environment steps (gradient steps offline)")
        parser.add_argument(
            "--stop-at-return", type=_number, metavar="R", help="stop when an evaluation reaches this return"
        )
        parser.add_argument(
            "--time-limit", type=_number, metavar="SECONDS", help="stop after so many seconds of training"
        )
        parser.add_argument("--checkpoint-every", type=_number, default=60.0, metavar="SECONDS", help="default 60")
        parser.add_argument("--tensorboard", action="store_true", help="also write TensorBoard events")
        parser.add_argument("--wandb", action="store_true", help="also log to Weights & Biases")
        parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
        parser.add_argument("--json", action="store_true", help="one JSON object as the last line of stdout")

    p = command(
        "train",
        "train an algorithm in an environment",
        epilog="`rtg train ALGORITHM ENV --help` shows the algorithm's own options",
    )
    p.add_argument("algorithm", metavar="ALGORITHM", help="a name from `rtg list`, or module:Class")
    p.add_argument(
        "env", metavar="ENV", nargs="?", help="a Gymnasium id (module:Id included) or one of `rtg list --envs`"
    )
    p.add_argument("--seed", type=_seed, default=0)
    p.add_argument(
        "--num-seeds", type=_whole, default=1, metavar="K", help="train K seeds in one program, one folder each"
    )
    p.add_argument("--num-envs", type=_whole, metavar="B", help="environments side by side")
    p.add_argument(
        "--threads",
        type=_whole,
        metavar="N",
        help="threads of the CPU to compute with (default: one, or all for planning, pictures and many seeds)",
    )
    p.add_argument("--out", metavar="DIR", help="run folder (default runs/ALGORITHM-ENV-SEED-NUMBER)")
    p.add_argument(
        "--backend",
        choices=BACKENDS,
        metavar="BACKEND",
        default="auto",
        help="auto, jax (compiled twin), gymnasium or envpool",
    )
    p.add_argument(
        "--preset",
        default="auto",
        metavar="NAME|none",
        help="hyperparameters known to work (default: those of the pair)",
    )
    p.add_argument(
        "--config",
        metavar="FILE",
        help="a JSON file with learner, loop, env and other options, such as a run's config.json",
    )
    p.add_argument("--data", metavar="DATASET", help="a dataset to learn from, made by `rtg collect`")
    p.add_argument(
        "--expert",
        metavar="RUN|MODULE:FUNCTION",
        help="whom dagger and dart ask: a run, or a function of an observation",
    )
    p.add_argument(
        "--profile",
        action="store_true",
        help="afterwards, say what share of the time collection, learning and evaluation take",
    )
    limits(p)
    p = command("resume", "continue a run from its last checkpoint")
    run_argument(p)
    p.add_argument(
        "--learner-class", metavar="MODULE:CLASS", help="the learner of a run that is not part of the library"
    )
    p.add_argument("--expert", metavar="RUN|MODULE:FUNCTION", help="the expert of the run, where it is code")
    limits(p)
    p = command("eval", "play whole episodes and print the mean return with its confidence interval")
    run_argument(p)
    p.add_argument("--episodes", type=_episodes, default=100, metavar="N")
    p.add_argument("--env", metavar="ENV", help="another environment than the one trained in")
    p.add_argument(
        "--backend",
        choices=BACKENDS,
        metavar="BACKEND",
        default=None,
        help="auto, jax, gymnasium or envpool (default: the run's)",
    )
    p.add_argument("--checkpoint", default="last", metavar="best|last|N")
    p.add_argument("--stochastic", action="store_true", help="sample actions")
    p.add_argument("--values", action="store_true", help="compare estimated values with true ones")
    p.add_argument("--seed", type=_seed, default=0)
    p.add_argument("--learner-class", metavar="MODULE:CLASS")
    p.add_argument("--json", action="store_true")
    p = command("play", "render an episode to a GIF or an MP4")
    run_argument(p)
    p.add_argument("--out", metavar="FILE.gif|FILE.mp4", help="default RUN/episode.gif")
    p.add_argument("--seed", type=_seed, default=0)
    p.add_argument("--checkpoint", default="last", metavar="best|last")
    p.add_argument("--stochastic", action="store_true")
    p = command("plot", "draw learning curves, several seeds as a mean with a band")
    p.add_argument("runs", nargs="+", metavar="RUN")
    p.add_argument("--out", metavar="FILE.png|.svg", help="default curves.png")
    p = command("compare", "compare runs by algorithm and environment: interquartile means, bootstrap intervals")
    p.add_argument("runs", nargs="+", metavar="RUN")
    p.add_argument("--json", action="store_true")
    p = command("list", "every algorithm: chapter, number in the notes, spaces it can use")
    p.add_argument("--envs", action="store_true", help="the compiled environments instead")
    p.add_argument("--json", action="store_true")
    p = command("check-env", "say what is wrong with an environment, and the mend")
    p.add_argument("env", metavar="ENV")
    p.add_argument("--json", action="store_true")
    p = command("collect", "play demonstrations with a trained policy into a dataset")
    run_argument(p)
    p.add_argument("--episodes", type=_episodes, default=10, metavar="N")
    p.add_argument("--out", metavar="DATASET")
    p.add_argument("--stochastic", action="store_true", help="sample actions")
    p.add_argument("--seed", type=_seed, default=0)
    p.add_argument("--json", action="store_true")
    p = command("export", "write the policy for use without this library")
    run_argument(p)
    p.add_argument("--format", default="stablehlo", help="stablehlo or onnx")
    p.add_argument("--out", metavar="FILE", help="default RUN/policy.FORMAT")
    p.add_argument("--checkpoint", default="last", metavar="best|last")
    p = command("solve", "solve an environment with a known table of transitions by dynamic programming")
    p.add_argument(
        "env",
        metavar="ENV",
        help="such as FrozenLake-v1, CliffWalking-v1 or Taxi-v4; --env.KEY V are its arguments",
    )
    p.add_argument("--method", default="value_iteration", metavar="METHOD", help="; ".join(SOLVERS))
    p.add_argument("--gamma", type=_number, default=1.0, metavar="G", help="discount (default 1: the plain return)")
    p.add_argument(
        "--tolerance",
        type=_number,
        default=1e-10,
        metavar="E",
        help="how far from optimal is good enough (default 1e-10)",
    )
    p.add_argument(
        "--horizon",
        type=_whole,
        metavar="T",
        help="actions in an episode, for backward_induction (default: the time limit)",
    )
    p.add_argument("--out", metavar="FILE.png|.svg", help="also draw the values and the policy")
    p.add_argument("--json", action="store_true")
    p = command(
        "plan",
        "play an environment by planning in its own dynamics, replanning as it goes",
        epilog="`rtg plan PLANNER --help` shows the planner's own options",
    )
    p.add_argument("planner", metavar="PLANNER", help="; ".join(PLANNERS))
    p.add_argument("env", metavar="ENV", nargs="?", help="a compiled environment, such as Pendulum-v1 or CartPole-v1")
    p.add_argument("--horizon", type=_whole, default=25, metavar="H", help="actions in a plan (default 25)")
    p.add_argument("--every", type=_whole, default=1, metavar="N", help="actions done before the next plan (default 1)")
    p.add_argument("--episodes", type=_episodes, default=10)
    p.add_argument("--gamma", type=_number, default=1.0, metavar="G", help="discount of a plan's rewards (default 1)")
    p.add_argument("--seed", type=_seed, default=0)
    p.add_argument("--out", metavar="FILE.gif|.mp4", help="also draw an episode")
    p.add_argument("--json", action="store_true")
    p = command(
        "label",
        "label observations on a page in the browser, in rounds of DAgger",
        epilog="--learner.NAME, --loop.NAME and --env.NAME are those of `rtg train dagger ENV`",
    )
    p.add_argument("run", metavar="RUN_OR_ENV", help="a run to go on with, or an environment to begin one in")
    p.add_argument("--rounds", type=_whole, metavar="N", help="rounds in all (default 5)")
    p.add_argument("--size", type=_whole, metavar="N", help="observations in a round (default 100)")
    p.add_argument("--votes", type=_whole, metavar="N", help="labellers who answer each observation (default 1)")
    p.add_argument("--num-envs", type=_whole, metavar="B", help="environments side by side (default 1)")
    p.add_argument("--seed", type=_seed, default=None)
    p.add_argument("--out", metavar="DIR", help="run folder (default runs/dagger-ENV-SEED-NUMBER)")
    p.add_argument("--backend", choices=BACKENDS, metavar="BACKEND", help="auto, jax, gymnasium or envpool")
    p.add_argument("--data", metavar="DATASET", help="demonstrations that the first policy learns from")
    page(p, "for a last Undo before it learns (default 5)")
    p = command(
        "demonstrate",
        "play an environment on a page in the browser: the episodes that are kept become a dataset",
        epilog="--env.NAME are the environment's arguments, as in `rtg train`",
    )
    p.add_argument("env", metavar="ENV", help="a Gymnasium id (module:Id included) or one of `rtg list --envs`")
    p.add_argument(
        "--episodes",
        type=_episodes,
        metavar="N",
        help="how many the dataset is to have, those included that it has already (default 10)",
    )
    p.add_argument("--out", metavar="DATASET", help="a new folder, or one to go on with (default datasets/ENV-NUMBER)")
    p.add_argument("--seed", type=_seed, default=None, help="of the environment (default 0)")
    p.add_argument(
        "--rate",
        type=_number,
        metavar="STEPS_PER_SECOND",
        help="0 waits for each action (default: what suits the environment)",
    )
    p.add_argument("--backend", choices=BACKENDS, metavar="BACKEND", help="auto, jax, gymnasium or envpool")
    page(p, "in which the last episode can be thrown away still (default 5)")
    p = command("figure", "redraw a figure or experiment of the notes")
    p.add_argument("id", metavar="ID", nargs="?", help="such as 1.1; without it, the list")
    p.add_argument("--out", metavar="FILE", help="default figure-ID.png")
    p.add_argument("--seed", type=_seed, default=0)
    return main, table


NESTED = {"demonstrate": ("env",), "label": ("learner", "loop", "env"), "solve": ("env",)}
"""Commands besides `train` that take options by group, and the groups."""


def value_of(text: Any) -> Any:
    """What an option's text stands for: JSON where it is some, else itself."""
    if not isinstance(text, str):
        return text
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _nested(pairs: Sequence[str], groups: tuple[str, ...], command: str = "train") -> dict[str, dict[str, Any]]:
    """`--learner.network.sizes 64 64 --env.x 1` as nested dictionaries by group."""
    found: dict[str, dict[str, Any]] = {group: {} for group in groups}
    i = 0
    while i < len(pairs):
        word = pairs[i]
        path, equals, value = word[2:].partition("=")
        steps = path.replace("-", "_").split(".")
        if not word.startswith("--"):
            raise RequestError(f"what is {word!r} for? Options are written --name value; see --help")
        if steps[0] not in groups or len(steps) < 2:
            known = [a for action in _parsers()[1][command]._actions for a in action.option_strings]
            hint = (
                "Options of the algorithm are --learner.NAME"
                if "learner" in groups
                else "The environment's are --env.NAME"
            )
            raise RequestError(
                f"there is no option {word.partition('=')[0]!r}: "
                f"{nearest(word, [*known, *(f'--{group}.NAME' for group in groups)])} {hint}"
            )
        i += 1
        values = [value] if equals else []
        while not equals and i < len(pairs) and not (pairs[i].startswith("--") and len(pairs[i]) > 2):
            values.append(pairs[i])
            i += 1
        if not values:
            raise RequestError(f"the option {word} needs a value")
        place = found[steps[0]]
        for step in steps[1:-1]:
            old = place.get(step)
            place[step] = old if isinstance(old, dict) else {} if old is None else {"class": old}
            place = place[step]
        old = place.get(steps[-1])
        place[steps[-1]] = {**old, "class": " ".join(values)} if isinstance(old, dict) else " ".join(values)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    # module:Class is looked for where the user stands, too; last, so that no file there hides a library's.
    sys.path.append(os.getcwd())
    # Imports and tracing make a million objects that stay: looking through them for garbage again and again was a tenth of a short run.
    gc.set_threshold(100_000, 50, 1000)
    # Nor is there anything to gain from a last look at them, which takes half a second.
    atexit.register(gc.freeze)
    parser, table = _parsers()
    try:
        return _dispatch(parser, table, arguments)
    except RequestError as error:
        return _say(str(error), WRONG)
    except KeyboardInterrupt as error:
        return _say(str(error) or "interrupted", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has gone; nothing more can be said to them.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _say(sentence: str, status: int) -> int:
    print(f"rtg: {' '.join(sentence.split())}", file=sys.stderr)
    return status


def _dispatch(parser: Parser, table: dict[str, Parser], arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        parser.print_help()
        return 0
    if arguments[0] == "--version":
        from .. import __version__

        print(__version__)
        return 0
    if arguments[0] not in table:
        raise RequestError(f"there is no command {arguments[0]!r}: {nearest(arguments[0], table)}")
    groups: dict[str, dict[str, Any]] = {}
    if arguments[0] == "train":
        if any(a in ("-h", "--help") for a in arguments):
            table["train"].print_help()
            names = [a for a in arguments[1:] if not a.startswith("-")]
            if names and (names[0] in ALGORITHMS or ":" in names[0]):
                from .commands import show_options

                try:
                    show_options(names[0])
                except ValueError as error:
                    raise RequestError(str(error)) from error
            return 0
        options, rest = table["train"].parse_known_args(arguments[1:])
        groups = _nested(rest, ("learner", "loop", "env"))
    elif arguments[0] in NESTED and not any(a in ("-h", "--help") for a in arguments):
        options, rest = table[arguments[0]].parse_known_args(arguments[1:])
        groups = _nested(rest, NESTED[arguments[0]], arguments[0])
    elif arguments[0] == "plan":
        if any(a in ("-h", "--help") for a in arguments):
            table["plan"].print_help()
            if len(arguments) > 1 and arguments[1] in PLANNERS:
                from .commands import show_planner

                show_planner(arguments[1])
            return 0
        options, rest = table["plan"].parse_known_args(arguments[1:])
        groups = _nested(rest, ("planner",), "plan")
    else:
        options = _known(table[arguments[0]], arguments[1:])
    options.arguments = arguments
    if arguments[0] == "list":
        return _list(options)
    from .commands import perform

    return perform(arguments[0], options, groups)


def _known(parser: Parser, arguments: list[str]) -> argparse.Namespace:
    options, rest = parser.parse_known_args(arguments)
    if rest:
        known = [a for action in parser._actions for a in action.option_strings]
        raise RequestError(
            f"there is no option {rest[0]!r} here: {nearest(rest[0], known)}"
            if rest[0].startswith("-")
            else f"what is {rest[0]!r} for? See {parser.prog} --help"
        )
    return options


def _list(options: argparse.Namespace) -> int:
    if options.envs:
        if options.json:
            print(json.dumps(ENVIRONMENTS))
            return 0
        width = max(map(len, ENVIRONMENTS))
        for name, text in ENVIRONMENTS.items():
            print(f"{name:<{width}}  {text}")
        print("\nBesides these, every Gymnasium id, module:Id included (gymnasium.pprint_registry() lists them).")
        return 0
    if options.json:
        print(
            json.dumps(
                {
                    row.name: {
                        "chapter": row.chapter,
                        "number": row.number,
                        "loop": row.loop,
                        "actions": row.actions,
                        "summary": row.summary,
                    }
                    for row in ALGORITHMS.values()
                }
            )
        )
        return 0
    print(f"{'name':<14}{'chapter':<9}{'number':<10}{'actions':<30}summary")
    for row in ALGORITHMS.values():
        print(
            f"{row.name:<14}{row.chapter:<9}{row.number:<10}{'any' if len(row.actions) == 4 else ', '.join(row.actions):<30}{row.summary}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
