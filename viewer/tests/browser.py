"""Headless Chromium, driven by the DevTools protocol over a pipe, without a package beside the browser."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

CHOSEN = "CARAWARE_BROWSER"
"""Environment variable that names another program."""
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--force-device-scale-factor=1",
    "--remote-debugging-pipe",
)
RENDERERS = {
    "software": ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    # A graphics card, by OpenGL or Vulkan. There is no display that a surface could be for.
    "opengl": ("--use-angle=gl-egl",),
    "vulkan": ("--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"),
}
"""What draws, by its name: arguments of the browser."""
# rerun's page writes tens of thousands of debug messages, each of which would travel through the pipe.
QUIET = "console.debug = () => {};"


def find() -> str:
    """Path of the browser. Without one the test fails and says what to install."""
    for name in filter(None, (os.environ.get(CHOSEN), *NAMES)):
        path = shutil.which(name)
        if path is not None:
            return path
    raise RuntimeError("no Chromium: run scripts/browser.sh (Debian and Ubuntu: apt-get install chromium)")


@dataclass(frozen=True)
class DrawnFrame:
    """A picture that the page has drawn and that differs from the one before."""

    at_s: float
    """When it was shown, seconds since 1970."""
    jpeg: bytes

    def picture(self) -> NDArray[np.uint8]:
        """`[height, width, 3]`."""
        return np.asarray(Image.open(io.BytesIO(self.jpeg)).convert("RGB"))


class Browser:
    """One page in a browser with a fresh profile. Use as a context manager."""

    def __init__(self, width: int, height: int, renderer: str = "software") -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="caraware-browser-", ignore_cleanup_errors=True)
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # Chromium reads commands from descriptor 3 and writes answers to 4, so our ends move to other numbers first.
        ours = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 10) for descriptor in (to_read, to_write)]
        os.close(to_read)
        os.close(to_write)

        def pass_descriptors() -> None:
            for descriptor, number in zip(ours, (3, 4), strict=True):
                os.dup2(descriptor, number)

        arguments = [*ARGUMENTS, *RENDERERS[renderer], f"--user-data-dir={self._profile.name}"]
        self._process = subprocess.Popen(
            [find(), *arguments, f"--window-size={width},{height}", "about:blank"],
            stderr=subprocess.DEVNULL,
            close_fds=False,
            preexec_fn=pass_descriptors,
            start_new_session=True,
        )
        for descriptor in ours:
            os.close(descriptor)
        self._buffer = b""
        self._id = 0
        self.requests: list[str] = []
        """Addresses that the page requested."""
        self.refused: list[str] = []
        """Messages of the page's console about its content security policy."""
        self._drawn: list[DrawnFrame] = []
        self._session: str | None = None
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Log"):
            self.call(f"{domain}.enable")
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        self.call("Page.addScriptToEvaluateOnNewDocument", source=QUIET)

    @property
    def pid(self) -> int:
        """Identity of the browser's main process."""
        return self._process.pid

    def open(self, url: str) -> None:
        """Opens an address."""
        self.call("Page.navigate", url=url)

    def evaluate(self, expression: str) -> Any:
        """Value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str, timeout_s: float) -> None:
        """Waits until an expression is true."""
        deadline = time.monotonic() + timeout_s
        while not self.evaluate(expression):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{expression} is not true after {timeout_s:g} s")
            time.sleep(0.1)

    def screenshot(self) -> NDArray[np.uint8]:
        """A picture of the page, `[height, width, 3]`."""
        data = self.call("Page.captureScreenshot", format="png", timeout_s=300.0)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def drawn(self, seconds: float) -> list[DrawnFrame]:
        """The frames that the page draws in the next `seconds`."""
        self._drawn = []
        self.call("Page.startScreencast", format="jpeg", quality=90, everyNthFrame=1)
        deadline = time.monotonic() + seconds
        with contextlib.suppress(TimeoutError):
            while True:
                self._record(self._receive(deadline, "Page.startScreencast"))
        self.call("Page.stopScreencast")
        return self._drawn

    def _send(self, method: str, **parameters: Any) -> int:
        """Sends a command; returns the number of its answer."""
        self._id += 1
        message: dict[str, Any] = {"id": self._id, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        return self._id

    def call(self, method: str, timeout_s: float = 120.0, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its answer."""
        number = self._send(method, **parameters)
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self._receive(deadline, method)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                result: dict[str, Any] = answer["result"]
                return result
            self._record(answer)

    def _record(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(event["params"]["request"]["url"])
        elif event.get("method") == "Log.entryAdded" and "Content Security Policy" in event["params"]["entry"]["text"]:
            self.refused.append(event["params"]["entry"]["text"])
        elif event.get("method") == "Page.screencastFrame":
            frame = event["params"]
            self._send("Page.screencastFrameAck", sessionId=frame["sessionId"])
            self._drawn.append(DrawnFrame(frame["metadata"]["timestamp"], base64.b64decode(frame["data"])))

    def _receive(self, deadline: float, method: str) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise TimeoutError(f"the browser does not answer {method}")
            chunk = os.read(self._read, 1 << 16)
            if not chunk:
                raise RuntimeError(f"the browser ended with exit code {self._process.wait()}")
            self._buffer += chunk
        line, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        os.close(self._write)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)
        self._profile.cleanup()
