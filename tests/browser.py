"""A real browser without a window, driven by chromedriver's HTTP interface."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest

FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync")  # fmt: skip
PATIENCE = 60.0  # seconds for the browser to start, and for a page to be ready
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # the name of a reference in the WebDriver protocol


class Browser:
    """One window."""

    def __init__(self, session: str) -> None:
        self._session = session

    def open(self, page: Path, **wanted: str) -> None:
        """A page of ours, opened as its address says, ready."""
        fragment = "&".join(f"{key}={value}" for key, value in wanted.items())
        _post(f"{self._session}/url", {"url": "about:blank"})  # a new fragment alone would not load it anew
        _post(f"{self._session}/url", {"url": f"{page.resolve().as_uri()}#{fragment}"})
        deadline = time.monotonic() + PATIENCE
        while self.run("return document.body.dataset.ready || ''") == "":
            assert time.monotonic() < deadline, "the page is not ready"
            time.sleep(0.05)

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script in the page returns."""
        return _post(f"{self._session}/execute/sync", {"script": script, "args": list(arguments)})

    def click(self, css: str) -> None:
        _post(f"{self._session}/element/{self._find(css)[ELEMENT]}/click", {})

    def point(self, css: str, x: float, y: float) -> None:
        """Move the pointer to a place in an element, in CSS pixels from its middle."""
        self.run("document.querySelector(arguments[0]).scrollIntoView({block: 'center'})", css)
        move = {"type": "pointerMove", "duration": 0, "origin": self._find(css), "x": round(x), "y": round(y)}
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": [move]}
        _post(f"{self._session}/actions", {"actions": [pointer]})

    def picture(self, path: Path, width: int, height: int) -> None:
        """A screenshot of a window of this size."""
        _post(f"{self._session}/window/rect", {"width": width, "height": height})
        time.sleep(0.3)
        with urlopen(f"{self._session}/screenshot") as answer:
            path.write_bytes(base64.b64decode(json.load(answer)["value"]))

    def _find(self, css: str) -> dict[str, str]:
        return _post(f"{self._session}/element", {"using": "css selector", "value": css})


def _post(url: str, content: dict[str, Any]) -> Any:
    request = Request(url, json.dumps(content).encode(), {"Content-Type": "application/json"})
    with urlopen(request, timeout=PATIENCE) as answer:
        return json.load(answer)["value"]


@contextmanager
def browser(folder: Path, width: int = 1280, height: int = 1400) -> Iterator[Browser]:
    """A Chromium whose profile is in `folder`. Skips the test where there is none."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs a browser: install chromium and chromedriver (Debian: chromium, chromium-driver)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen([driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        root = f"http://127.0.0.1:{port}"
        _wait(root)
        flags = [*FLAGS, f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}"]
        wanted = {"browserName": "chrome", "goog:chromeOptions": {"args": flags, "binary": chromium}}
        made = _post(f"{root}/session", {"capabilities": {"alwaysMatch": wanted}})
        session = f"{root}/session/{made['sessionId']}"
        try:
            yield Browser(session)
        finally:
            urlopen(Request(session, method="DELETE"), timeout=PATIENCE).close()
    finally:
        process.terminate()
        process.wait()


def _wait(root: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            with urlopen(f"{root}/status", timeout=1) as answer:
                if json.load(answer)["value"]["ready"]:
                    return
        except (URLError, OSError):
            assert time.monotonic() < deadline, "chromedriver does not start"
        time.sleep(0.1)
