"""The page on which a person plays (`rtg demonstrate`).

An action is one round trip: the page sends it with the number of the step that it is meant for, and gets the next picture. Time is the
page's, so that an environment never runs ahead of what was seen; what is late, doubled or from another tab is refused. The environment
is touched by one thread alone, the one that called `serve_playing`: some can be drawn by no other than that which drew them first.
"""

import asyncio
import base64
import queue
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ..envs.gymnasium import EnvironmentFailure
from ..runner.train import Interrupted, StopSignal
from .actions import described, names_of
from .pictures import MOST_NUMBERS, Numbers
from .playing import Playing, playable_rate
from .web import PAUSE, Guard, answered, body_of, guarded, serving

SEAT = 5.0
"""Seconds of silence after which a tab that was closed keeps nobody else from playing."""
MOST_RATE = 100.0
RECENT = 8
"""Episodes that the page lists."""
NEUTRAL = ("none", "stay", "noop", "no-op", "nothing", "idle", "wait", "straight")
"""Names of actions that leave things as they are."""


class Stage:
    """What the page asks: what is seen, what the player does, and whether all is done.

    - `rate`: steps a second, 0 to wait for each action; by default what suits the environment (`playable_rate`).
    - `pause`: seconds after the last episode in which it can still be thrown away.

    Raises `ValueError` where the environment shows nothing, or these cannot be.
    """

    def __init__(
        self, playing: Playing, rate: float | None = None, pause: float = PAUSE, actions: tuple[str, ...] = ()
    ):
        if rate is not None and not 0 <= rate <= MOST_RATE:
            raise ValueError(f"the rate is 0 (it waits for each action) to {MOST_RATE:g} steps a second, not {rate:g}")
        self.playing, self.pause = playing, pause
        self.rate = playable_rate(playing) if rate is None else float(rate)
        self.status = "playing"
        self.seen_end = threading.Event()
        self.failure: EnvironmentFailure | None = None
        name = playing.described["id"]
        self._names = names_of(playing.described, playing.spec.action, actions)
        self._numbers = Numbers(playing.spec, name)
        self._see()
        if not self._numbers.columns and playing.picture() is None:
            raise ValueError(
                f"{name} shows nothing that a person could play by: it draws no picture (render_mode rgb_array), and its observation, "
                f"{playing.spec.observation.to_space()}, is more than {MOST_NUMBERS} numbers"
            )
        self._complete_since: float | None = None
        self._holder: tuple[str, float] | None = None
        self._calls: queue.Queue[tuple[Callable[[], Any], Future]] = queue.Queue()

    # --- what the page shows -----------------------------------------------------------------------------------------------------

    def setup(self) -> dict[str, Any]:
        """What does not change while the page is open."""
        return {
            "env": self.playing.described["id"],
            "dataset": str(self.playing.dataset.path),
            "episodes": self.playing.episodes,
            "rate": self.rate,
            "pause": self.pause,
            "neutral": self._neutral(),
            "action": described(self.playing.spec.action, self._names),
        }

    def _neutral(self) -> int | str:
        """What acts at first where no key is held: the action that is called so, else the last one again, else number 0."""
        known = [i for i, name in enumerate(self._names) if name.lower() in NEUTRAL]
        return known[0] if known else "last" if self._names else 0

    def view(self, who: Any) -> dict[str, Any]:
        """What is seen now, and where everything stands; to a second tab nothing but that somebody plays already."""
        if self.status != "playing":
            self.seen_end.set()
            return {"status": self.status, "message": str(self.failure or ""), **self._counts()}
        if not self._seated(who):
            return {"status": "taken"}
        playing = self.playing
        drawn, allowed = playing.picture(), playing.allowed
        return {
            "status": "playing",
            "attempt": playing.attempt,
            "step": playing.step,
            "total": playing.total,
            "over": playing.over,
            "waits": self._waits(),
            "allowed": None if allowed is None else allowed.tolist(),
            "numbers": self._numbers.of(playing.observation),
            "picture": None if drawn is None else f"data:image/png;base64,{base64.b64encode(drawn).decode()}",
            **self._counts(),
        }

    def _counts(self) -> dict[str, Any]:
        playing, lengths, returns = self.playing, self.playing.dataset.lengths, self.playing.dataset.returns
        numbers = range(playing.kept, max(0, playing.kept - RECENT), -1)
        return {
            "kept": playing.kept,
            "episodes": playing.episodes,
            "return_mean": playing.result()["return_mean"],
            "recent": [{"episode": n, "steps": lengths[n - 1], "total": returns[n - 1]} for n in numbers],
        }

    def _see(self) -> None:
        self._numbers.see(jax.tree.map(lambda x: np.asarray(x)[None], self.playing.observation))

    def _waits(self) -> float | None:
        """Seconds until the command ends, all episodes being kept; None where it does not."""
        since = self._complete_since
        return None if since is None else max(0.0, self.pause - (time.monotonic() - since))

    # --- what the player does ----------------------------------------------------------------------------------------------------

    def _seated(self, who: Any) -> bool:
        """Whether this tab plays; it does, where no other one does."""
        if not isinstance(who, str) or not 1 <= len(who) <= 64:
            raise ValueError(f"a tab says who it is by 1 to 64 characters, not {who!r}")
        now = time.monotonic()
        if self._holder is not None and self._holder[0] != who and now - self._holder[1] < SEAT:
            return False
        self._holder = (who, now)
        return True

    def take_over(self, who: Any) -> dict[str, Any]:
        """This tab plays from now on; another one that did is told so."""
        self._holder = None
        return self.view(who)

    def act(self, request: dict[str, Any]) -> dict[str, Any]:
        """Take an action, or what is to become of the episode (`what`: keep, discard, begin, finish), and give what is seen then.

        Raises `ValueError` for what cannot be, `LookupError` for what is meant for another step than the present one or comes from a tab
        that does not play.
        """
        who, playing = request.get("by"), self.playing
        if not self._seated(who):
            raise LookupError("another tab plays now: take over there, or close this page")
        if self.status != "playing" or (request.get("attempt"), request.get("step")) != (playing.attempt, playing.step):
            raise LookupError(
                f"that was meant for step {request.get('step')} of attempt {request.get('attempt')}, and now it is step {playing.step} "
                f"of attempt {playing.attempt}: the page shows it in a moment"
            )
        what = request.get("what", "act")
        if what == "act":
            playing.act(request.get("action"))
        elif what in ("keep", "discard", "begin"):
            {"keep": playing.keep, "discard": playing.discard, "begin": playing.begin}[what]()
        elif what == "finish":
            self._finish()
        else:
            raise ValueError(f"an episode can be acted in, or: keep, discard, begin, finish; not {what!r}")
        self._see()
        self._complete_since = (self._complete_since or time.monotonic()) if playing.complete else None
        return self.view(who)

    def _finish(self) -> None:
        if not self.playing.kept:
            raise ValueError("no episode is kept yet, so there is no dataset: keep one first, or stop the command")
        self.status = "done"

    # --- the thread that plays ---------------------------------------------------------------------------------------------------

    async def ask(self, call: Callable[[], Any]) -> Any:
        """Have the thread that plays make a call, and wait for what it gives."""
        future: Future = Future()
        self._calls.put((call, future))
        return await asyncio.wrap_future(future)

    def work(self, seconds: float) -> None:
        """Make the next call that was asked for, if one comes within so many seconds; and see whether all is done."""
        waits = self._waits()
        if self.status == "playing" and waits is not None and waits <= 0:
            self.status = "done"
        try:
            call, future = self._calls.get(timeout=seconds)
        except queue.Empty:
            return
        if not future.set_running_or_notify_cancel():
            return
        try:
            future.set_result(call())
        except Exception as error:
            if isinstance(error, EnvironmentFailure):
                self.failure, self.status = error, "failed"
            future.set_exception(error)


