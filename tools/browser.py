"""A headless Chromium, controlled by chromedriver over HTTP."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
SCREEN = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
_ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # key of elements in the WebDriver protocol


class Browser:
    """A session of chromedriver, with the parts of https://www.w3.org/TR/webdriver that are needed.

    It is a context manager, and writes its files to a folder. FileNotFoundError is raised if there is no
    Chromium here, RuntimeError if it does not answer as expected.
    """

    def __init__(self, folder: Path) -> None:
        chromium = next(filter(None, map(shutil.which, _BROWSERS)), None)
        driver = shutil.which("chromedriver")
        if chromium is None or driver is None:
            raise FileNotFoundError(
                "no chromium and chromedriver here: apt-get install chromium chromium-driver"
            )
        self._session = ""
        log = folder / "driver.log"
        with log.open("w") as file:
            self._driver = subprocess.Popen(
                [driver, "--port=0"], stdout=file, stderr=file, start_new_session=True
            )
        try:
            end = time.monotonic() + 30
            while not (found := re.search(r"successfully on port (\d+)", log.read_text())):
                if self._driver.poll() is not None or time.monotonic() > end:
                    raise RuntimeError(f"chromedriver does not start: {log.read_text()}")
                time.sleep(0.02)
            self._address = f"http://127.0.0.1:{found[1]}/session"
            profile = folder / "profile"
            capabilities = {
                "goog:chromeOptions": {"binary": chromium, "args": [*_OPTIONS, f"--user-data-dir={profile}"]},
                "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
            }
            session = self.send("POST", "", {"capabilities": {"alwaysMatch": capabilities}})
            self._session = f"/{session['sessionId']}"
        except BaseException:
            self.close()
            raise

    def send(self, method: str, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Send a command of the WebDriver protocol."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._address + self._session + path, data, method=method)
        request.add_header("Content-Type", "application/json")
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(request, timeout=60) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as error:
            with error:
                raise RuntimeError(error.read().decode()) from None

    def run(self, expression: str, *arguments: Any) -> Any:
        """Return the value of a JavaScript expression."""
        return self.send("POST", "/execute/sync", {"script": f"return {expression}", "args": arguments})

    def wait_until(self, expression: str, *, seconds: float = 30) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(expression):
            if time.monotonic() > end:
                raise RuntimeError(f"still not true: {expression}")
            time.sleep(0.02)

    def command(self, name: str, **params: Any) -> Any:
        """Send a command of the DevTools protocol."""
        return self.send("POST", "/goog/cdp/execute", {"cmd": name, "params": params})

    def log(self, kind: str) -> Any:
        """Return the log entries since the last call."""
        return self.send("POST", "/se/log", {"type": kind})

    def open(self, path: Path, *, size: Mapping[str, Any] = SCREEN, scheme: str = "light") -> None:
        """Open a file in a window of a given size, with empty logs, and wait until its videos have loaded."""
        self.command("Emulation.setDeviceMetricsOverride", **size)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.command("Emulation.setEmulatedMedia", features=features)
        self.send("POST", "/url", {"url": "about:blank"})
        for kind in ("browser", "performance"):
            self.log(kind)
        self.send("POST", "/url", {"url": path.as_uri()})
        self.wait_until("[...document.querySelectorAll('video')].every(video => video.readyState >= 2)")

    def screenshot(self, height: int) -> NDArray[np.uint8]:
        """Return the top of the page, ``(height, width, 3)`` uint8 RGB, however tall the window is."""
        clip = {"x": 0, "y": 0, "width": self.run("innerWidth"), "height": height, "scale": 1}
        answer = self.command("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(answer["data"]), np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(pixels, np.uint8)[..., ::-1]

    def requests(self) -> set[str]:
        """Return the URLs that the page requested."""
        events = (json.loads(entry["message"])["message"] for entry in self.log("performance"))
        return {
            event["params"]["request"]["url"]
            for event in events
            if event["method"] == "Network.requestWillBeSent"
        }

    def element(self, selector: str) -> str:
        """Return the id of the first element of a CSS selector."""
        return str(self.send("POST", "/element", {"using": "css selector", "value": selector})[_ELEMENT])

    def click(self, selector: str) -> None:
        """Click on an element."""
        self.send("POST", f"/element/{self.element(selector)}/click", {})

    def type(self, selector: str, text: str) -> None:
        """Send keys to an element."""
        self.send("POST", f"/element/{self.element(selector)}/value", {"text": text})

    def point(self, selector: str, fraction: float, *, press: bool = False) -> None:
        """Move the mouse to a fraction of an element's width, and click there if `press`."""
        self.run("document.querySelector(arguments[0]).scrollIntoView({block: 'center'})", selector)
        width = self.run("document.querySelector(arguments[0]).getBoundingClientRect().width", selector)
        origin = {_ELEMENT: self.element(selector)}
        moves: list[dict[str, Any]] = [
            {"type": "pointerMove", "origin": origin, "x": round((fraction - 0.5) * width), "y": 0}
        ]
        if press:
            moves += [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        mouse = {"type": "pointer", "id": "mouse", "actions": moves}
        self.send("POST", "/actions", {"actions": [mouse]})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """End the session and the browser."""
        try:
            if self._session:
                self.send("DELETE", "")
        finally:
            # The driver's process group includes the browser that it started.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._driver.pid, signal.SIGKILL)
            self._driver.wait()
