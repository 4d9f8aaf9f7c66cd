"""Drives real Mainsail and Fluidd builds in Chromium, by what their screens show, through a real Moonraker.

Their builds come from archives; nothing of them is part of this project.
"""

import functools
import http.server
import json
import re
import tarfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from playwright.sync_api import Browser, Locator, Page, ViewportSize

from tests.frontends.moonraker import Failed, Moonraker, until

EVENT_MS: Final = 60_000
"""For one thing to be shown; most come at once."""
SCREEN: Final = ViewportSize(width=1440, height=1000)
BUILDS: Final = {"mainsail": "mainsail-d347eb7a.tar.xz", "fluidd": "fluidd-d2932898.tar.xz"}
JOB_NAME: Final = "part.gcode"
TARGET_C: Final = 55


class _Files(http.server.SimpleHTTPRequestHandler):
    """Serves a build, with the address of Moonraker in its config.json."""

    port: int

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 (its name in the base class)
        """Say nothing."""

    def do_GET(self) -> None:
        """Answer one request."""
        if self.path.split("?")[0] != "/config.json":
            super().do_GET()
            return
        config = json.loads((Path(self.directory) / "config.json").read_text())
        address = f"http://127.0.0.1:{self.port}"
        body = json.dumps(
            config | {"hostname": "127.0.0.1", "port": self.port, "endpoints": [address]}
        ).encode()
        self.send_response(http.HTTPStatus.OK)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@contextmanager
def served(build: Path, port: int) -> Iterator[str]:
    """Serve the files of BUILD, for the Moonraker at PORT; yield the address."""
    handler = functools.partial(type("Files", (_Files,), {"port": port}), directory=str(build))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


def unpack(archives: Path, name: str, folder: Path) -> Path:
    """Return the folder of the build NAME, unpacked into FOLDER."""
    with tarfile.open(archives / BUILDS[name]) as archive:
        archive.extractall(folder / name, filter="data")
    return folder / name / "dist"


class Screen:
    """The front end NAME in a tab, and the errors in it."""

    def __init__(self, name: str, browser: Browser, address: str) -> None:
        self.name = name
        # A service worker would reload the page whenever it likes.
        self._context = browser.new_context(viewport=SCREEN, service_workers="block")
        self._context.set_default_timeout(EVENT_MS)
        self.page: Page = self._context.new_page()
        self._errors: list[str] = []
        self.page.on("pageerror", lambda error: self._errors.append(str(error)))
        self.page.goto(address)

    def button(self, label: str) -> Locator:
        """Return the first button whose whole text is LABEL."""
        return self.page.locator("button:visible").filter(has_text=_whole(label)).first

    def close(self) -> None:
        """Close it; raises Failed for errors that the page had, and for a notice about the version."""
        body = self.page.inner_text("body").lower()
        self._context.close()
        if self._errors:
            raise Failed(f"errors in the page: {self._errors}")
        if "too old" in body:
            raise Failed("the page shows 'too old'")


def _whole(text: str) -> re.Pattern[str]:
    return re.compile(rf"^\s*{re.escape(text)}\s*$", re.IGNORECASE)


def _field(api: Moonraker, name: str, field: str) -> Any:
    return api.query(name)[name][field]


def drive(screen: Screen, api: Moonraker, pictures: Path | None) -> Iterator[str]:
    """Do what users do on SCREEN; yield what was seen to work. Raises Failed and playwright's errors."""
    page, mainsail = screen.page, screen.name == "mainsail"
    screen.button("ALL").click()
    until(lambda: _field(api, "toolhead", "homed_axes") == "xyz", "homed")
    before_mm = _field(api, "toolhead", "position")[0]
    # A jog button is enabled once its axis is shown as homed; the click waits for that.
    if mainsail:
        screen.button("+10").click()
    else:
        screen.button("10").click()
        page.locator("button.px-2:visible").nth(5).click()  # right of the home button; the X axis
    until(lambda: abs(_field(api, "toolhead", "position")[0] - before_mm - 10.0) < 1e-3, "a jog by 10 mm")
    yield f"{screen.name}: homed, jogged"
    target = page.locator("tr:visible", has_text="Heater Bed").locator("input:visible").first
    target.fill(str(TARGET_C))
    target.press("Enter")
    until(lambda: _field(api, "heater_bed", "target") == TARGET_C, "the bed's target")
    yield f"{screen.name}: bed set to {TARGET_C} °C"
    _print_from_list(screen)
    until(lambda: api.print_state() == "printing", "printing")
    until(lambda: _field(api, "print_stats", "print_duration") > 1.0, "the first extrusion")
    shown = page.get_by_text(
        re.compile(r"^\s*\d+% Printing\s*$" if mainsail else r"^\s*Printing\s*$", re.IGNORECASE)
    )
    shown.locator("visible=true").first.wait_for()
    if pictures is not None:
        page.screenshot(path=pictures / f"{screen.name}.png")
    yield f"{screen.name}: printed from the file list"
    _job_button(screen, "Pause", "warning").click()
    until(lambda: api.print_state() == "paused", "paused")
    _job_button(screen, "Resume", "success").click()
    until(lambda: api.print_state() == "printing", "printing again")
    if mainsail:  # its button for cancelling is there only while the job is paused
        _job_button(screen, "Pause", "warning").click()
        until(lambda: api.print_state() == "paused", "paused again")
    _job_button(screen, "Cancel", "error").click()
    if not mainsail:
        page.locator(".v-dialog--active button:visible").filter(has_text=_whole("Yes")).first.click()
    until(lambda: api.print_state() == "cancelled", "cancelled")
    yield f"{screen.name}: paused, resumed, cancelled"
    if mainsail:
        screen.button("Emergency Stop").click()
    else:
        page.locator("header button:visible").first.click()
    until(lambda: api.state() == "shutdown", "shutdown")
    screen.button("Firmware Restart").click()
    until(lambda: api.state() == "ready", "ready after the stop")
    yield f"{screen.name}: stopped at once, restarted"
    screen.close()
    yield f"{screen.name}: no page error, no 'too old' notice"


def _print_from_list(screen: Screen) -> None:
    page, mainsail = screen.page, screen.name == "mainsail"
    if mainsail:
        job = page.get_by_text(JOB_NAME).locator("visible=true").first
    else:  # the row of the list has a size; that of the history has none
        job = page.locator("tr:visible", has_text=re.compile(re.escape(JOB_NAME) + ".*kB", re.DOTALL)).first
    job.click(button="right")
    entry = _whole("Print start" if mainsail else "Print")
    page.locator(".v-list:visible").get_by_text(entry).locator("visible=true").first.click()
    if mainsail:  # it asks again
        page.locator(".v-dialog--active button:visible").filter(has_text=_whole("Print")).first.click()


def _job_button(screen: Screen, label: str, colour: str) -> Locator:
    """Return a button of the job: Fluidd's have a LABEL, Mainsail's only an icon in a COLOUR."""
    if screen.name == "mainsail":
        return screen.page.locator(f".v-card .v-toolbar button.{colour}--text:visible").first
    return screen.button(label)