def application(stage: Stage, token: str) -> Guard:
    """The page and what it asks, for a server such as uvicorn."""

    async def setup(request: Request) -> Response:
        return await answered(stage.setup, stage.ask)

    async def view(request: Request) -> Response:
        return await answered(lambda: stage.view(request.query_params.get("by")), stage.ask)

    async def act(request: Request) -> Response:
        return await answered(lambda body=await body_of(request): stage.act(body), stage.ask)

    async def seat(request: Request) -> Response:
        return await answered(lambda body=await body_of(request): stage.take_over(body.get("by")), stage.ask)

    routes = [
        Route("/api/setup", setup),
        Route("/api/view", view),
        Route("/api/act", act, methods=["POST"]),
        Route("/api/seat", seat, methods=["POST"]),
    ]
    return guarded("play.html", routes, token, "rtg demonstrate")


def serve_playing(
    playing: Playing,
    listening: socket.socket,
    token: str,
    *,
    rate: float | None = None,
    pause: float = PAUSE,
    actions: tuple[str, ...] = (),
    say: Callable[[str], None] = lambda text: None,
) -> tuple[Path, dict[str, Any]]:
    """Serve the page until all episodes are kept, or the player has had enough. Returns the dataset's folder and `Playing.result`.

    Raises `Interrupted` after Ctrl-C or SIGTERM, `EnvironmentFailure` where the environment fails: every episode that was kept is on the
    disk, and `start_playing` goes on from there.
    """
    stage, path = Stage(playing, rate, pause, actions), playing.dataset.path
    with (
        StopSignal() as asked,
        serving(application(stage, token), listening, lambda address: say(f"play at {address}"), token) as thread,
    ):
        while stage.status == "playing" and not asked.raised and thread.is_alive():
            stage.work(0.02)
        if stage.status != "playing":  # the page is to say so before it has nobody to ask
            until = time.monotonic() + 3.0
            while not stage.seen_end.is_set() and time.monotonic() < until and not asked.raised:
                stage.work(0.02)
            time.sleep(0.3)  # and what tells it is still on its way
    if stage.failure is not None:
        raise stage.failure
    if asked.raised and stage.status == "playing":
        kept = f"the {playing.kept} episodes that were kept are in {path}" if playing.kept else "no episode was kept"
        raise Interrupted(f"stopped; {kept}: go on with `rtg demonstrate {playing.described['id']} --out {path}`")
    return path, playing.result()
