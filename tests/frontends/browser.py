"""Drives real Mainsail and Fluidd builds in Chromium, by what their screens show, through a real Moonraker.

Their builds come from archives; nothing of them is part of this project.
"""

import functools
import http.server
import json
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from playwright.sync_api import Browser, ConsoleMessage, Locator, Page, ViewportSize

from tests.frontends.moonraker import Failed, Moonraker, until

EVENT_MS: Final = 60_000
"""For one thing to be shown; most come at once."""
SCREEN: Final = ViewportSize(width=1440, height=1000)
BUILDS: Final = {"mainsail": "mainsail-d347eb7a.tar.xz", "fluidd": "fluidd-d2932898.tar.xz"}
JOB_NAME: Final = "part.gcode"
TARGET_C: Final = 55
HEATERS: Final = ("Extruder", "Heater Bed")
FLUIDD_RIGHT: Final = 5
"""Which of its buttons without text jogs to the right: the one beside that which homes X and Y."""
REJECTIONS: Final = """
addEventListener("unhandledrejection", event => {
    console.error("unhandled rejection: " + JSON.stringify(event.reason));
    event.preventDefault();
});
"""
"""Playwright names a rejection that is no Error by its type only; the console has its values."""
EXPECTED: Final = (
    # It is blocked here: see Screen.
    re.compile(r"PWA\]? registration error"),
    # Files and settings that a front end looks for and nobody has written yet.
    re.compile(r"status of 404 .* at http://[^ ]*/(server/files/config/\.theme/|server/database/item\?)"),
)
"""Errors of the console that have nothing to do with the host."""
ABSENT_HOST: Final = re.compile(r'unhandled rejection: {"code":503,"message":"Klippy Host not connected"}')
"""Fluidd asks for `printer.info` as soon as the host has disconnected, and does not catch Moonraker's error;
it does the same where no host runs at all. A host that restarts has to disconnect (docs/klippy-api.md)."""
DEAD: Final = re.compile(
    r"\b(NaN|undefined|Infinity)\b|not connected|klipper is not|printer is not ready", re.IGNORECASE
)
COMPLAINTS: Final = re.compile(r"too old|outdated|warning|missing|not found|unsupported", re.IGNORECASE)
BELL: Final = 'header button:visible:has(path[d^="M10 21H14C14 22.1"])'
ADDED: Final = "output_pin from_{name}"
ADDED_PINS: Final = {"mainsail": "PA8", "fluidd": "PA9"}


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
    shutil.unpack_archive(archives / BUILDS[name], folder / name)  # Debian 12's tarfile knows no filters
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
        self.page.add_init_script(REJECTIONS)
        self.page.on("pageerror", lambda error: self._errors.append(str(error)))
        self.page.on("console", self._hear)
        self.page.goto(address)

    def button(self, label: str) -> Locator:
        """Return the first button whose whole text is LABEL."""
        return self.page.locator("button:visible").filter(has_text=_whole(label)).first

    def field(self, row: str) -> Locator:
        """Return the first field for input in the table's row with the text ROW."""
        return self.page.locator("tr:visible", has_text=row).locator("input:visible").first

    def go(self, address: str) -> None:
        """Open the page to which the menu links with ADDRESS."""
        press(self.page.locator(f"a[href$='{address}']").first)

    def check(self) -> None:
        """Raise Failed for temperatures that are no numbers, a host that is shown as dead, and complaints."""
        body = self.page.inner_text("body")
        if found := DEAD.search(body):
            raise Failed(f"{self.name} shows {found.group()!r}: {body}")
        rows = self.page.locator("tr:visible", has_text="°C").all_inner_texts()
        if len(rows) < len(HEATERS) or not all(re.search(r"\d\s*°C", row) for row in rows):
            raise Failed(f"{self.name} shows these temperatures: {rows}")
        press(self.page.locator(BELL).first)
        notes = self.page.locator(".menuable__content__active").first.inner_text()
        self.page.keyboard.press("Escape")
        if COMPLAINTS.search(notes):
            raise Failed(f"{self.name} notifies: {notes}")

    def close(self) -> None:
        """Close it; raises Failed for errors that the page or its console had."""
        self._context.close()
        if self._errors:
            raise Failed(f"errors in the page: {self._errors}")

    def _hear(self, message: ConsoleMessage) -> None:
        text = f"{message.text} at {message.location['url']}"
        expected = EXPECTED if self.name == "mainsail" else (*EXPECTED, ABSENT_HOST)
        if message.type == "error" and not any(known.search(text) for known in expected):
            self._errors.append(text[:500])


def press(target: Locator) -> None:
    """Click on TARGET, wherever it is by then; it has to be one that could be clicked.

    The pages move what they show whenever the machine's state changes. When that happens between mousedown
    and mouseup, the browser sends the button no click event.
    """
    target.click(trial=True)
    target.focus()
    target.dispatch_event("click")


def _whole(text: str) -> re.Pattern[str]:
    return re.compile(rf"^\s*{re.escape(text)}\s*$", re.IGNORECASE)


def _field(api: Moonraker, name: str, field: str) -> Any:
    return api.query(name)[name][field]


