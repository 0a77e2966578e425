"""A headless Chromium that opens pages from disk: selenium, with Debian's chromium and chromedriver."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",  # WebGL on the processor
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--disable-dev-shm-usage",
)
BINARIES = {name: shutil.which(name) for name in ("chromium", "chromedriver")}

needs_chromium = pytest.mark.skipif(
    not all(BINARIES.values()),
    reason="no chromium and chromedriver (Debian: apt-get install chromium chromium-driver)",
)


@contextmanager
def chromium(profile: Path, size: tuple[int, int] = (1200, 1000)) -> Iterator[webdriver.Chrome]:
    """A browser with a fresh profile that logs its console and its requests."""
    options = webdriver.ChromeOptions()
    options.binary_location = BINARIES["chromium"] or ""
    for flag in (*FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options, Service(BINARIES["chromedriver"]))
    try:
        yield browser
    finally:
        browser.quit()


def complaints(browser: webdriver.Chrome) -> list[str]:
    """Errors on the console since the last call. (Warnings there are the software renderer's, of its own speed.)"""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def requests(browser: webdriver.Chrome) -> list[str]:
    """Addresses that pages asked for since the last call, other than the present one and data within it; the browser's
    own (chrome:, its first tab) left out."""
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
    return [url for url in asked if url != browser.current_url and not url.startswith(("data:", "blob:", "chrome:"))]
