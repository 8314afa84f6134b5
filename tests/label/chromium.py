"""What the tests of both pages drive a browser with: a command that serves one, headless Chromium, and what stands on the page."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="the page needs the extra web")
playwright = pytest.importorskip(
    "playwright.sync_api", reason="the browser is driven by Playwright: pip install playwright"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MARKS = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine: install the package chromium"),
]


def served(command: str, *arguments: object, folder: Path | None = None) -> tuple[subprocess.Popen, str]:
    """The command, begun in a folder, and the address that it prints."""
    line = [sys.executable, "-m", "rewardtogo.cli.main", command, *map(str, arguments), "--port", "0"]
    process = subprocess.Popen(
        line, env=os.environ | {"JAX_PLATFORMS": "cpu"}, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )  # fmt: skip
    assert process.stderr is not None
    for text in process.stderr:
        if found := re.search(r"http://\S+", text):
            return process, found[0]
    raise AssertionError("it printed no address")


def text(page, place: str, wanted: str | re.Pattern, timeout: float = 20_000) -> None:
    """Wait until it stands there."""
    playwright.expect(page.locator(f"#{place}")).to_have_text(wanted, timeout=timeout)
