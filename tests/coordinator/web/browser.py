"""A person's browser: Debian's Chromium without a screen, driven by playwright; and a demo to look at."""

import contextlib
import json
import os
import shutil
import signal
import socket
import struct
import time
import zlib
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, ViewportSize, sync_playwright

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.support.examples import DEMO_MACHINE
from tests.stages.processes import Command

PATIENCE_MS = 60_000
"""For one event; most come at once, homing takes 10 s of the machine's time."""
DESKTOP = ViewportSize(width=1440, height=900)
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
    """Return a port that the kernel does not give to others' connections (those are above 32,767)."""
    first = 20_000 + os.getpid() % 8_000
    for port in range(first, 32_000):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    raise AssertionError("no port is free")


def zigzag(lines: int) -> str:
    """Return moves at 50 mm/s, every fourth without extrusion, of 10 mm each: LINES is below 4,000."""
    moves = []
    for n in range(lines):
        row, column = n // 8 % 8, n % 8
        x = 20 + 10 * (column if row % 2 == 0 else 7 - column)
        extruded = "" if n % 4 == 3 else " E0.3"
        moves.append(f"G1 X{x} Y{20 + 10 * row}{extruded} F3000")
    return "\n".join(["G90", "M83", *moves]) + "\n"


def png(width: int, height: int) -> bytes:
    """Return a picture of one colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes((40, 120, 200)) * width) * height
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def thumbnail(width: int, height: int) -> str:
    """Return a picture as slicers write it into comments."""
    text = b64encode(png(width, height)).decode()
    lines = [f"; {text[i : i + 78]}\n" for i in range(0, len(text), 78)]
    return f"; thumbnail begin {width}x{height} {len(text)}\n{''.join(lines)}; thumbnail end\n"


OBJECTS = """\
EXCLUDE_OBJECT_DEFINE NAME=left CENTER=30,30 POLYGON=[[20,20],[40,20],[40,40],[20,40]]
EXCLUDE_OBJECT_DEFINE NAME=right CENTER=70,30
"""
JOBS = {"part.gcode": thumbnail(32, 16) + OBJECTS + "G28 X Y\n" + zigzag(3_900)}
"""A quarter of an hour, so that no test sees the end. Z, which takes longest to be homed, stays as it is."""
MORE_SECTIONS = """
[axis_tables]
[exclude_object]
[gcode_macro GREET]
description: Say good morning
gcode: M118 good morning
[gcode_macro _INNER]
gcode: M118 never a button
"""


@dataclass
class Demo:
    """``canductor demo --serve --web``, which can be ended and started again at the same place."""

    folder: Path
    port: int = field(default_factory=free_port)
    command: Command | None = None

    @property
    def path(self) -> Path:
        return self.folder / "demo.sock"

    def start(self) -> None:
        jobs = self.folder / "jobs"
        jobs.mkdir(exist_ok=True)
        for name, text in JOBS.items():
            (jobs / name).write_text(text)
        machine = self.folder / "demo.cfg"
        machine.write_text(DEMO_MACHINE.read_text(encoding="utf-8") + MORE_SECTIONS, encoding="utf-8")
        words = ("--serve", "--ipc", self.path, "--web", str(self.port), "--jobs", jobs)
        self.command = Command("demo", "--machine", machine, *words)
        self.command.stdout.wait_for("ready")

    def end(self) -> None:
        assert self.command is not None
        self.command.signal(signal.SIGTERM)
        ended = self.command.end()
        self.command = None
        assert "Traceback" not in ended.stderr, ended.stderr

    @property
    def printed_link(self) -> str:
        """The one-time link that it printed at its start."""
        assert self.command is not None
        before = "to get in, open "
        self.command.stdout.wait_for(before)
        line = next(line for line in self.command.stdout._lines if before in line)
        return line.removeprefix(before).split()[0]

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

    def __init__(self, browser: Browser) -> None:
        self.context: BrowserContext = browser.new_context(viewport=DESKTOP, color_scheme="light")
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

    def close(self, *expected: str) -> None:
        """Close it; nothing may have gone wrong in it, but what has one of EXPECTED in its words."""
        wrong = [text for text in self.wrong if not any(words in text for words in expected)]
        self.context.close()
        assert not wrong, wrong
