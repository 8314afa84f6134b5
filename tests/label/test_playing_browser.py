"""The page to play on in headless Chromium: CartPole by keyboard, one thrown away, a killed server, two tabs, and a clone at the end."""

import os
import re
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from chromium import MARKS, served, text

import rewardtogo as rtg
from rewardtogo.data import load_dataset

pytestmark = MARKS


@pytest.fixture
def start(tmp_path):
    """The command, begun in a folder of its own, and the address that it prints; ended with the test, whatever comes."""
    begun = []

    def begin(*arguments: object) -> tuple[subprocess.Popen, str]:
        process, address = served("demonstrate", *arguments, folder=tmp_path)
        begun.append(process)
        return process, address

    yield begin
    for process in begun:
        process.kill()
        process.communicate()


def number(page, place: str) -> float:
    return float(page.locator(f"#{place}").text_content())


def until(page, done, seconds: float = 20.0) -> None:
    """Wait for it."""
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        page.wait_for_timeout(20)


def balance(page, steps: int) -> None:
    """Hold the arrow towards which the pole falls, for some steps."""
    held = None
    while number(page, "step") < steps and page.locator("#question").text_content() in (
        "Playing…",
        "Ready.",
        "Paused.",
    ):
        values = page.eval_on_selector_all("#numbers td.value", "cells => cells.map((c) => Number(c.textContent))")
        key = "ArrowRight" if np.dot([0.1, 0.4, 3.0, 1.0], values) > 0 else "ArrowLeft"
        if key != held:
            if held:
                page.keyboard.up(held)
            page.keyboard.down(key)
            held = key
        page.wait_for_timeout(15)
    if held:
        page.keyboard.up(held)


def test_cartpole_by_keyboard_killed_finished_and_cloned(browser, start, tmp_path):
    out, faults = tmp_path / "demonstrations", []
    process, address = start("CartPole-v1", "--out", out.name, "--episodes", 3, "--pause", 1)
    page = browser.new_page(viewport={"width": 1180, "height": 840})
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on(
        "request",
        lambda request: faults.extend([request.url] * (not request.url.startswith(("http://127.0.0.1", "data:")))),
    )
    page.goto(address)
    text(page, "question", "Ready.")
    text(page, "count", "0 of 3")
    assert page.locator("#rate").input_value() == "15" and page.locator("#neutral").input_value() == "last"

    # Time stands until an action, runs while it is held, and stops when it is told to.
    page.wait_for_timeout(300)
    assert number(page, "step") == 0
    balance(page, 6)
    page.keyboard.press("Space")
    text(page, "question", "Paused.")
    page.wait_for_timeout(200)
    step = number(page, "step")
    assert step >= 6 and number(page, "total") == step
    page.wait_for_timeout(300)
    assert number(page, "step") == step
    # One that is thrown away leaves nothing behind.
    page.keyboard.press("x")
    text(page, "step", "0")
    text(page, "count", "0 of 3")

    # Faster, as the page allows; kept where it is cut.
    page.locator("#rate").select_option("50")
    balance(page, 60)
    page.keyboard.press("k")
    text(page, "question", "Episode 1 was cut here, and is kept.")
    first = load_dataset(out)
    assert first.num_episodes == 1 and first.num_steps >= 60 and bool(first.transitions.truncated[-1])
    picture = page.locator("#picture")
    assert picture.is_visible() and page.evaluate("document.getElementById('picture').naturalWidth") >= 320

    # A second tab waits, and can take over.
    other = browser.new_page()
    other.goto(address)
    text(other, "question", "This is being played in another tab.")
    other.get_by_role("button", name="Play here").click()
    text(other, "question", re.compile("Episode 1"))
    text(page, "question", "This is being played in another tab.")
    page.locator("#seat").click()
    text(page, "question", re.compile("Episode 1"))
    other.close()

    # An episode that ends by itself is kept, and thrown away still.
    page.keyboard.press("Enter")
    text(page, "question", "Ready.")
    page.keyboard.down("ArrowRight")
    text(page, "question", "Episode 2 has ended, and is kept.")
    page.keyboard.up("ArrowRight")
    assert load_dataset(out).num_episodes == 2
    page.keyboard.press("x")
    text(page, "count", "1 of 3")
    balance(page, 40)
    if folder := os.environ.get("RTG_SCREENSHOTS"):
        page.screenshot(path=str(Path(folder) / "playing.png"))

    process.kill()
    process.communicate()
    text(page, "message", re.compile("The server does not answer. Every episode that was kept is on the disk"))
    process, address = start("CartPole-v1", "--out", out.name, "--episodes", 3, "--pause", 1, "--rate", 25)
    page.goto(address)
    text(page, "count", "1 of 3")
    kept = 1
    for _ in range(10):  # what falls too early is thrown away, as a player would
        text(page, "question", "Ready.")
        balance(page, 60)
        if page.locator("#keep").is_disabled():
            page.keyboard.press("x")
            continue
        page.get_by_role("button", name="Keep it").click()
        kept += 1
        text(page, "count", f"{kept} of 3")
        if kept == 3:
            break
        page.get_by_role("button", name="Next episode").click()
    text(page, "question", "Done.")
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 0 and faults == []
    data = load_dataset(out)
    assert f"demonstrations   return {data.returns.mean():.2f} in 3 episodes" in output
    assert data.num_episodes == 3 and data.lengths.min() >= 60
    run = rtg.train("bc", "CartPole-v1", data=out, steps=500, out=tmp_path / "run", quiet=True)
    assert run.evaluation is not None and run.evaluation["return_mean"] > 150


