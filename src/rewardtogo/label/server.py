"""The page on which people label: a small server on this machine, its address guarded by a token (`rtg label`; the extra `web`).

The page asks in JSON and gets the next observation with the answer to each request, so that a label costs one round trip. Every
answer is on the disk before it is acknowledged. What learns is not the server's threads but the one that called `serve`.
"""

import errno
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from ..runner.train import Interrupted, Run, StopSignal
from .pictures import ACTIONS, Pictures, numbers
from .queue import Answer, LabelQueue
from .run import LabelledRun, Round

PAGE = Path(__file__).parent / "page"
FILES = {"/label.css": "text/css", "/label.js": "text/javascript"}
"""What is served to everybody: it says nothing of the run."""
BEFORE = 8
"""Observations before the one to be labelled that the page shows in motion."""
PAUSE = 5.0
"""Seconds after the last answer of a batch in which it can still be taken back, before the next round begins."""
LARGEST_BODY = 2**16
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Desk:
    """What the page asks: the batch that waits, what labellers say, and whether the next round is due."""

    def __init__(self, run: LabelledRun, pause: float = PAUSE, actions: tuple[str, ...] = ()):
        self.run, self.pause, self.pictures = run, pause, Pictures(run)
        self.status = "labelling"
        self.seen_done = threading.Event()
        self._actions = actions or ACTIONS.get(run.plan.config["env"]["id"], ())
        self._check_names()
        self._asked = False
        self._done_since: float | None = None
        self._numbers: tuple[int, Callable[[int], list[dict[str, Any]]]] | None = None
        self._results: list[dict[str, float]] = []

    def _check_names(self) -> None:
        spec = self.run.algorithm.spec.action
        wanted = spec.counts[0] if spec.kind == "discrete" else spec.size
        if self._actions and len(self._actions) != wanted:
            raise ValueError(
                f"there are {wanted} {'actions' if spec.kind == 'discrete' else 'entries of an action'} here, and "
                f"{len(self._actions)} names were given: {', '.join(self._actions)}"
            )

    # --- what the page shows -------------------------------------------------------------------------------------------------------

    def setup(self) -> dict[str, Any]:
        """What does not change while the page is open."""
        spec = self.run.algorithm.spec.action
        low, high = spec.bounds() if spec.kind == "box" else (np.zeros(spec.shape), np.zeros(spec.shape))
        number = lambda x: float(x) if np.isfinite(x) else None  # noqa: E731
        return {
            "env": self.run.plan.config["env"]["id"],
            "run": str(self.run.folder.path),
            "rounds": self.run.rounds,
            "votes": self.run.votes,
            "pause": self.pause,
            "action": {
                "kind": spec.kind,
                "shape": list(spec.shape),
                "counts": list(spec.counts or (2,) * spec.size),
                "low": [number(x) for x in np.ravel(low)],
                "high": [number(x) for x in np.ravel(high)],
                "names": list(self._actions),
            },
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
            env = self.run.plan.config["env"]["id"]
            self._numbers = (batch.number, numbers(self.run.algorithm.spec, env, queue.observations))
        show, before = self._numbers[1], batch.before(index, BEFORE)
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


class Guard:
    """Lets nobody in who does not know the token, in the address or in a header."""

    def __init__(self, app: ASGIApp, token: str):
        self.app, self.token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse with status 403, or pass on."""
        if scope["type"] != "http":
            return
        request = Request(scope, receive)
        given = request.headers.get("x-token") or request.query_params.get("token") or ""
        if request.url.path in FILES or secrets.compare_digest(given.encode(), self.token.encode()):
            await self.app(scope, receive, send)
            return
        sentence = (
            "the address has no token" if not given else "the token in the address is wrong"
        ) + ": open the address that `rtg label` printed last"
        await JSONResponse({"error": sentence}, 403, headers=HEADERS)(scope, receive, send)


def application(desk: Desk, token: str) -> Guard:
    """The page and what it asks, for a server such as uvicorn."""

    async def page(request: Request) -> Response:
        return FileResponse(PAGE / "index.html", headers={**HEADERS, "Cache-Control": "no-store"})

    async def file(request: Request) -> Response:
        path = request.url.path
        return FileResponse(PAGE / path[1:], media_type=FILES[path], headers={**HEADERS, "Cache-Control": "no-cache"})

    async def setup(request: Request) -> Response:
        return await _answered(desk.setup)

    async def item(request: Request) -> Response:
        query = request.query_params
        return await _answered(lambda: desk.view(query.get("by", ""), _whole(query["at"]) if "at" in query else None))

    async def answer(request: Request) -> Response:
        return await _answered(lambda body=await _body(request): desk.answer(body.get("by"), body))

    async def finish(request: Request) -> Response:
        return await _answered(lambda body=await _body(request): desk.finish(body.get("round")))

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
        Route("/", page),
        *(Route(path, file) for path in FILES),
        Route("/api/setup", setup),
        Route("/api/item", item),
        Route("/api/answer", answer, methods=["POST"]),
        Route("/api/finish", finish, methods=["POST"]),
        Route("/frame/{round:int}/{index:int}.png", frame),
    ]
    return Guard(Starlette(routes=routes), token)


def _whole(text: str) -> Any:
    return int(text) if text.lstrip("-").isdigit() and len(text) < 20 else text


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object that was sent; an empty one for anything else, which is then refused for what it lacks."""
    if int(request.headers.get("content-length", LARGEST_BODY + 1)) > LARGEST_BODY:
        return {}
    try:
        data = await request.json()
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}


