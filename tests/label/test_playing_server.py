"""The page to play on: who gets in, one player at a time, what is refused, and the whole command, killed and started again."""

import base64
import contextlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import gymnasium.spaces as spaces
import numpy as np
import pytest

pytest.importorskip("starlette", reason="the page needs the extra web")
pytest.importorskip("uvicorn", reason="the page needs the extra web")

import rewardtogo as rtg
from rewardtogo.cli.main import main
from rewardtogo.data import load_dataset
from rewardtogo.label import Playing, start_playing
from rewardtogo.label import stage as stage_module
from rewardtogo.label.stage import Stage, serve_playing
from rewardtogo.label.web import listen

TOKEN = "only-for-tests"


class Tab:
    """What a page does."""

    def __init__(self, port: int, who: str = "ann", token: str | None = TOKEN):
        self.port, self.who, self.token = port, who, token
        self.view: dict[str, Any] = {}

    def raw(self, path: str, body: bytes | None = None) -> tuple[int, bytes]:
        headers = {"X-Token": self.token} if self.token else {}
        with contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)) as connection:
            connection.request("GET" if body is None else "POST", path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read()

    def ask(self, path: str, body: dict[str, Any] | None = None) -> tuple[int, Any]:
        status, data = self.raw(path, None if body is None else json.dumps({"by": self.who, **body}).encode())
        found = json.loads(data)
        if status == 200 and "status" in found:
            self.view = found
        return status, found

    def look(self) -> dict[str, Any]:
        status, found = self.ask(f"/api/view?by={self.who}")
        assert status == 200, found
        return found

    def do(self, **what: Any) -> dict[str, Any]:
        status, found = self.ask("/api/act", {"attempt": self.view["attempt"], "step": self.view["step"], **what})
        assert status == 200, found
        return found

    def play(self) -> dict[str, Any]:
        """To the end of the episode."""
        while self.view["over"] is None:
            self.do(action=int(self.view["numbers"][2]["value"] > 0))
        return self.view


class Served:
    """What is played with its page, served by another thread."""

    def __init__(self, playing: Playing, pause: float = 0.0):
        self.playing, self.found, self.error = playing, None, None
        self.listening = listen("127.0.0.1", 0)
        self.port = self.listening.getsockname()[1]
        self.thread = threading.Thread(target=self._serve, args=(pause,), daemon=True)
        self.thread.start()

    def _serve(self, pause: float) -> None:
        try:
            self.found = serve_playing(self.playing, self.listening, TOKEN, pause=pause)
        except Exception as error:
            self.error = error

    def end(self) -> None:
        self.thread.join(60)
        assert not self.thread.is_alive()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A page that several tests play on and that nobody finishes before the end."""
    with start_playing("CartPole-v1", out=tmp_path_factory.mktemp("page") / "data", episodes=1000) as playing:
        served = Served(playing)
        yield served
        last = Tab(served.port, "zoe")
        last.ask("/api/seat", {})
        if last.look()["over"] is None:
            last.do(action=1)
            last.do(what="keep")
        assert last.do(what="finish")["status"] == "done"
        served.end()
        assert served.error is None and served.found is not None and served.found[1]["episodes"] == playing.kept


@pytest.fixture
def ann(page) -> Tab:
    tab = Tab(page.port)
    tab.ask("/api/seat", {})
    if tab.look()["over"] is not None:
        tab.do(what="begin")
    return tab


# --- who gets in -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/api/setup", "/api/view?by=ann", "/nowhere"])
@pytest.mark.parametrize(("token", "words"), [(None, "has no token"), ("only-for-test", "is wrong")])
def test_a_missing_or_wrong_token(path, token, words, page):
    before = page.playing.step
    if token is not None:
        path += ("&" if "?" in path else "?") + "token=" + token
    status, body = Tab(page.port, token=None).raw(path)
    assert status == 403 and words in json.loads(body)["error"] and b"rtg demonstrate" in body
    request = json.dumps({"by": "ann", "attempt": page.playing.attempt, "step": before, "action": 1}).encode()
    assert Tab(page.port, token=token).raw("/api/act", request)[0] == 403 and page.playing.step == before


def test_the_page(page):
    status, body = Tab(page.port, token=None).raw(f"/?token={TOKEN}")
    assert status == 200 and b"<title>Play</title>" in body
    assert page.listening.getsockname()[0] == "127.0.0.1"
    setup = Tab(page.port).ask("/api/setup")[1]
    assert setup["rate"] == 15.0 and setup["neutral"] == "last" and setup["action"]["names"] == ["left", "right"]


def test_one_player_at_a_time(page, ann, monkeypatch):
    bob = Tab(page.port, "bob")
    assert bob.look() == {"status": "taken"}
    attempt, step = ann.view["attempt"], ann.view["step"]
    status, said = bob.ask("/api/act", {"attempt": attempt, "step": step, "action": 1})
    assert status == 409 and "another tab plays now" in said["error"] and page.playing.step == step
    assert bob.ask("/api/seat", {})[1]["status"] == "playing" and ann.look() == {"status": "taken"}
    # A tab that says nothing any more has been closed.
    monkeypatch.setattr(stage_module, "SEAT", 0.05)
    time.sleep(0.1)
    assert ann.look()["status"] == "playing"
    assert Tab(page.port, "").ask("/api/seat", {})[0] == 400


# --- what it answers ---------------------------------------------------------------------------------------------------


def test_act_keep_and_throw_away(page, ann):
    kept = ann.view["kept"]
    ann.do(what="discard")
    view = ann.do(action=1)
    assert (view["step"], view["total"], view["over"]) == (1, 1.0, None)
    assert [n["name"] for n in view["numbers"]][:2] == ["position", "velocity"]
    assert view["numbers"][0]["value"] == pytest.approx(float(page.playing.observation[0]))
    cut = ann.do(what="keep")
    assert (cut["over"], cut["kept"]) == ("cut", kept + 1)
    assert cut["recent"][0] == {"episode": kept + 1, "steps": 1, "total": 1.0}
    assert load_dataset(page.playing.dataset.path).num_episodes == kept + 1
    begun = ann.do(what="begin")
    assert (begun["over"], begun["step"], begun["attempt"]) == (None, 0, cut["attempt"] + 1)
    ended = ann.play()
    assert ended["over"] == "terminated" and ended["kept"] == kept + 2
    assert ann.do(what="discard")["kept"] == kept + 1


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"action": 2}, 400, "an action here is a whole number from 0 to 1, not 2"),
        ({"action": "left"}, 400, "an action here is a whole number"),
        ({}, 400, "an action here is a whole number from 0 to 1, not None"),
        ({"what": "jump"}, 400, "keep, discard, begin, finish; not 'jump'"),
        ({"what": "begin"}, 400, "this episode is not over yet"),
        ({"step": -1, "action": 1}, 409, "that was meant for step -1 of attempt"),
        ({"attempt": 0, "action": 1}, 409, "of attempt 0, and now it is step 1 of attempt"),
        ({"attempt": None, "step": None, "action": 1}, 409, "that was meant for step None"),
        ({"by": 5, "action": 1}, 400, "a tab says who it is"),
    ],
)
def test_bad_requests(request_, status, words, page, ann):
    ann.do(what="discard")
    ann.do(action=1)
    here = {"attempt": ann.view["attempt"], "step": ann.view["step"]}
    found, body = ann.ask("/api/act", {**here, **request_})
    assert (found, words in body["error"]) == (status, True), body
    assert page.playing.step == 1 and ann.look()["step"] == 1


def test_an_episode_that_is_over(page, ann):
    ann.do(what="discard")
    first = dict(ann.view)
    ann.play()
    status, said = ann.ask("/api/act", {"attempt": ann.view["attempt"], "step": ann.view["step"], "action": 1})
    assert status == 400 and re.search(r"this episode is over after \d+ steps: begin the next one", said["error"])
    status, said = ann.ask("/api/act", {"attempt": first["attempt"], "step": first["step"], "action": 1})
    assert status == 409 and "meant for step 0" in said["error"]


def test_what_is_no_request_at_all(page, ann):
    for body in (b"nonsense", b"[1]", b"\xff\xfe", b"{" + b" " * 70_000 + b"}"):
        assert ann.raw("/api/act", body)[0] == 400
    assert ann.raw("/api/view")[0] == 400 and ann.raw("/api/act")[0] == 405


def test_the_picture_is_the_present_one(page, ann):
    pytest.importorskip("pygame", reason="pictures need the extra render")
    ann.do(what="discard")
    one, two = ann.view["picture"], [ann.do(action=1)["picture"] for _ in range(6)][-1]
    assert one != two and base64.b64decode(two.removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")


def test_how_long_a_step_takes(page, ann):
    """From action to next picture, over the network of this machine; in processor time, for other programs may be running."""
    seconds = []
    while len(seconds) < 100:
        if ann.view["over"] is not None:
            ann.do(what="begin")
        began = time.process_time()
        ann.do(action=len(seconds) % 2)
        seconds.append(time.process_time() - began)
    milliseconds = 1e3 * np.sort(seconds)
    print(f"median {milliseconds[50]:.1f} ms, 90th of 100 {milliseconds[89]:.1f} ms")
    assert milliseconds[50] < 66  # a step of the default rate


# --- the end -----------------------------------------------------------------------------------------------------------


def test_the_last_episode_can_be_thrown_away_still(tmp_path):
    with start_playing("CartPole-v1", out=tmp_path / "data", episodes=1) as playing:
        served = Served(playing, pause=0.6)
        ann = Tab(served.port)
        status, said = (ann.look(), ann.ask("/api/act", {"attempt": 1, "step": 0, "what": "finish"}))[1]
        assert status == 400 and "no episode is kept yet" in said["error"]
        assert 0 < ann.play()["waits"] <= 0.6
        assert ann.do(what="discard")["waits"] is None
        time.sleep(0.8)
        assert ann.look()["status"] == "playing"
        steps = ann.play()["step"]
        while ann.look()["status"] != "done":
            time.sleep(0.05)
        served.end()
    assert served.error is None and served.found == (
        tmp_path / "data",
        {"episodes": 1, "steps": steps, "return_mean": float(steps), "length_mean": float(steps)},
    )


class Faulty(gymnasium.Env):
    """Raises in its second step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)
    count = 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.count += 1
        if self.count == 2:
            raise ZeroDivisionError("the wheel came off")
        return np.ones(2, np.float32), 1.0, False, False, {}


