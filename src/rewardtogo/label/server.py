"""The page on which people label (`rtg label`).

The page asks in JSON and gets the next observation with the answer to each request, so that a label costs one round trip. Every
answer is on the disk before it is acknowledged. What learns is not the server's threads but the one that called `serve`.
"""

import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from ..runner.train import Interrupted, Run, StopSignal
from .actions import described, names_of
from .pictures import Numbers, Pictures
from .queue import Answer, LabelQueue, one_of
from .run import LabelledRun, Round
from .web import HEADERS, PAUSE, Guard, answered, body_of, guarded, serving

BEFORE = 8
"""Observations before the one to be labelled that the page shows in motion."""


class Desk:
    """What the page asks: the batch that waits, what labellers say, and whether the next round is due."""

    def __init__(self, run: LabelledRun, pause: float = PAUSE, actions: tuple[str, ...] = ()):
        self.run, self.pause, self.pictures = run, pause, Pictures(run)
        self.status = "labelling"
        self.seen_done = threading.Event()
        self._names = names_of(run.plan.config["env"], run.algorithm.spec.action, actions)
        self._asked = False
        self._done_since: float | None = None
        self._numbers: tuple[int, Numbers] | None = None
        self._results: list[dict[str, float]] = []

    # --- what the page shows -------------------------------------------------------------------------------------------------------

    def setup(self) -> dict[str, Any]:
        """What does not change while the page is open."""
        return {
            "env": self.run.plan.config["env"]["id"],
            "run": str(self.run.folder.path),
            "rounds": self.run.rounds,
            "votes": self.run.votes,
            "pause": self.pause,
            "action": described(self.run.algorithm.spec.action, self._names),
        }

    def view(self, who: Any, at: Any = None) -> dict[str, Any]:
        """The observation number `at`, or the next one that waits for this labeller, and where everything stands."""
        batch = self.run.round
        base = {"status": self.status, "rounds": self.run.rounds, "results": self._results, "item": None}
        if batch is None or self.status != "labelling":
            if self.status == "done":
                self.seen_done.set()
            return {**base, "round": self.run.finished, "progress": None}
        queue = batch.queue
        base |= {"round": batch.number, "progress": queue.progress(), "waits": self._waits(queue)}
        index = queue.next(who) if at is None else queue.index(at)
        return base if index is None else {**base, "item": self._item(batch, index, queue.labeller(who))}

    def _waits(self, queue: LabelQueue) -> float | None:
        """Seconds until the next round begins; None where it does not."""
        since = self._done_since
        return None if since is None or not queue.done else max(0.0, self.pause - (time.monotonic() - since))

    def _item(self, batch: Round, index: int, who: str) -> dict[str, Any]:
        queue, allowed = batch.queue, batch.queue.allowed(index)
        answers = queue.answers(index)
        if self._numbers is None or self._numbers[0] != batch.number:
            self._numbers = (batch.number, Numbers(self.run.algorithm.spec, self.run.plan.config["env"]["id"]))
            self._numbers[1].see(queue.observations)
        show = lambda i: self._numbers[1].of(one_of(queue.observations, i))  # type: ignore[index]  # noqa: E731
        before = batch.before(index, BEFORE)
        mine = answers.get(who)
        return {
            "index": index,
            "answered": mine is not None,
            "mine": _plain(mine),
            # What others and the policy say is shown afterwards, lest it be repeated.
            "others": {name: _plain(a) for name, a in answers.items() if name != who} if mine is not None else {},
            "policy": np.asarray(queue.own[index]).tolist() if mine is not None else None,
            "allowed": None if allowed is None else allowed.tolist(),
            "numbers": show(index),
            "trail": [[n["value"] for n in show(i)] for i in before],
            "before": before,
            "picture": self.pictures.png(batch, index) is not None,
        }

    def batch(self, number: Any) -> Round:
        """The round that is being labelled. Raises `LookupError` where the page shows another one."""
        batch = self.run.round
        if batch is None or self.status != "labelling" or batch.number != number:
            raise LookupError(f"round {number} is not being labelled now: load the page anew")
        return batch

    # --- what labellers do ----------------------------------------------------------------------------------------------------------

    def answer(self, who: Any, request: dict[str, Any]) -> dict[str, Any]:
        """Take an answer, a pass, or the last one back, and give what is to be looked at next."""
        queue = self.batch(request.get("round")).queue
        who = queue.labeller(who)
        if request.get("undo"):
            back = queue.undo(who)
            if back is None:
                raise ValueError("there is nothing to take back in this round")
            self._mark(queue)
            return self.view(who, back)
        if request.get("skip"):
            queue.skip(request.get("item"), who)
        else:
            queue.label(request.get("item"), request.get("action"), who)
        self._mark(queue)
        return {
            **self.view(who),
            "last": self._item(self.batch(request["round"]), request["item"], queue.labeller(who)),
        }

    def finish(self, number: Any) -> None:
        """Ask for the next round now, whatever has no answer yet left out. Raises `ValueError` where nothing has a label."""
        if not self.batch(number).queue.progress()["labelled"]:
            raise ValueError(
                "there is no label in this round yet, so there is nothing to learn from: answer at least one"
            )
        self._asked = True

    def _mark(self, queue: LabelQueue) -> None:
        self._done_since = (self._done_since or time.monotonic()) if queue.done else None

    def work(self) -> bool:
        """Learn from the batch if it is due; whether it was. Called by one thread alone."""
        batch = self.run.round
        if batch is None:
            self.status = "done"
            return False
        queue = batch.queue
        self._mark(queue)
        if not self._asked and (self._waits(queue) is None or self._waits(queue)):
            return False
        if queue.done and not queue.progress()["labelled"]:
            raise ValueError(
                f"every observation of round {batch.number} was passed, and nothing can be learnt from that: "
                "take some back (Undo) after starting again"
            )
        self._asked, self._done_since, self.status = False, None, "training"
        self._results = [*self._results, self.run.finish_round()]
        self.status = "labelling" if self.run.round is not None else "done"
        return True