async def _answered(call: Callable[[], Any]) -> Response:
    """What the desk says as JSON; a wrong request as status 400, one of another round as 409, each with one sentence."""
    headers = {**HEADERS, "Cache-Control": "no-store"}
    try:
        found = await run_in_threadpool(call)
    except LookupError as error:
        return JSONResponse({"error": str(error.args[0])}, 409, headers=headers)
    except ValueError as error:
        return JSONResponse({"error": str(error)}, 400, headers=headers)
    except OSError as error:
        return JSONResponse({"error": str(error)}, 507, headers=headers)
    return JSONResponse(found if found is not None else {}, headers=headers)


def new_token(given: str | None = None) -> str:
    """A token that nobody can guess, or the given one. Raises `ValueError` where that is short or would not fit in an address."""
    if given is None:
        return secrets.token_urlsafe(16)
    if len(given) < 8 or not all(c.isascii() and (c.isalnum() or c in "-_.~") for c in given):
        raise ValueError(f"a token is at least 8 letters, digits, or any of -_.~, not {given!r}")
    return given


def listen(host: str, port: int) -> socket.socket:
    """A socket on which nobody else listens. Raises `ValueError` where the port is taken or there is no such address."""
    if isinstance(port, bool) or not 0 <= port < 2**16:
        raise ValueError(f"a port is a number from 0 (any free one) to 65535, not {port}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        found = socket.socket(family, socket.SOCK_STREAM)
    except OSError as error:
        raise ValueError(f"there is no address {host} on this machine: leave --host out, or give 127.0.0.1") from error
    try:
        if os.name != "nt":  # there it would let two servers share a port
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(address)
        found.listen(128)
    except OSError as error:
        found.close()
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            why = "is taken by another server" if error.errno == errno.EADDRINUSE else "may not be used by you"
            raise ValueError(
                f"port {port} {why}: stop that one, or give another --port (0 takes any free one)"
            ) from error
        raise ValueError(f"{host}:{port} cannot be listened on: {error.strerror or error}") from error
    return found


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
    config = uvicorn.Config(
        application(desk, token), log_level="error", access_log=False, lifespan="off", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    host, port = listening.getsockname()[:2]
    try:
        with StopSignal() as asked:
            thread.start()
            say(f"label at http://{f'[{host}]' if ':' in host else host}:{port}/?token={token}")
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
        server.should_exit = True
        thread.join(timeout=5.0)
        listening.close()
        desk.pictures.close()