def drive(screen: Screen, api: Moonraker, config: Path, pictures: Path | None) -> Iterator[str]:
    """Do what users do on SCREEN; yield what was seen to work. Raises Failed and playwright's errors.

    CONFIG is the machine's configuration file.
    """
    _home_and_jog(screen, api)
    yield f"{screen.name}: homed, and shown so; jogged"
    target = screen.field("Heater Bed")
    target.fill(str(TARGET_C))
    target.press("Enter")
    until(lambda: _field(api, "heater_bed", "target") == TARGET_C, "the bed's target")
    screen.check()
    yield f"{screen.name}: bed set to {TARGET_C} °C; temperatures are numbers, no complaint"
    _print(screen, api, pictures)
    yield f"{screen.name}: printed from the file list"
    _pause_resume_cancel(screen, api)
    yield f"{screen.name}: paused, resumed, cancelled"
    _edit(screen, api, config)
    yield f"{screen.name}: edited the configuration, restarted; what was added is shown"
    _stop_and_restart(screen, api)
    screen.check()
    yield f"{screen.name}: stopped at once, with the cause shown; restarted"
    screen.close()
    yield f"{screen.name}: no errors in the page or its console"


def _home_and_jog(screen: Screen, api: Moonraker) -> None:
    page, mainsail = screen.page, screen.name == "mainsail"
    until(lambda: api.state() == "ready", "ready")
    press(screen.button("ALL"))
    until(lambda: _field(api, "toolhead", "homed_axes") == "xyz", "homed")
    # Buttons that home an axis change their colour when it is shown as homed.
    label, colour = ("ALL", "primary") if mainsail else ("X", "btncolor")
    page.locator(f"button.{colour}:visible").filter(has_text=_whole(label)).first.wait_for()
    before_mm = _field(api, "toolhead", "position")[0]
    if mainsail:
        press(screen.button("+10"))
    else:
        press(screen.button("10"))
        press(page.locator("button.px-2:visible").nth(FLUIDD_RIGHT))
    until(lambda: abs(_field(api, "toolhead", "position")[0] - before_mm - 10.0) < 1e-3, "a jog by 10 mm")


def _print(screen: Screen, api: Moonraker, pictures: Path | None) -> None:
    page, mainsail = screen.page, screen.name == "mainsail"
    _print_from_list(screen)
    until(lambda: api.print_state() == "printing", "printing")
    until(lambda: _field(api, "print_stats", "print_duration") > 1.0, "the first extrusion")
    shown = page.get_by_text(
        re.compile(r"^\s*\d+% Printing\s*$" if mainsail else r"^\s*Printing\s*$", re.IGNORECASE)
    )
    shown.locator("visible=true").first.wait_for()
    if pictures is not None:
        page.evaluate("scrollTo(0, 0)")
        page.screenshot(path=pictures / f"{screen.name}.png")


def _pause_resume_cancel(screen: Screen, api: Moonraker) -> None:
    page, mainsail = screen.page, screen.name == "mainsail"
    press(_job_button(screen, "Pause", "warning"))
    until(lambda: api.print_state() == "paused", "paused")
    press(_job_button(screen, "Resume", "success"))
    until(lambda: api.print_state() == "printing", "printing again")
    if mainsail:  # its button for cancelling is there only while the job is paused
        press(_job_button(screen, "Pause", "warning"))
        until(lambda: api.print_state() == "paused", "paused again")
    press(_job_button(screen, "Cancel", "error"))
    if not mainsail:
        press(page.locator(".v-dialog--active button:visible").filter(has_text=_whole("Yes")).first)
    until(lambda: api.print_state() == "cancelled", "cancelled")


def _edit(screen: Screen, api: Moonraker, config: Path) -> None:
    """Add an output to the configuration in the front end's editor; wait until it is shown."""
    page, mainsail = screen.page, screen.name == "mainsail"
    screen.go("/config" if mainsail else "#/configure")
    press(page.get_by_text(config.name, exact=True).locator("visible=true").first)
    page.locator(".cm-content" if mainsail else ".monaco-editor").first.click()
    page.keyboard.press("Control+Home")
    added, before = ADDED.format(name=screen.name), config.read_text()
    lines = f"[{added}]\npin: {ADDED_PINS[screen.name]}\n"
    page.keyboard.insert_text(lines)
    press(screen.button("Save & Restart"))
    until(lambda: config.read_text() == lines + before, "the file as edited")
    until(lambda: api.state() == "ready" and added in api.objects(), "ready with what was added")
    press(page.locator("a[href='/']" if mainsail else "a[href$='#/']").first)
    page.get_by_text(f"From {screen.name}", exact=False).locator("visible=true").first.wait_for()


def _stop_and_restart(screen: Screen, api: Moonraker) -> None:
    page = screen.page
    if screen.name == "mainsail":
        press(screen.button("Emergency Stop"))
    else:
        press(page.locator("header button:visible").first)
    until(lambda: api.state() == "shutdown", "shutdown")
    page.get_by_text("emergency stop by a client").locator("visible=true").first.wait_for()
    press(screen.button("Firmware Restart"))
    until(lambda: api.state() == "ready", "ready after the stop")
    screen.field("Heater Bed").wait_for()


def _print_from_list(screen: Screen) -> None:
    page, mainsail = screen.page, screen.name == "mainsail"
    if mainsail:
        job = page.get_by_text(JOB_NAME).locator("visible=true").first
    else:  # the row of the list has a size; that of the history has none
        job = page.locator("tr:visible", has_text=re.compile(re.escape(JOB_NAME) + ".*kB", re.DOTALL)).first
    job.click(button="right")
    entry = _whole("Print start" if mainsail else "Print")
    press(page.locator(".v-list:visible").get_by_text(entry).locator("visible=true").first)
    if mainsail:  # it asks again
        press(page.locator(".v-dialog--active button:visible").filter(has_text=_whole("Print")).first)


def _job_button(screen: Screen, label: str, colour: str) -> Locator:
    """Return a button of the job: Fluidd's have a LABEL, Mainsail's only an icon in a COLOUR."""
    if screen.name == "mainsail":
        return screen.page.locator(f".v-card .v-toolbar button.{colour}--text:visible").first
    return screen.button(label)
