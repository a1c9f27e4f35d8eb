"""A real headless Chromium, driven by the DevTools protocol over a pipe; no package is needed.

    with Browser() as browser:
        page = browser.open("http://127.0.0.1:8080/")
        page.wait_for("document.title !== ''")
        pixels = page.screenshot()

What pages write to their console, and errors that they do not catch, are in `Page.console`.
Tests that use it carry the mark `browser`, which skips them where there is no Chromium.
"""

from __future__ import annotations

import atexit
import base64
import contextlib
import fcntl
import functools
import io
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections import deque
from collections.abc import Callable
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np
from PIL import Image

_FLAGS = [
    "--headless=new",
    "--no-sandbox",  # tests run as root, in containers
    # Pages are composed without OpenGL: only WebGL is emulated, which takes a third of the time.
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",  # a container's /dev/shm is small
    "--force-color-profile=srgb",
    "--mute-audio",
]


# WebGPU in software; Chromium's GPU process ends if pages are composed without it.
_WEBGPU_FLAGS = [
    *(flag for flag in _FLAGS if flag != "--disable-gpu"),
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
]

# Scripts get the next frame that begins this many milliseconds later.
_SLOW_FRAMES = """(() => {
    const request = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = draw => window.setTimeout(() => request(draw), %g);
    window.cancelAnimationFrame = window.clearTimeout.bind(window);
})()"""


def chromium() -> str | None:
    """The program: SNOWSPLAT_CHROMIUM, else the first of its usual names on the PATH."""
    named = os.environ.get("SNOWSPLAT_CHROMIUM")
    if named:
        return named
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((found for name in names if (found := shutil.which(name))), None)


class BrowserError(Exception):
    """A command was rejected, a script in a page failed, or a time limit was exceeded."""


