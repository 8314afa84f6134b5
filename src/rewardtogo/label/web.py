"""What both pages for people stand on: a small server on this machine, its address guarded by a token (the extra `web`).

The pages ask in JSON, and whatever goes wrong is one sentence with a status. Their files are served from this folder alone.
"""

import contextlib
import errno
import os
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

PAGE = Path(__file__).parent / "page"
FILES = {
    "/page.css": "text/css",
    "/shared.js": "text/javascript",
    "/label.js": "text/javascript",
    "/play.js": "text/javascript",
}
"""What is served to everybody: it says nothing of the run."""
LARGEST_BODY = 2**16
PAUSE = 5.0
"""Seconds after the last answer or episode in which it can still be taken back."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
FRESH = {**HEADERS, "Cache-Control": "no-store"}


class Guard:
    """Lets nobody in who does not know the token, in the address or in a header."""

    def __init__(self, app: ASGIApp, token: str, command: str):
        self.app, self.token, self.command = app, token, command

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
        ) + f": open the address that `{self.command}` printed last"
        await JSONResponse({"error": sentence}, 403, headers=HEADERS)(scope, receive, send)


def guarded(page: str, routes: list[Route], token: str, command: str) -> Guard:
    """A page, its files and what it asks, for a server such as uvicorn. `command`: what printed the address."""

    async def index(request: Request) -> Response:
        return FileResponse(PAGE / page, headers=FRESH)

    async def file(request: Request) -> Response:
        path = request.url.path
        return FileResponse(PAGE / path[1:], media_type=FILES[path], headers={**HEADERS, "Cache-Control": "no-cache"})

    files = [Route(path, file) for path in FILES]
    return Guard(Starlette(routes=[Route("/", index), *files, *routes]), token, command)


async def body_of(request: Request) -> dict[str, Any]:
    """The JSON object that was sent; an empty one for anything else, which is then refused for what it lacks."""
    if int(request.headers.get("content-length", LARGEST_BODY + 1)) > LARGEST_BODY:
        return {}
    try:
        data = await request.json()
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}


async def answered(
    call: Callable[[], Any], run: Callable[[Callable[[], Any]], Awaitable[Any]] = run_in_threadpool
) -> Response:
    """What a call gives as JSON; a wrong request as status 400, one of another time as 409, each with one sentence.

    `run`: where the call is made, by default in a thread of its own.
    """
    try:
        found = await run(call)
    except LookupError as error:
        return JSONResponse({"error": str(error.args[0])}, 409, headers=FRESH)
    except ValueError as error:
        return JSONResponse({"error": str(error)}, 400, headers=FRESH)
    except OSError as error:
        return JSONResponse({"error": str(error)}, 507, headers=FRESH)
    except RuntimeError as error:
        return JSONResponse({"error": str(error)}, 500, headers=FRESH)
    return JSONResponse(found if found is not None else {}, headers=FRESH)


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
        # Its protocol is named so that asyncio sends small answers at once: otherwise each waits 40 ms for an acknowledgement.
        found = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
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


@contextlib.contextmanager
def serving(
    app: ASGIApp, listening: socket.socket, address: Callable[[str], None], token: str
) -> Iterator[threading.Thread]:
    """Serve from a thread while the block runs. `address` is called with what is to be opened in a browser."""
    config = uvicorn.Config(app, log_level="error", access_log=False, lifespan="off", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    host, port = listening.getsockname()[:2]
    try:
        thread.start()
        address(f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={token}")
        yield thread
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
        listening.close()
