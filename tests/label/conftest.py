import pytest


@pytest.fixture
def browser():
    """Headless Chromium."""
    from chromium import CHROMIUM, playwright

    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()
