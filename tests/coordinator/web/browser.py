"""A person's browser: Debian's Chromium without a screen, driven by playwright; and a demo to look at."""

import json
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, ViewportSize, sync_playwright

from coordinator.commands import DEMO_MACHINE
from coordinator.ipc.blocking import BlockingClient
from tests.stages.processes import Command

PATIENCE_MS = 30_000
"""Nothing here takes a tenth of it, on a computer that has nothing else to do."""
DESKTOP = ViewportSize(width=1440, height=900)
PHONE = ViewportSize(width=390, height=844)
# Nothing but this computer has a name or an answer: a page that asked elsewhere would be heard, and fail.
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start it, or skip."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("no chromium; apt-get install --no-install-recommends chromium")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port


def long_job() -> str:
    """Return a job of a quarter of an hour, so that no test sees its end; and not a hard one."""
    lines = ["G28", "G90", "M83", "G1 Z1 F900"]
    for n in range(4000):
        row, column = n // 8 % 8, n % 8
        x = 20 + 10 * (column if row % 2 == 0 else 7 - column)
        extruded = "" if n % 4 == 3 else " E0.3"  # every fourth way is a travel
        lines.append(f"G1 X{x} Y{20 + 10 * row} Z{1 + n // 64 * 0.2:.1f}{extruded} F3000")
    return "\n".join(lines) + "\n"


@dataclass
class Demo:
    """``canductor demo --serve --web``, which can be ended and started again at the same place."""

    folder: Path
    port: int = field(default_factory=free_port)
    command: Command | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    @property
    def path(self) -> Path:
        return self.folder / "demo.sock"

    def start(self) -> None:
        jobs = self.folder / "jobs"
        jobs.mkdir(exist_ok=True)
        (jobs / "part.gcode").write_text(long_job())
        machine = self.folder / "demo.cfg"
        machine.write_text(f"{DEMO_MACHINE.read_text(encoding='utf-8')}\n[axis_tables]\n", encoding="utf-8")
        words = ("--serve", "--ipc", self.path, "--web", str(self.port), "--jobs", jobs)
        self.command = Command("demo", "--machine", machine, *words)
        self.command.stdout.wait_for("ready")

    def end(self) -> None:
        assert self.command is not None
        self.command.signal(signal.SIGTERM)
        ended = self.command.end()
        self.command = None
        assert "Traceback" not in ended.stderr, ended.stderr

    def link(self) -> str:
        """Return a one-time link, as ``canductor page`` prints it."""
        return str(self.ask("page.link")["url"])

    def ask(self, method: str, **params: Any) -> Any:
        """Call a method past the page: what the machine itself says."""
        with BlockingClient(str(self.path)) as client:
            return client.call(method, params)


@contextmanager
def demo(folder: Path) -> Iterator[Demo]:
    """Serve a virtual machine."""
    served = Demo(folder)
    try:
        served.start()
        yield served
    finally:
        if served.command is not None:
            served.command.__exit__()


class Visitor:
    """A tab of its own, with all it asked for, and all that went wrong in it."""

    def __init__(
        self,
        browser: Browser,
        url: str,
        viewport: ViewportSize = DESKTOP,
        *,
        touch: bool = False,
        **options: Any,
    ) -> None:
        self.url = url
        """Where it goes first: a one-time link, so that it is let in."""
        self.context: BrowserContext = browser.new_context(viewport=viewport, has_touch=touch, **options)
        self.context.set_default_timeout(PATIENCE_MS)
        self.page: Page = self.context.new_page()
        self.asked: list[str] = []
        self.wrong: list[str] = []
        self.context.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("console", self._said)

    def _said(self, said: ConsoleMessage) -> None:
        if (
            said.type in ("error", "warning") and "willReadFrequently" not in said.text
        ):  # the tests read, not it
            self.wrong.append(said.text)

    def visit(self) -> "Visitor":
        """Open the page and wait until it knows the machine."""
        self.page.goto(self.url)
        self.until("document.getElementById('name').textContent === 'demo'")
        self.until("document.getElementById('job-files').value !== ''")  # the last thing that it asks for
        return self

    def until(self, condition: str) -> None:
        """Wait until a JavaScript expression holds."""
        # As a function: the page forbids the evaluation of strings, and that holds for the test, too.
        self.page.wait_for_function(f"() => {condition}", timeout=PATIENCE_MS)

    def until_text(self, element: str, text: str) -> None:
        """Wait until the text of the element with an id is TEXT."""
        self.until(f"document.getElementById({json.dumps(element)}).textContent === {json.dumps(text)}")

    def wait_for(self, true: Callable[[], bool], what: str) -> None:
        """Wait until TRUE, while what the browser tells is heard."""
        end_s = time.monotonic() + PATIENCE_MS / 1e3
        while not true():
            assert time.monotonic() < end_s, f"{what} did not come"
            self.page.wait_for_timeout(50)

    def text(self, element: str) -> str:
        return self.page.text_content(f"#{element}") or ""

    def close(self) -> None:
        self.context.close()