def _plain(answer: Answer | None) -> Any:
    """`"skip"`, an action as numbers, or None where there is no answer."""
    if answer is None:
        return None
    return "skip" if answer.action is None else answer.action.tolist()


# --- the web --------------------------------------------------------------------------------------------------------------------------


def application(desk: Desk, token: str) -> Guard:
    """The page and what it asks, for a server such as uvicorn."""

    async def setup(request: Request) -> Response:
        return await answered(desk.setup)

    async def item(request: Request) -> Response:
        query = request.query_params
        return await answered(lambda: desk.view(query.get("by", ""), _whole(query["at"]) if "at" in query else None))

    async def answer(request: Request) -> Response:
        return await answered(lambda body=await body_of(request): desk.answer(body.get("by"), body))

    async def finish(request: Request) -> Response:
        return await answered(lambda body=await body_of(request): desk.finish(body.get("round")))

    async def frame(request: Request) -> Response:
        try:
            batch = desk.batch(request.path_params["round"])
            picture = await run_in_threadpool(desk.pictures.png, batch, request.path_params["index"])
        except (LookupError, ValueError) as error:
            return JSONResponse({"error": str(error)}, 404, headers=HEADERS)
        if picture is None:
            return JSONResponse({"error": "this environment has no pictures"}, 404, headers=HEADERS)
        return Response(picture, media_type="image/png", headers={**HEADERS, "Cache-Control": "private, max-age=86400"})

    routes = [
        Route("/api/setup", setup),
        Route("/api/item", item),
        Route("/api/answer", answer, methods=["POST"]),
        Route("/api/finish", finish, methods=["POST"]),
        Route("/frame/{round:int}/{index:int}.png", frame),
    ]
    return guarded("label.html", routes, token, "rtg label")


def _whole(text: str) -> Any:
    return int(text) if text.lstrip("-").isdigit() and len(text) < 20 else text


def serve(
    run: LabelledRun,
    listening: socket.socket,
    token: str,
    *,
    pause: float = PAUSE,
    actions: tuple[str, ...] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Run:
    """Serve the page until all rounds are done, learning whenever a batch is. Returns the run.

    Raises `Interrupted` after Ctrl-C or SIGTERM: every answer is on the disk, and `open_labelling` goes on from there.
    """
    desk = Desk(run, pause, actions)
    try:
        with (
            StopSignal() as asked,
            serving(application(desk, token), listening, lambda address: say(f"label at {address}"), token) as thread,
        ):
            while desk.status != "done" and not asked.raised and thread.is_alive():
                if not desk.work():
                    time.sleep(0.02)
            if desk.status == "done":  # the page is to say so before it has nobody to ask
                desk.seen_done.wait(timeout=3.0)
                time.sleep(0.3)  # and what tells it is still on its way
        if asked.raised:
            raise Interrupted(f"stopped; every answer is kept: go on with `rtg label {run.folder.path}`")
        return run.result()
    finally:
        desk.pictures.close()
