"""A real Chromium without a window, driven over its own pipe protocol: no package is needed for it.

`find_chromium` skips the test where there is no browser; it installs one only for root in CI.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PATIENCE_S = 60.0


def find_chromium() -> str:
    """Return the browser's command: `SCANWELD_BROWSER`, or the first that is installed; skip the test without one."""
    named = os.environ.get("SCANWELD_BROWSER")
    found = named or next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None and os.environ.get("CI") and hasattr(os, "geteuid") and os.geteuid() == 0:
        found = _install()
    if found is None:
        pytest.skip("no Chromium found: install one (Debian, Ubuntu: apt install chromium) or set SCANWELD_BROWSER")
    return found


def _install() -> str | None:
    if shutil.which("apt-get") is None:
        return None
    quiet = {"stdin": subprocess.DEVNULL, "capture_output": True, "check": False, "timeout": 600}
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update"], ["apt-get", "install", "-y", "--no-install-recommends", "chromium"]):
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(command, env=environment, **quiet)  # type: ignore[call-overload]
    return shutil.which("chromium")


class Page:
    """A tab: what it shows, what it logged, what it asked the network for."""

    def __init__(self, browser: Browser, session: str) -> None:
        self._browser, self._session = browser, session
        self.errors: list[str] = []
        self.requests: list[str] = []

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        return self._browser.call(method, parameters, self._session)

    def open(self, path: Path, *, faultless: bool = True) -> float:
        """Load a file and return the seconds until its scripts were ready; by default, nothing may fail meanwhile."""
        started = time.perf_counter()
        self.send("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.documentElement?.dataset.ready === 'yes'", faultless=faultless)
        return time.perf_counter() - started

    def wait(self, condition: str, *, faultless: bool = True) -> None:
        """Wait until a condition holds in the page."""
        end = time.perf_counter() + PATIENCE_S
        while not self.evaluate(condition):
            assert not (faultless and self.errors), self.errors
            assert time.perf_counter() < end, f"not reached: {condition}"
            time.sleep(0.02)

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        result = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise AssertionError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def look(self, width: int, height: int, *, dark: bool = False, phone: bool = False) -> None:
        """Set the size of the window and the theme."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if phone else 1, mobile=phone,
        )  # fmt: skip
        theme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[theme])
        self.send("Emulation.setTouchEmulationEnabled", enabled=phone)

    def settle(self) -> None:
        """Wait until what was changed is on the screen, with all of the points."""
        self.evaluate(
            "new Promise(done => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 350))"
        )

    def screenshot(self, *, selector: str = "", whole: bool = False) -> np.ndarray:
        """Return what is seen (H, W, 3) RGB: the window, an element, or the whole page."""
        options: dict[str, Any] = {}
        if selector:
            options["clip"] = {**self.box(selector), "scale": 1}
            options["captureBeyondViewport"] = False
        if whole:
            size = self.send("Page.getLayoutMetrics")["cssContentSize"]
            options["clip"] = {**size, "scale": 1}
            options["captureBeyondViewport"] = True
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png", **options)["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.ascontiguousarray(image[..., ::-1])

    def box(self, selector: str) -> dict[str, float]:
        """Return where an element is on the page: x, y, width, height [CSS pixels]."""
        code = f"(() => {{ const b = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); "
        code += "return {x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height}; })()"
        box: dict[str, float] = self.evaluate(code)
        return box

    def key(self, name: str, *, shift: bool = False) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=name, modifiers=8 if shift else 0)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press, move and release the mouse, in coordinates of the window."""
        for kind, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            more = {"button": "left", "buttons": buttons, "clickCount": 1}
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def touch(self, *moments: list[tuple[float, float]]) -> None:
        """Put fingers down at the first moment, move them through the others, and lift them."""
        for number, fingers in enumerate(moments):
            points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(fingers)]
            self.send("Input.dispatchTouchEvent", type="touchMove" if number else "touchStart", touchPoints=points)
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


class Browser:
    """A running Chromium."""

    def __init__(self, process: subprocess.Popen[bytes], write: int, read: int) -> None:
        self._process, self._write, self._read = process, write, read
        self._buffer = b""
        self._number = 0
        self._pages: dict[str, Page] = {}

    def page(self) -> Page:
        """Open an empty tab."""
        target = self.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        session = self.call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        page = self._pages[session] = Page(self, session)
        for domain in ("Page", "Runtime", "Network", "Log"):
            page.send(f"{domain}.enable")
        return page

    def call(self, method: str, parameters: dict[str, Any], session: str = "") -> dict[str, Any]:
        """Send one message and wait for its answer; take in events meanwhile."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result
            self._note(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], PATIENCE_S)
            chunk = os.read(self._read, 1 << 20) if ready else b""
            assert chunk, f"the browser says nothing; it ended with {self._process.poll()}"
            self._buffer += chunk
        message, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(message)
        return answer

    def _note(self, event: dict[str, Any]) -> None:
        page = self._pages.get(event.get("sessionId", ""))
        method, parameters = event.get("method"), event.get("params", {})
        if page is None:
            return
        if method == "Network.requestWillBeSent":
            page.requests.append(parameters["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            page.errors.append(str(parameters["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and parameters["type"] == "error":
            page.errors.append(str(parameters["args"]))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            page.errors.append(str(parameters["entry"]))


@contextlib.contextmanager
def chromium(profile: Path, *options: str) -> Iterator[Browser]:
    """Start a browser with its profile in an empty folder; WebGL is drawn by the processor."""
    command = [
        find_chromium(), "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run",
        "--remote-debugging-pipe", "--hide-scrollbars", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--disable-background-networking", "--disable-component-update", f"--user-data-dir={profile}", *options,
    ]  # fmt: skip
    to_browser, from_browser = os.pipe(), os.pipe()
    # The protocol is on file descriptors 3 and 4 of the browser; whatever is there now makes way.
    ends = (to_browser[0], from_browser[1])
    starter = "import fcntl, os, sys; "
    starter += f"a, b = (fcntl.fcntl(end, fcntl.F_DUPFD, 16) for end in {ends}); os.dup2(a, 3); os.dup2(b, 4); "
    starter += "os.execv(sys.argv[1], sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", starter, *command], pass_fds=ends, stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    for end in ends:
        os.close(end)
    browser = Browser(process, to_browser[1], from_browser[0])
    try:
        yield browser
    finally:
        with contextlib.suppress(AssertionError, OSError):
            browser.call("Browser.close", {})
        for end in (to_browser[1], from_browser[0]):
            os.close(end)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