def test_an_environment_that_raises_ends_it(tmp_path):
    with start_playing(Faulty, out=tmp_path / "data") as playing:
        served = Served(playing)
        ann = Tab(served.port)
        ann.look()
        ann.do(action=1)
        ann.do(what="keep")
        ann.do(what="begin")
        status, said = ann.ask("/api/act", {"attempt": 2, "step": 0, "action": 1})
        assert status == 500 and re.search(
            r"Faulty raised ZeroDivisionError in step .* the wheel came off", said["error"]
        )
        assert ann.look()["status"] == "failed"
        served.end()
    assert isinstance(served.error, rtg.EnvironmentFailure)
    assert load_dataset(tmp_path / "data").num_episodes == 1


class Unseen(Faulty):
    observation_space = spaces.Box(-1, 1, (100,), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(100, np.float32), {}


def test_what_shows_nothing_and_impossible_rates(tmp_path):
    with start_playing(Unseen, out=tmp_path / "a") as playing:
        with pytest.raises(ValueError, match=r"Unseen shows nothing that a person could play by: it draws no picture"):
            Stage(playing)
    with start_playing("CartPole-v1", out=tmp_path / "b") as playing:
        with pytest.raises(
            ValueError, match=r"the rate is 0 \(it waits for each action\) to 100 steps a second, not -1"
        ):
            Stage(playing, rate=-1)
        assert Stage(playing, rate=0).rate == 0 and Stage(playing, rate=40).rate == 40


# --- the command -------------------------------------------------------------------------------------------------------


def command(*arguments: object) -> subprocess.Popen:
    line = [sys.executable, "-m", "rewardtogo.cli.main", "demonstrate", *map(str, arguments)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [*line, "--port", "0", "--token", TOKEN], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )  # fmt: skip


def port_of(process: subprocess.Popen) -> int:
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if found := re.search(rf"http://127\.0\.0\.1:(\d+)/\?token={TOKEN}", line):
            return int(found[1])
    raise AssertionError("".join(said))


def test_killed_started_again_interrupted_and_finished(tmp_path):
    out = tmp_path / "data"
    line = ("CartPole-v1", "--out", out, "--episodes", 3, "--pause", 0)
    process = command(*line)
    ann = Tab(port_of(process))
    ann.look()
    ann.play()
    ann.do(what="begin")
    ann.do(action=1)
    process.kill()
    process.communicate()
    assert load_dataset(out).num_episodes == 1
    process = command(*line)
    ann = Tab(port_of(process))
    assert ann.look()["kept"] == 1 and ann.view["step"] == 0
    ann.play()
    if os.name != "nt":
        process.send_signal(signal.SIGTERM)
        error = process.communicate(timeout=60)[1]
        assert process.returncode == 130
        assert (
            f"the 2 episodes that were kept are in {out}: go on with `rtg demonstrate CartPole-v1 --out {out}`" in error
        )
        process = command(*line, "--json")
        ann = Tab(port_of(process))
        assert ann.look()["kept"] == 2
    else:
        ann.do(what="begin")
    ann.play()
    while ann.look()["status"] != "done":
        time.sleep(0.05)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 0
    data = load_dataset(out)
    if os.name != "nt":
        assert json.loads(output.splitlines()[-1]) == {
            "dataset": str(out), "episodes": 3, "steps": data.num_steps,
            "return_mean": pytest.approx(data.returns.mean()), "length_mean": pytest.approx(data.lengths.mean()),
        }  # fmt: skip


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("CartPol-v1", "'CartPol-v1' CartPole-v1"),
        ("CartPole-v1 --episodes 0", "one episode 0"),
        ("CartPole-v1 --rate 1000", "rate 0 100 1000"),
        ("CartPole-v1 --rate x", "number 'x'"),
        ("CartPole-v1 --port 99999", "port 65535 99999"),
        ("CartPole-v1 --token short", "token 8 'short'"),
        ("CartPole-v1 --pause -1", "pause -1"),
        ("CartPole-v1 --actions up", "2 actions 1 up"),
        ("CartPole-v1 --epsodes 3", "'--epsodes' --episodes"),
        ("CartPole-v1 --learner.gamma 1", "'--learner.gamma' --env.NAME"),
        ("FrozenLake-v1 --env.is_slipery 1", "FrozenLake-v1 is_slippery"),
        ("CartPole-v1 --out .", "not a dataset dataset.json"),
        ("--episodes 3", "ENV"),
    ],
)
def test_requests_that_cannot_be_met(line, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("something").write_text("")
    arguments = ["demonstrate", *line.split(), *([] if "--port" in line else ["--port", "0"])]
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("rtg: ") and "\n" not in said and all(word in said for word in words.split()), said
    assert [p.name for p in tmp_path.iterdir()] == ["something"]


def test_a_port_that_is_taken(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["demonstrate", "CartPole-v1", "--port", str(page.port)]) == 2
    assert f"port {page.port} is taken by another server" in capsys.readouterr().err


def test_without_the_extra(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["demonstrate", "CartPole-v1"]) == 2
    assert "pip install 'rewardtogo[web]'" in capsys.readouterr().err