def test_turn_by_turn_with_forbidden_actions(browser, start, tmp_path):
    process, address = start("TicTacToe", "--out", "games", "--episodes", 1, "--pause", 0)
    page = browser.new_page()
    page.goto(address)
    text(page, "question", "What do you do?")
    while page.locator("#question").text_content() == "What do you do?":
        open_ = page.locator("#actions .choice:enabled")
        step = number(page, "step")
        choice = int(open_.first.get_attribute("data-choice"))
        page.keyboard.press(str(choice + 1))
        until(page, lambda: number(page, "step") > step)  # noqa: B023
        if page.locator("#question").text_content() == "What do you do?":
            assert page.locator(f"#actions .choice[data-choice='{choice}']").is_disabled()
            page.keyboard.press(str(choice + 1))  # forbidden now
    text(page, "question", "Done.")
    assert process.wait(timeout=60) == 0
    process.communicate()
    assert load_dataset(tmp_path / "games").num_episodes == 1


def test_sliders_and_arrows_that_push(browser, start, tmp_path):
    process, address = start("Pendulum-v1", "--out", "swings", "--episodes", 1, "--rate", 20)
    page = browser.new_context(color_scheme="dark").new_page()
    page.goto(address)
    text(page, "question", "Ready.")
    page.keyboard.down("ArrowLeft")
    until(page, lambda: number(page, "step") >= 6)
    page.keyboard.up("ArrowLeft")
    page.wait_for_timeout(400)
    page.keyboard.press("Space")
    page.get_by_label("torque, exactly").fill("1.25")
    page.get_by_label("torque, exactly").blur()
    step = number(page, "step")
    page.keyboard.press("Space")
    until(page, lambda: number(page, "step") >= step + 4)
    page.keyboard.press("k")
    text(page, "question", "Episode 1 was cut here, and is kept.")
    page.get_by_role("button", name="Finish with what is kept").click()
    text(page, "question", "Done.")
    assert process.wait(timeout=60) == 0
    process.communicate()
    torques = np.asarray(load_dataset(tmp_path / "swings").transitions.action)[:, 0]
    changes = [t for i, t in enumerate(torques) if i == 0 or t != torques[i - 1]]
    assert changes == [-2.0, 0.0, 1.25] and np.sum(torques == -2.0) >= 6