class _Process:
    """A process of Chromium with a temporary profile. `close` ends it and removes the profile."""

    def __init__(self, flags: list[str]) -> None:
        program = chromium()
        assert program is not None, "the test lacks the mark browser"
        self._profile = tempfile.mkdtemp(prefix="snowsplat-chromium-")
        to_browser, self._commands = _pipe()
        self._replies, from_browser = _pipe()
        # Chromium reads commands from file descriptor 3 and writes responses to 4.
        shell = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        command = [program, *flags, f"--user-data-dir={self._profile}", "about:blank"]
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "chromium", *command],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._last = 0
        self._writing = threading.Lock()
        self._waiting: dict[int, Queue[dict[str, Any]]] = {}
        self.pages: dict[str, Page] = {}
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def runs(self) -> bool:
        return self._process.poll() is None

    def close(self) -> None:
        with contextlib.suppress(BrowserError, OSError, subprocess.TimeoutExpired):
            self.call("Browser.close", timeout=5)
            self._process.wait(5)
        self.kill()
        os.close(self._commands)
        shutil.rmtree(self._profile, ignore_errors=True)

    def kill(self) -> None:
        """Kill its whole group, with the renderers and the GPU process, if it is still running."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def call(
        self, method: str, session: str | None = None, timeout: float = 60.0, **parameters: Any
    ) -> dict[str, Any]:
        """Send one command of the protocol and wait for its result."""
        answer: Queue[dict[str, Any]] = Queue()
        with self._writing:
            self._last += 1
            message = {"id": self._last, "method": method, "params": parameters}
            if session:
                message["sessionId"] = session
            self._waiting[self._last] = answer
            data = json.dumps(message).encode() + b"\0"
            while data:
                data = data[os.write(self._commands, data) :]
        try:
            reply = answer.get(timeout=timeout)
        except Empty:
            raise BrowserError(f"{method}: no response in {timeout:.0f} s") from None
        if "error" in reply:
            raise BrowserError(f"{method}: {reply['error'].get('message')}")
        return reply["result"]

    def _read(self) -> None:
        with open(self._replies, "rb") as replies:
            rest = b""
            while block := replies.read1(1 << 20):
                *messages, rest = (rest + block).split(b"\0")
                for message in messages:
                    self._take(json.loads(message))
        for answer in list(self._waiting.values()):
            answer.put({"error": {"message": "the browser has ended"}})

    def _take(self, message: dict[str, Any]) -> None:
        if "id" in message:
            answer = self._waiting.pop(message["id"], None)
            if answer is not None:
                answer.put(message)
        elif (page := self.pages.get(message.get("sessionId", ""))) is not None:
            page._event(message["method"], message["params"])


@functools.cache
def _shared() -> _Process:
    """The process that the browsers without WebGPU share: to start one takes a second."""
    process = _Process(_FLAGS)
    atexit.register(process.close)
    return process


class Browser:
    """A browser of its own: it shares only the process with others, not what pages store.

    Tabs have ``width`` × ``height`` CSS pixels, of ``scale`` pixels of the screen. Without a GPU,
    the time to draw a page is proportional to the number of pixels of the screen. Scripts that
    draw for each frame of the screen run at most ``frames`` times per second, because pages with
    WebGL otherwise use the processor all the time. ``webgpu``: pages can use WebGPU, too.
    """

    def __init__(
        self,
        width: int = 640,
        height: int = 480,
        scale: float = 1.0,
        frames: float = 10.0,
        *,
        webgpu: bool = False,
    ) -> None:
        self.width, self.height, self.scale, self.frames = width, height, scale, frames
        self._webgpu = webgpu

    def __enter__(self) -> Browser:
        if not self._webgpu and not _shared().runs:
            _shared.cache_clear()
        self._process = _Process(_WEBGPU_FLAGS) if self._webgpu else _shared()
        made = self._process.call("Target.createBrowserContext", disposeOnDetach=True)
        self._context = made["browserContextId"]
        return self

    def __exit__(self, *_: object) -> None:
        if self._webgpu:
            self._process.close()
            return
        with contextlib.suppress(BrowserError, OSError):  # after a crash
            self._process.call("Target.disposeBrowserContext", browserContextId=self._context)

    def kill(self) -> None:
        """Kill the process with all its browsers."""
        self._process.kill()

    def open(self, url: str, timeout: float = 30.0, language: str = "en-US") -> Page:
        """Open a new tab that shows ``url``; waits until its document is loaded.

        ``language``: what the page takes for the language of the browser.
        """
        blank = {"url": "about:blank", "browserContextId": self._context}
        target = self._process.call("Target.createTarget", **blank)["targetId"]
        attached = self._process.call("Target.attachToTarget", targetId=target, flatten=True)
        session = attached["sessionId"]
        page = self._process.pages[session] = Page(self._process, session, target)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.resize(self.width, self.height, self.scale)
        page.call(
            "Page.addScriptToEvaluateOnNewDocument", source=_SLOW_FRAMES % (1e3 / self.frames)
        )
        agent = page.evaluate("navigator.userAgent")
        page.call("Emulation.setUserAgentOverride", userAgent=agent, acceptLanguage=language)
        page.navigate(url, timeout)
        return page


class Page:
    """A tab.

    Attributes:
        console: lines of the console, with uncaught errors and failed requests as "error: …".
        requests: the addresses that the page requested.
    """

    def __init__(self, process: _Process, session: str, target: str) -> None:
        self._process, self._session, self._target = process, session, target
        self.console: deque[str] = deque(maxlen=1000)
        self.requests: deque[str] = deque(maxlen=1000)
        self._loaded = threading.Event()

    @property
    def errors(self) -> list[str]:
        """The lines of the console that are errors."""
        return [line for line in self.console if line.startswith("error: ")]

    def call(self, method: str, timeout: float = 60.0, **parameters: Any) -> dict[str, Any]:
        """Send one command of the DevTools protocol to this tab."""
        return self._process.call(method, self._session, timeout, **parameters)

    def navigate(self, url: str, timeout: float = 30.0) -> None:
        """Show another address; waits until its document is loaded."""
        self._loaded.clear()
        result = self.call("Page.navigate", url=url)
        if "errorText" in result:
            raise BrowserError(f"{url}: {result['errorText']}")
        if not self._loaded.wait(timeout):
            raise BrowserError(f"{url}: not loaded in {timeout:.0f} s")

    def evaluate(self, script: str, timeout: float = 60.0) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        result = self.call(
            "Runtime.evaluate",
            timeout,
            expression=script,
            awaitPromise=True,
            returnByValue=True,
            userGesture=True,
        )
        if "exceptionDetails" in result:
            raise BrowserError(f"{script}: {_error_text(result['exceptionDetails'])}")
        return result["result"].get("value")

    def wait_for(self, script: str, timeout: float = 30.0) -> Any:
        """Evaluate repeatedly until the value is true, also in pages that follow; returns it."""
        end = time.monotonic() + timeout
        while not (value := self._evaluate_between_pages(script)):
            if time.monotonic() > end:
                shown = "\n".join(self.console)
                raise BrowserError(f"not in {timeout:.0f} s: {script}\nconsole:\n{shown}")
            time.sleep(0.05)
        return value

    def _evaluate_between_pages(self, script: str) -> Any:
        try:
            return self.evaluate(script)
        except BrowserError as error:
            if "Inspected target navigated" in str(error):
                return None
            raise

    def screenshot(self, path: Path | None = None) -> np.ndarray:
        """(H, W, 3) uint8: the content of the tab; also stored as PNG if a path is given."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(data)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def wait_for_picture(
        self, fits: Callable[[np.ndarray], bool], timeout: float = 30.0
    ) -> np.ndarray:
        """The first screenshot for which ``fits`` is true: frames are late on a busy machine."""
        end = time.monotonic() + timeout
        while not fits(shown := self.screenshot()):
            if time.monotonic() > end:
                raise BrowserError(f"not in {timeout:.0f} s: the expected picture")
            time.sleep(0.1)
        return shown

    def click(self, x: float, y: float) -> None:
        """Click with the left button; x and y are pixels from the upper left corner."""
        for kind in ("mousePressed", "mouseReleased"):
            self._mouse(kind, x, y, button="left", clickCount=1)

    def drag(self, x0: float, y0: float, x1: float, y1: float, steps: int = 8) -> None:
        """Drag with the left button, in a straight line."""
        self._mouse("mousePressed", x0, y0, button="left", clickCount=1)
        for i in range(1, steps + 1):
            x, y = x0 + (x1 - x0) * i / steps, y0 + (y1 - y0) * i / steps
            self._mouse("mouseMoved", x, y, button="left", buttons=1)
        self._mouse("mouseReleased", x1, y1, button="left", clickCount=1)

    def key(self, key: str, modifiers: int = 0, **more: Any) -> None:
        """Press and release a key; ``modifiers``: the sum of 1 Alt, 2 Control, 8 Shift."""
        number = {"Tab": 9, "Enter": 13, "Escape": 27}.get(key, ord(key.upper()[0]))
        text = {"Enter": "\r"}.get(key, key if len(key) == 1 and modifiers < 2 else "")
        event = {"key": key, "code": f"Key{key.upper()}" if key.isalpha() and text else key} | more
        for kind in ("keyDown" if text else "rawKeyDown", "keyUp"):
            typed = {"text": text} if kind == "keyDown" else {}
            event |= {"windowsVirtualKeyCode": number, "modifiers": modifiers}
            self.call("Input.dispatchKeyEvent", type=kind, **event, **typed)

    def drop(self, path: Path, x: float = 400, y: float = 200) -> None:
        """Drop a file or folder on the page."""
        data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=x, y=y, data=data)

    def resize(self, width: int, height: int, scale: float = 1.0) -> None:
        """Give the tab another size, as `Browser` says."""
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def close(self) -> None:
        """Close the tab."""
        self._process.call("Target.closeTarget", targetId=self._target)

    def _mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def _event(self, method: str, event: dict[str, Any]) -> None:
        if method == "Page.loadEventFired":
            self._loaded.set()
        elif method == "Network.requestWillBeSent":
            self.requests.append(event["request"]["url"])
        elif method == "Runtime.consoleAPICalled":
            words = [str(a.get("value", a.get("description", ""))) for a in event["args"]]
            self.console.append(f"{event['type']}: {' '.join(words)}")
        elif method == "Runtime.exceptionThrown":
            self.console.append(f"error: {_error_text(event['exceptionDetails'])}")
        elif method == "Log.entryAdded":  # failed requests, violations of the content policy
            entry = event["entry"]
            self.console.append(f"{entry['level']}: {entry['text']} {entry.get('url', '')}")


