"""The page in headless Chromium: keyboard, mouse, a killed server, a second labeller, and a trained policy at the end."""

import os
import re
import subprocess
from pathlib import Path

from chromium import MARKS, served, text

import rewardtogo as rtg

pytestmark = MARKS
QUICK = ["--learner.network.sizes", "8", "--loop.updates", "5", "--loop.batch-size", "16", "--pause", "1"]


def start(*arguments: object) -> tuple[subprocess.Popen, str]:
    return served("label", *arguments)


def answered(page, count: int, size: int) -> None:
    text(page, "count", f"{count} of {size} answered")


def test_label_thirty_kill_restart_finish_train(browser, tmp_path):
    run, faults = tmp_path / "run", []
    process, address = start("CartPole-v1", "--out", run, "--size", 40, "--rounds", 1, *QUICK)
    page = browser.new_page(viewport={"width": 1180, "height": 820})
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on(
        "request",
        lambda request: faults.extend([request.url] * (not request.url.startswith(("http://127.0.0.1", "data:")))),
    )
    page.goto(address)
    answered(page, 0, 40)
    for i in range(15):  # by keyboard
        page.keyboard.press("ArrowRight" if i % 2 else "1")
        answered(page, i + 1, 40)
    for i in range(15, 30):  # by mouse
        page.get_by_role("button", name="left" if i % 2 else "right").click()
        answered(page, i + 1, 40)
    page.keyboard.press("u")
    answered(page, 29, 40)
    page.keyboard.press("s")
    text(page, "passed", "1 skipped")
    page.keyboard.press("b")
    text(page, "which", re.compile("Observation 30 "))
    page.get_by_role("button", name="left").click()
    text(page, "passed", "")
    answered(page, 30, 40)
    picture = page.locator("#picture")
    assert picture.is_visible() and page.evaluate("document.getElementById('picture').naturalWidth") >= 320
    assert len((run / "labels" / "00000001" / "answers.jsonl").read_text().splitlines()) == 33
    if folder := os.environ.get("RTG_SCREENSHOTS"):
        page.wait_for_timeout(800)
        page.screenshot(path=str(Path(folder) / "labelling.png"))
    process.kill()
    process.communicate()
    page.keyboard.press("1")
    text(page, "message", re.compile("The server does not answer"))

    process, address = start(run, *QUICK[-2:])
    page.goto(address)
    answered(page, 30, 40)
    assert page.locator("#which").text_content() == "Observation 31 of 40"
    for i in range(30, 40):
        page.keyboard.press("2")
        answered(page, i + 1, 40)
    text(page, "question", "All rounds are done.", timeout=60_000)
    assert process.wait(timeout=60) == 0 and faults == []
    process.communicate()
    assert rtg.load(run).spec.action.counts == (2,) and rtg.Run(run, None).metrics["labels"].tolist() == [40]


def test_sliders_and_a_second_labeller(browser, tmp_path):
    run = tmp_path / "run"
    process, address = start("Pendulum-v1", "--out", run, "--size", 6, "--rounds", 1, "--votes", 2, *QUICK)
    pages = []
    for name in ("ann", "bob"):
        page = browser.new_context(color_scheme="dark" if name == "bob" else "light").new_page()
        page.goto(address)
        answered(page, 0, 6)
        page.get_by_label("Your name").fill(name)
        page.get_by_label("Your name").blur()
        pages.append(page)
    ann, bob = pages
    ann.locator("#which").wait_for()
    slider = ann.get_by_role("slider")
    slider.focus()
    for _ in range(3):
        ann.keyboard.press("ArrowRight")
    ann.keyboard.press("Enter")
    text(ann, "said", re.compile("you said 0.06"))
    process.kill()
    process.communicate()
    bob.close()
