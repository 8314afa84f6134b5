"""The page's server: who gets in, what it answers, how fast, two labellers at once, and the whole command, killed and started again."""

import contextlib
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette", reason="the page needs the extra web")
pytest.importorskip("uvicorn", reason="the page needs the extra web")

from rewardtogo.cli.main import main
from rewardtogo.label import LabelledRun, start_labelling
from rewardtogo.label.server import serve
from rewardtogo.label.web import FILES, PAGE, listen, new_token

TOKEN = "only-for-tests"
LEARNER = {"network": {"sizes": [8]}, "learning_rate": 0.01}
LOOP = {"updates": 5, "batch_size": 16}
QUICK = ["--learner.network.sizes", "8", "--loop.updates", "5", "--loop.batch-size", "16"]


class Browser:
    """What a page does."""

    def __init__(self, port: int, who: str = "ann", token: str | None = TOKEN):
        self.port, self.who, self.token = port, who, token

    def raw(self, path: str, body: bytes | None = None) -> tuple[int, bytes, dict[str, str]]:
        headers = {"X-Token": self.token} if self.token else {}
        with contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)) as connection:
            connection.request("GET" if body is None else "POST", path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read(), {k.lower(): v for k, v in reply.getheaders()}

    def ask(self, path: str, **body: Any) -> tuple[int, Any]:
        status, data, _ = self.raw(path, json.dumps({"by": self.who, **body}).encode() if body else None)
        return status, json.loads(data)

    def view(self, at: int | None = None) -> dict[str, Any]:
        status, found = self.ask(f"/api/item?by={self.who}" + ("" if at is None else f"&at={at}"))
        assert status == 200, found
        return found

    def answer(self, view: dict[str, Any], **what: Any) -> dict[str, Any]:
        status, found = self.ask("/api/answer", round=view["round"], item=view["item"]["index"], **what)
        assert status == 200, found
        return found


class Served:
    """A run with its page, served by another thread."""

    def __init__(self, run: LabelledRun, pause: float = 0.0):
        self.run, self.error = run, None
        self.listening = listen("127.0.0.1", 0)
        self.port = self.listening.getsockname()[1]
        self.thread = threading.Thread(target=self._serve, args=(pause,), daemon=True)
        self.thread.start()

    def _serve(self, pause: float) -> None:
        try:
            serve(self.run, self.listening, TOKEN, pause=pause)
        except Exception as error:
            self.error = error

    def end(self) -> None:
        """All rounds done, the thread has come to its end."""
        self.thread.join(60)
        assert not self.thread.is_alive() and self.error is None, self.error


def finish_all(browser: Browser, seconds: float = 60.0) -> int:
    """Answer everything, round after round, as the page would; how many answers it took."""
    count, until = 0, time.monotonic() + seconds
    view = browser.view()
    while view["status"] != "done":
        assert time.monotonic() < until, view
        if view["item"] is None:
            time.sleep(0.05)
            view = browser.view()
        else:
            view, count = browser.answer(view, action=count % 2), count + 1
    return count


def begin(out: Path, **options: Any) -> LabelledRun:
    options = {"rounds": 1, "size": 12, "learner": LEARNER, "loop": LOOP, "quiet": True, **options}
    return start_labelling("CartPole-v1", out=out, **options)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A page that several tests look at and that nobody finishes before the end."""
    with begin(tmp_path_factory.mktemp("page") / "run", size=40) as run:
        served = Served(run, pause=0.0)
        yield served
        last = Browser(served.port, "zoe")
        last.answer(last.view(), action=1)
        last.ask("/api/finish", round=1)
        while last.view()["status"] != "done":
            time.sleep(0.05)
        served.end()


# --- who gets in -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/api/setup", "/api/item?by=ann", "/frame/1/0.png", "/nowhere"])
@pytest.mark.parametrize(("token", "words"), [(None, "has no token"), ("only-for-test", "is wrong"), ("ö", "is wrong")])
def test_a_missing_or_wrong_token(path, token, words, page):
    browser = Browser(page.port, token=None)
    if token is not None:
        path += ("&" if "?" in path else "?") + "token=" + token.replace("ö", "%C3%B6")
    status, body, _ = browser.raw(path)
    assert status == 403 and words in json.loads(body)["error"] and b"rtg label" in body
    status, body, _ = browser.raw("/api/answer", b'{"round":1,"item":0,"by":"ann","action":1}')
    assert status == 403 and page.run.round.queue.answers(0) == {}


def test_the_page_and_its_files(page):
    status, body, headers = Browser(page.port, token=None).raw(f"/?token={TOKEN}")
    assert status == 200 and b"<title>Label</title>" in body
    assert headers["referrer-policy"] == "no-referrer" and "default-src 'self'" in headers["content-security-policy"]
    for path in FILES:
        assert Browser(page.port, token=None).raw(path)[0] == 200
    # Nothing is loaded from elsewhere.
    for file in PAGE.iterdir():
        text = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "://" not in text and "@import" not in text, file


def test_it_listens_on_this_machine_alone(page):
    assert page.listening.getsockname()[0] == "127.0.0.1"
    # What asyncio looks at before it sends small answers at once (TCP_NODELAY); otherwise each takes 40 ms more.
    assert page.listening.proto == socket.IPPROTO_TCP


def test_two_servers_on_one_port(page):
    with pytest.raises(
        ValueError, match=rf"port {page.port} is taken by another server: stop that one, or give another"
    ):
        listen("127.0.0.1", page.port)
    for wrong in (-1, 65536):
        with pytest.raises(ValueError, match=f"a port is a number from 0 .* to 65535, not {wrong}"):
            listen("127.0.0.1", wrong)
    with pytest.raises(ValueError, match=r"there is no address nowhere\.invalid on this machine"):
        listen("nowhere.invalid", 0)


def test_tokens():
    assert len(new_token()) >= 20 and new_token() != new_token()
    for wrong in ("short", "with a space", "a/b/c/d/e/f", "ümläut-token"):
        with pytest.raises(ValueError, match="a token is at least 8 letters"):
            new_token(wrong)


# --- what it answers ---------------------------------------------------------------------------------------------------


def test_label_undo_go_back_skip(page):
    ann = Browser(page.port)
    first = ann.view()
    index = first["item"]["index"]
    assert first["item"]["policy"] is None and first["item"]["mine"] is None
    second = ann.answer(first, action=1)
    assert second["last"]["index"] == index and second["last"]["mine"] == 1 and second["last"]["policy"] in (0, 1)
    assert second["item"]["index"] == index + 1
    undone = ann.ask("/api/answer", round=1, undo=True)[1]
    assert undone["item"]["index"] == index and undone["item"]["mine"] is None
    again = ann.answer(undone, action=0)
    old = ann.view(at=index)
    assert old["item"]["mine"] == 0 and page.run.round.queue.answers(index)["ann"].action == 0
    ann.answer(old, action=1)  # changed
    third = ann.answer(again, skip=True)
    assert third["progress"]["passed"] == 1 and third["progress"]["answers"]["ann"] == 3
    assert third["item"]["index"] == index + 2
    assert ann.view(at=index + 1)["item"]["mine"] == "skip"


def test_several_at_once_get_different_items_and_see_disagreement(page):
    views = {who: Browser(page.port, who).view() for who in ("bob", "cy", "dan")}
    assert len({v["item"]["index"] for v in views.values()}) == 3
    bob, cy = Browser(page.port, "bob"), Browser(page.port, "cy")
    index = bob.view()["item"]["index"]
    bob.answer(bob.view(), action=1)
    seen = cy.view(at=index)
    assert seen["item"]["others"] == {}  # lest it be repeated
    found = cy.answer(seen, action=0)
    assert found["last"]["others"] == {"bob": 1} and found["progress"]["disputed"] == 1
    cy.ask("/api/answer", round=1, undo=True)
    assert cy.view()["progress"]["disputed"] == 0


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"round": 1, "item": 40, "action": 1}, 400, "there is no observation 40 in this batch: they are numbered from 0 to 39"),
        ({"round": 1, "item": -1, "action": 1}, 400, "there is no observation -1"),
        ({"round": 1, "item": "0", "action": 1}, 400, "there is no observation '0'"),
        ({"round": 1, "action": 1}, 400, "there is no observation None"),
        ({"round": 1, "item": 0, "action": 2}, 400, "an action here is a whole number from 0 to 1, not 2"),
        ({"round": 1, "item": 0, "action": "left"}, 400, "an action here is a whole number"),
        ({"round": 1, "item": 0}, 400, "an action here is a whole number from 0 to 1, not None"),
        ({"round": 1, "item": 0, "action": 1, "by": " "}, 400, "a labeller has a name"),
        ({"round": 1, "item": 0, "action": 1, "by": 5}, 400, "a labeller has a name"),
        ({"round": 1, "undo": True, "by": "nobody yet"}, 400, "there is nothing to take back"),
        ({"round": 2, "item": 0, "action": 1}, 409, "round 2 is not being labelled now: load the page anew"),
        ({"item": 0, "action": 1}, 409, "round None is not being labelled now"),
    ],
)  # fmt: skip
def test_bad_requests(request_, status, words, page):
    before = page.run.round.queue.progress()
    found, body = Browser(page.port).ask("/api/answer", **request_)
    assert (found, words in body["error"]) == (status, True), body
    assert page.run.round.queue.progress() == before


def test_what_is_no_request_at_all(page):
    browser = Browser(page.port)
    for body in (b"nonsense", b"[1]", b"\xff\xfe", b"{" + b" " * 70_000 + b"}"):
        assert browser.raw("/api/answer", body)[0] == 409
    assert browser.raw("/api/item?by=ann&at=99")[0] == 400 and browser.raw("/api/item?by=ann&at=x")[0] == 400
    assert browser.raw("/api/item?by=")[0] == 400
    assert browser.raw("/frame/1/99.png")[0] == 404 and browser.raw("/frame/7/0.png")[0] == 404
    assert browser.raw("/../label.py")[0] == 404 and browser.raw("/api/answer")[0] == 405
    assert browser.raw("/api/finish", b'{"round":3}')[0] == 409


def test_pictures(page):
    status, body, headers = Browser(page.port).raw("/frame/1/3.png")
    assert status == 200 and headers["content-type"] == "image/png" and body.startswith(b"\x89PNG")


# --- rounds ------------------------------------------------------------------------------------------------------------


def test_a_batch_that_is_done_feeds_the_next_round(tmp_path):
    with begin(tmp_path / "run", rounds=3) as run:
        served = Served(run, pause=0.3)
        ann = Browser(served.port)
        view, answered = ann.view(), 0
        while view["item"] is not None:
            view, answered = ann.answer(view, action=1), answered + 1
        assert answered == 12 and 0 < view["waits"] <= 0.3
        # Within the pause the last answer can be taken back, and then it does not begin.
        view = ann.ask("/api/answer", round=1, undo=True)[1]
        time.sleep(0.5)
        assert ann.view()["round"] == 1
        ann.answer(view, action=0)
        until = time.monotonic() + 60
        while (view := ann.view())["round"] != 2 or view["item"] is None:
            assert time.monotonic() < until
            time.sleep(0.05)
        assert view["results"][0]["labels"] == 12
        # A page that was not loaded anew cannot answer the old round.
        assert ann.ask("/api/answer", round=1, item=0, action=1)[0] == 409
        # And what is labelled can be learnt from at once.
        assert ann.ask("/api/finish", round=2)[0] == 400
        ann.answer(view, action=1)
        assert ann.ask("/api/finish", round=2)[0] == 200
        while (view := ann.view())["round"] != 3 or view["status"] != "labelling":
            assert time.monotonic() < until + 60
            time.sleep(0.05)
        assert finish_all(ann) == 12
        served.end()
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["env_steps"] == 36
    assert run.result().metrics["labels"].tolist() == [12, 13, 25]


def test_answers_in_less_than_50_ms_with_10_000_waiting(tmp_path):
    with begin(tmp_path / "run", size=10_000, num_envs=10) as run:
        served = Served(run, pause=0.0)
        ann, seconds = Browser(served.port), []
        view = ann.view()
        assert view["progress"]["size"] == 10_000
        for i in range(100):
            began = time.perf_counter()
            view = ann.answer(view, action=i % 2)
            seconds.append(time.perf_counter() - began)
        ann.ask("/api/finish", round=1)
        while ann.view()["status"] != "done":
            time.sleep(0.05)
        served.end()
    milliseconds = 1e3 * np.sort(seconds)
    print(f"median {milliseconds[50]:.1f} ms, 90th of 100 {milliseconds[89]:.1f} ms")
    assert milliseconds[89] < 50


# --- the command -------------------------------------------------------------------------------------------------------


def command(*arguments: object) -> subprocess.Popen:
    line = [sys.executable, "-m", "rewardtogo.cli.main", "label", *map(str, arguments), "--port", "0", "--token", TOKEN]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def port_of(process: subprocess.Popen) -> int:
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if found := re.search(rf"http://127\.0\.0\.1:(\d+)/\?token={TOKEN}", line):
            return int(found[1])
    raise AssertionError("".join(said))


def test_killed_started_again_interrupted_and_finished(tmp_path):
    run = tmp_path / "run"
    process = command("CartPole-v1", "--out", run, "--rounds", 2, "--size", 20, "--pause", 0, *QUICK)
    ann = Browser(port_of(process))
    view = ann.view()
    for _ in range(13):
        view = ann.answer(view, action=1)
    process.kill()
    process.communicate()
    process = command(run, "--pause", 0)
    ann = Browser(port_of(process))
    view = ann.view()
    assert view["progress"]["answers"] == {"ann": 13} and view["item"]["index"] == 13
    ann.answer(view, action=0)
    if os.name != "nt":
        process.send_signal(signal.SIGTERM)
        error = process.communicate(timeout=60)[1]
        assert process.returncode == 130 and f"every answer is kept: go on with `rtg label {run}`" in error
        process = command(run, "--pause", 0, "--json")
    ann = Browser(port_of(process))
    assert finish_all(ann) == 6 + 20
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    found = json.loads(output.splitlines()[-1])
    assert found["run"] == str(run) and found["env_steps"] == 40


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("CartPol-v1", "'CartPol-v1' CartPole-v1"),
        ("CartPole-v1 --rounds 0", "rounds at least 1 0"),
        ("CartPole-v1 --size -3", "observations -3"),
        ("CartPole-v1 --votes 0", "labellers 0"),
        ("CartPole-v1 --port 99999", "port 65535 99999"),
        ("CartPole-v1 --port x", "whole number 'x'"),
        ("CartPole-v1 --token short", "token 8 'short'"),
        ("CartPole-v1 --pause -1", "pause -1"),
        ("CartPole-v1 --actions up", "2 actions 1 up"),
        ("CartPole-v1 --learner.gama 3", "BC 'gama'"),
        ("CartPole-v1 --loop.beta 1", "loop.beta 0"),
        ("CartPole-v1 --sise 3", "'--sise' --size"),
        ("nowhere/run", "nowhere/run config.json"),
        ("--rounds 3", "RUN_OR_ENV"),
    ],
)
def test_requests_that_cannot_be_met(line, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # A port of nobody's, unless the request names one.
    arguments = ["label", *line.split(), *([] if "--port" in line else ["--port", "0"])]
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("rtg: ") and "\n" not in said and all(word in said for word in words.split())


def test_a_run_is_settled_when_it_begins(tmp_path, capsys):
    begin(tmp_path / "run").close()
    assert main(["label", str(tmp_path / "run"), "--size", "5", "--port", "0"]) == 2
    assert "is a run whose --size is settled already" in capsys.readouterr().err


def test_without_the_extra(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["label", "CartPole-v1"]) == 2
    assert "pip install 'rewardtogo[web]'" in capsys.readouterr().err