def _pipe() -> tuple[int, int]:
    """The two ends, both above 9, so that the shell can redirect to them."""
    ends = os.pipe()
    above = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return above[0], above[1]


def _error_text(details: dict[str, Any]) -> str:
    return str(details.get("exception", {}).get("description", details.get("text")))


def english_text(report: Path) -> str:
    """The words of a report, without those in Chinese."""
    main = ET.parse(report).getroot().find("body/main")
    assert main is not None
    for parent in list(main.iter()):
        for each in parent.findall("*[@lang='zh']"):
            each.clear()
    return " ".join("".join(main.itertext()).split())


def chinese_labels(report: Path) -> list[str]:
    """The headings and labels of a report in a browser in Chinese; none is left in English."""
    shown = "[...document.querySelectorAll('h2, th, .card, summary')]"
    with Browser() as browser:
        page = browser.open(report.as_uri(), language="zh-CN")
        page.evaluate("document.querySelectorAll('.card b').forEach(each => each.remove())")
        labels: list[str] = page.evaluate(f"{shown}.map(each => each.innerText)")
        assert not page.errors
    left = re.sub(r"PSNR|SSIM|RMS|dB|ms", "", " ".join(labels))
    assert len(labels) > 20
    assert not re.findall("[A-Za-z]{3,}", left), left
    return labels
