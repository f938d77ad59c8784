"""A headless Chromium, driven through its debugging pipe with the standard library alone."""

import base64
import json
import os
import select
import shutil
import subprocess
import time

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "google-chrome", "chromium-browser")
PATIENCE_S = 120.0
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--hide-scrollbars"),
    "--remote-debugging-pipe",
)


class Browser:
    """One page in a browser; `complaints` gathers its console, its log and its errors."""

    def __init__(self, folder):
        program = next((path for path in map(shutil.which, NAMES) if path), None)
        if program is None:
            pytest.skip("needs chromium or google-chrome to draw the page")
        # the browser reads its commands from 3 and answers on 4
        command_out, self._commands = os.pipe()
        self._answers, answer_in = os.pipe()

        def place_pipes():
            # numbers of their own first: a pipe may hold one of the two that are wanted
            source, sink = os.dup(command_out), os.dup(answer_in)
            source, sink = (os.dup(fd) if fd in (3, 4) else fd for fd in (source, sink))
            os.dup2(source, 3)
            os.dup2(sink, 4)

        self._process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            preexec_fn=place_pipes,
            close_fds=False,
        )
        os.close(command_out)
        os.close(answer_in)
        self._waiting, self._number, self._session = b"", 0, None
        self.complaints = []
        self._loaded = False
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self._session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")

    def close(self):
        self._process.terminate()
        self._process.wait(30)
        os.close(self._commands)
        os.close(self._answers)

    def __call__(self, method, **parameters):
        """Send a command and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def _next(self):
        end = time.monotonic() + PATIENCE_S
        while b"\0" not in self._waiting:
            ready, _, _ = select.select([self._answers], [], [], max(end - time.monotonic(), 0.0))
            assert ready, "the browser does not answer"
            part = os.read(self._answers, 1 << 20)
            assert part, "the browser has gone"
            self._waiting += part
        text, self._waiting = self._waiting.split(b"\0", 1)
        message = json.loads(text)
        method, parameters = message.get("method"), message.get("params", {})
        if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            self.complaints.append(parameters)
        elif method == "Network.requestWillBeSent":
            url = parameters["request"]["url"]
            if not url.startswith(("data:", "file:")):
                self.complaints.append(f"asks for {url}")
        elif method == "Page.loadEventFired":
            self._loaded = True
        return message

    def open(self, path, width=1100, height=900, dark=False):
        """Show a page in a window of some size."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self("Emulation.setEmulatedMedia", features=[scheme])
        self("Emulation.setDeviceMetricsOverride", width=width, height=height,
             deviceScaleFactor=1, mobile=False)  # fmt: skip
        self._loaded = False
        self("Page.navigate", url=path.as_uri())
        while not self._loaded:
            self._next()

    def ask(self, expression):
        """The value of an expression in the page's own language."""
        result = self("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"]["value"]

    def picture(self):
        """The whole page (h, w, 3), blue green red."""
        size = self("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = self("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
        return cv2.imdecode(np.frombuffer(base64.b64decode(shot["data"]), np.uint8), 1)

    def boxes(self, selector):
        """Label and place (left, top, right, bottom, px) on the page of all that match."""
        return self.ask(
            f"[...document.querySelectorAll({json.dumps(selector)})].map(e => {{"
            "const b = e.getBoundingClientRect(); return [e.getAttribute('aria-label') || "
            "e.getAttribute('alt') || '', [b.left + scrollX, b.top + scrollY, b.right + scrollX, "
            "b.bottom + scrollY].map(Math.round)];})"
        )
