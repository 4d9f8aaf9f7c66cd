"""The live page in Chromium, used as a person would: by looking at it, clicking, typing.

One browser for all. What the page does by itself is tested in front of a server whose methods only take
notes; one test takes a machine of virtual nodes through a print.
"""

import asyncio
import re
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from typing import Final
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, FilePayload, Route, WebSocketRoute

from coordinator.ipc.protocol.methods import Scope
from tests.coordinator.ipc.served import TOKENS, tokens_file
from tests.coordinator.web.browser import PATIENCE_MS, Demo, Visitor, chromium, demo
from tests.coordinator.web.paged import LOOPBACK, Paged, paging
from tests.stages.loop_thread import in_thread

NOT_SIGNED_IN: Final = "status of 401"
FORBIDDEN: Final = "status of 403"
WEBSOCKET_REFUSED: Final = "WebSocket connection to "
UNREACHED: Final = "ERR_CONNECTION"
NOT_SENT: Final = "ERR_FAILED"
NO_METHOD: Final = "there is no method"

KEEP_SOCKETS: Final = """
globalThis.sockets = [];
globalThis.WebSocket = class extends WebSocket {
    constructor(url) {
        super(url);
        sockets.push(this);
    }
};
"""
"""Words that the browser, and the server without a machine, have for what is meant to fail."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def paged(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Paged]:
    """A server without a machine, on a thread of its own: the browser's driver has this one."""
    del browser  # without one there is nothing to serve
    folder = tmp_path_factory.mktemp("paged")

    @asynccontextmanager
    async def serve() -> AsyncIterator[Paged]:
        settings = replace(LOOPBACK, sessions=folder / "sessions.json")
        async with paging(folder, settings, tokens=tokens_file(folder)) as there:
            yield there

    with in_thread(serve) as served:
        yield served


def cut_all(paged: Paged) -> None:
    """End all connections of the page."""
    for connection in list(paged.page._clients):
        connection.transport.close()


@contextmanager
def held(paged: Paged) -> Iterator[None]:
    """Hold the server's loop inside."""
    over = threading.Event()
    paged.loop.call_soon_threadsafe(over.wait)
    try:
        yield
    finally:
        over.set()


def link(paged: Paged, scope: Scope = Scope.OPERATE) -> str:
    """Return a one-time link; the server's loop makes it."""

    async def make() -> str:
        return paged.page.new_link(scope)

    return asyncio.run_coroutine_threadsafe(make(), paged.loop).result()


@pytest.fixture(scope="module")
def machine(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Demo]:
    del browser
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        with demo(folder) as served:
            yield served


# ----------------------------------------------------------------------------------------------- getting in


def test_getting_in(browser: Browser, paged: Paged) -> None:
    """By a link that works once, or a token; what the browser may do is what that gives."""
    one_time = link(paged, Scope.WATCH)
    tab = Visitor(browser)
    tab.page.goto(f"{paged.at}/#{'x' * 43}")
    tab.page.get_by_text("This link or token is not known.").wait_for()
    assert tab.page.url == f"{paged.at}/", "the code is of no use any more"
    tab.page.get_by_label("Link or token").fill(one_time)
    tab.page.get_by_role("button", name="Let me in").click()
    tab.until("document.body.dataset.offline === 'false'")
    tab.until("document.getElementById('login').hidden")
    tab.until("document.getElementById('stop').getAttribute('aria-disabled') === 'true'")
    assert tab.page.get_by_role("button", name="Send").is_disabled()
    tab.page.locator("#stop").click(force=True)  # it looks as if one could not; who tries is told why
    tab.page.get_by_text("This browser may only watch: the stop was not sent.").wait_for()
    assert paged.served.stops == []

    tab.page.goto(one_time)  # from the history: it does no harm to who is in
    tab.until("document.body.dataset.offline === 'false'")
    second = tab.context.new_page()
    second.goto(link(paged, Scope.WATCH))  # signs this browser in again: its first session ends
    second.wait_for_function("() => document.body.dataset.offline === 'false'")
    second.close()
    tab.page.evaluate("document.body.dataset.offline = 'not known'")
    paged.loop.call_soon_threadsafe(cut_all, paged)
    tab.until("document.body.dataset.offline === 'false'")  # it comes back, with the key of the other tab
    (cookie,) = tab.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    assert not tab.page.evaluate("document.cookie")
    code = one_time.partition("#")[2]
    assert not [url for url in tab.asked if code in url.partition("#")[0] or TOKENS[Scope.WATCH] in url]

    other = Visitor(browser)
    other.page.goto(paged.at)
    other.page.get_by_text("Open the link that canductor prints").wait_for()
    other.page.get_by_label("Link or token").fill(TOKENS[Scope.OPERATE])
    other.page.get_by_label("Link or token").press("Enter")
    other.until("document.getElementById('stop').dataset.line === 'up'")
    other.page.locator("#stop").click()
    other.page.get_by_text("All nodes were told to stop").wait_for()
    assert set(paged.served.stops) == {"the live page (127.0.0.1, token of-operate)"}
    asyncio.run_coroutine_threadsafe(paged.page.sign_all_out(), paged.loop).result()
    for visitor in (tab, other):
        visitor.page.get_by_text("Open the link that canductor prints").wait_for()
    tab.close(FORBIDDEN, NOT_SIGNED_IN, WEBSOCKET_REFUSED, NO_METHOD)
    other.close(NOT_SIGNED_IN, WEBSOCKET_REFUSED, NO_METHOD)


def test_a_request_on_a_closing_connection_is_refused(browser: Browser, paged: Paged) -> None:
    """Between the begin of a close and its event a request fails at once; nothing is sent."""
    tab = Visitor(browser)
    tab.page.add_init_script(KEEP_SOCKETS)
    tab.page.goto(link(paged, Scope.WATCH))
    tab.until("document.body.dataset.offline === 'false'")
    code = tab.page.evaluate(
        """async () => {
            const {Link} = await import("/link.js");
            const link = new Link("a test");
            const up = new Promise((done) => link.addEventListener("up", done));
            link.connect(localStorage.getItem("canductor.key"));
            await up;
            globalThis.sockets.at(-1).close();
            return link.call("api.ping").then(() => "answered", (refusal) => refusal.code);
        }"""
    )
    assert code == "offline"
    tab.close(NO_METHOD)


# -------------------------------------------------------------------------------------------------- the stop


def test_the_stop_has_a_way_of_its_own(browser: Browser, paged: Paged) -> None:
    """The connection that carries everything else is stuck: nothing comes or goes. The stop gets through."""
    paged.served.stops.clear()
    tab = Visitor(browser)
    opened: list[WebSocketRoute] = []

    def route(socket: WebSocketRoute) -> None:
        opened.append(socket)
        if len(opened) == 2:  # and none that follows, should the stuck one be given up
            socket.connect_to_server()

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.goto(link(paged))
    tab.until("document.getElementById('stop').dataset.line === 'up'")
    assert tab.text("state") in ("connecting", "no connection")
    tab.page.keyboard.press("Control+Shift+.")
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert set(paged.served.stops) == {"the live page (127.0.0.1)"}
    tab.close(NO_METHOD)


def test_the_stop_needs_no_connection(browser: Browser, paged: Paged) -> None:
    """No WebSocket opens; then the program's loop is held as well, and the stop lane finds the request."""
    paged.served.stops.clear()
    tab = Visitor(browser)
    tab.page.route_web_socket(re.compile("/socket$"), lambda socket: socket.close())
    tab.page.goto(link(paged))
    stop = tab.page.get_by_role("button", name="Emergency stop")
    tab.until("localStorage.getItem('canductor.key') !== null")
    stop.click()
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert set(paged.served.stops) == {"the live page (127.0.0.1)"}

    lane, found = paged.served.server.stop_lane, list[str]()
    lane._stop = found.append
    with held(paged):
        paged.served.stops.clear()
        stop.click()

        def look() -> bool:
            lane.look()
            return bool(found)

        tab.wait_for(look, "the stop")
        assert found[0] == "the live page (127.0.0.1)"
        assert paged.served.stops == []
        tab.page.get_by_text("NOT confirmed yet").wait_for()
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    tab.close(NO_METHOD)


def test_a_stop_that_is_refused_says_so(browser: Browser, paged: Paged) -> None:
    """By a browser that may only watch, and does not know it yet."""
    paged.served.stops.clear()
    tab = Visitor(browser)
    tab.page.route_web_socket(re.compile("/socket$"), lambda socket: socket.close())
    tab.page.goto(link(paged, Scope.WATCH))
    tab.until("localStorage.getItem('canductor.key') !== null")
    tab.page.get_by_role("button", name="Emergency stop").click()
    tab.page.get_by_text("NOT stopped: machine.emergency_stop needs the scope operate").wait_for()
    assert paged.served.stops == []
    tab.close(NO_METHOD, FORBIDDEN)


def test_a_stop_before_the_browser_is_signed_in_is_sent_when_it_is(browser: Browser, paged: Paged) -> None:
    """It says that it was not sent; no connection is tried without a session, which would only be refused."""
    paged.served.stops.clear()
    tab = Visitor(browser)
    logins: list[Route] = []

    def keep(login: Route) -> None:
        logins.append(login)

    tab.page.route("**/login", keep)
    tab.page.goto(link(paged))
    tab.page.get_by_role("button", name="Emergency stop").click()
    tab.page.get_by_text("NOT stopped: this browser is not signed in").wait_for()
    assert not [url for url in tab.asked if url.endswith(("/socket", "/session"))]
    (login,) = logins
    login.continue_()
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert set(paged.served.stops) == {"the live page (127.0.0.1)"}
    tab.close(NO_METHOD, NOT_SIGNED_IN)


def test_a_stop_that_could_not_be_sent_is_not_sent_much_later(browser: Browser, paged: Paged) -> None:
    """It says so at once, goes on trying for 10 s, and then leaves the next life of the machine alone."""
    paged.served.stops.clear()
    tab = Visitor(browser)
    way_is_open = False
    sent: list[str] = []

    def route(socket: WebSocketRoute) -> None:
        if way_is_open:
            server = socket.connect_to_server()

            def pass_on(text: str | bytes) -> None:
                sent.append(str(text))
                server.send(text)

            socket.on_message(pass_on)
        else:
            socket.close()

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.route("**/emergency-stop", lambda asked: asked.continue_() if way_is_open else asked.abort())
    tab.page.clock.install()
    tab.page.goto(link(paged))
    stop = tab.page.get_by_role("button", name="Emergency stop")
    stop.click()
    tab.page.get_by_text("NOT stopped: the machine cannot be reached").wait_for()
    tab.page.clock.fast_forward(11_000)
    way_is_open = True
    tab.until("document.getElementById('stop').dataset.line === 'up'")
    assert "machine.emergency_stop" not in "".join(sent)

    way_is_open = False
    tab.page.reload()
    tab.page.get_by_label("Colours").focus()
    tab.page.keyboard.press("Tab")
    tab.page.keyboard.press("Enter")
    tab.page.get_by_text("NOT stopped: the machine cannot be reached").wait_for()
    assert paged.served.stops == []
    way_is_open = True
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert set(paged.served.stops) == {"the live page (127.0.0.1)"}
    tab.close(NO_METHOD, NOT_SENT)


# --------------------------------------------------------------------------------------------------- a print

BED_MM: Final = 250
TABLE: Final = {"axis": "x", "positions": [0, 100], "forward": [0, 0.01], "reverse": [-0.02, -0.01]}
TOLD: Final = """(chart) => !chart.getAttribute("aria-label").includes("\u2013")"""
"""Whether a chart has a value: a dash stands for none."""
PAINTED: Final = """(canvas) => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const seen = new Set();
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3]) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
  }
  return seen.size > 3;
}"""
HIDE: Final = """(hidden) => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


class Printing:
    """A person at the page of a machine; each method leaves the machine as its name says."""

    def __init__(self, tab: Visitor, machine: Demo) -> None:
        self.tab = tab
        self.machine = machine
        self.page = tab.page

    def shows_a_machine_that_is_ready(self) -> None:
        tab = self.tab
        tab.until_text("name", "demo")
        tab.until_text("state", "ready")
        assert tab.text("about").startswith("canductor ")
        tab.until("document.querySelectorAll('.node').length === 3")
        assert self.page.locator(".node h3").all_text_contents() == ["mcu", "toolhead", "zboard"]
        tab.until("[...document.querySelectorAll('.node .pill')].every((e) => e.textContent === 'ready')")
        self.page.get_by_label("File").select_option("part.gcode")
        tab.until("document.getElementById('job-picture').width === 32")  # the slicer's picture

    def sets_a_temperature(self) -> None:
        self.tab.until("document.querySelectorAll('.heat-row').length === 3")
        self.page.get_by_label("Target of bed, °C").fill("45")
        self.page.get_by_label("Target of bed, °C").press("Enter")
        self.tab.until("document.querySelector('[data-name=heater_bed]').textContent.includes('to 45 °C')")
        assert self.field("modules.heater_bed.target") == 45
        self.page.get_by_label("Target of extruder, °C").fill("999")
        self.page.get_by_label("Target of extruder, °C").press("Enter")
        self.tab.until("document.getElementById('heat-message').textContent.includes('999')")
        self.page.get_by_label("Speed of fan, %").fill("50")
        self.tab.until("document.querySelector('[data-name=fan]').textContent.includes('50 %')")
        self.page.wait_for_function(PAINTED, arg=self.page.locator("#heat-chart").element_handle())

    def field(self, path: str) -> object:
        return self.machine.ask("state.get", fields=[path])["values"][path]

    def takes_a_file(self) -> None:
        for text in ("G1 X1\n", "M118 ä\n" * 9_000):  # the second one in three parts, over the first one
            chosen = FilePayload(name="new.gcode", mimeType="text/plain", buffer=text.encode())
            self.page.locator("#upload-file").set_input_files(chosen)
            if len(text) > 9_000:
                self.page.get_by_role("button", name="Replace it").click()
            self.tab.until("document.getElementById('job-files').value === 'new.gcode'")
            self.tab.until_text("upload-message", "new.gcode is in the job folder")
            assert (self.machine.folder / "jobs" / "new.gcode").read_text(encoding="utf-8") == text
        self.page.get_by_label("File").select_option("part.gcode")

    def runs_a_macro(self) -> None:
        assert self.page.locator("#macro-buttons button").all_text_contents() == ["GREET"]
        self.page.get_by_role("button", name="GREET").click()
        self.page.locator("#log [data-kind=reply]").filter(has_text="good morning").wait_for()

    def takes_a_table(self) -> None:
        tab, x = self.tab, "document.querySelector('[data-axis=x]')"
        tab.until(f"{x}.textContent.includes('no table')")
        self.machine.ask("table.send", **TABLE)
        tab.until(f"{x}.textContent.includes('2 of 2 ok, 2 in use')")
        tab.until(f"{x}.querySelector('.pill').textContent === 'waits for homing and standstill'")

    def prints(self) -> None:
        tab = self.tab
        self.page.get_by_role("button", name="Print").click()
        tab.until_text("state", "printing")
        assert tab.text("job-file") == "part.gcode" == tab.text("top-file")
        assert self.page.get_by_role("button", name="Print", exact=True).is_disabled()
        for _ in range(2):  # the head moves on
            tab.until(f"document.getElementById('pos-x').textContent !== '{tab.text('pos-x')}'")
        tab.until("document.getElementById('speed').textContent > '0.0'")
        # Far enough that a travel is behind the head: its picture without it is another one.
        tab.until("Number(document.getElementById('job-row').textContent.replace(',', '')) > 16")
        before = self.page.locator("#job-progress").evaluate("(progress) => progress.value")
        tab.until(f"document.getElementById('job-progress').value > {before}")
        tab.until("document.querySelector('[data-axis=x] .pill').textContent === 'corrected'")
        tab.until("document.querySelector('[data-axis=x]').textContent.includes('forward')")

    def shows_figures_of_nodes_and_buses(self) -> None:
        tab = self.tab
        tab.until(  # every figure of the boards that print has a value
            "[...document.querySelectorAll('.node[data-node=mcu] dd, .node[data-node=toolhead] dd')]"
            ".every((e) => e.textContent !== '\\u2013')"
        )
        mcu = self.page.locator(".node[data-node=mcu]")
        for name in ("Drift, ppm", "Offset gained, ms", "Queue", "Load, %", "Lead of commands, ms"):
            chart = mcu.get_by_role("img", name=re.compile(f"^{name}: "))
            chart.scroll_into_view_if_needed()
            for condition in (TOLD, PAINTED):
                self.page.wait_for_function(condition, arg=chart.element_handle(), timeout=PATIENCE_MS)
        bus = self.page.locator(".bus").filter(has=self.page.get_by_role("heading", name="can0.bus"))
        load = bus.get_by_role("img")
        load.scroll_into_view_if_needed()
        self.page.wait_for_function(PAINTED, arg=load.element_handle(), timeout=PATIENCE_MS)
        tab.until("document.querySelector('.bus .keys b').textContent > '0.0 %'")

    def runs_typed_lines(self) -> None:
        line = self.page.get_by_label("G-code", exact=True)
        replies = self.page.locator("#log [data-kind=reply]")
        before = replies.count()
        for number in (1, 2):
            line.fill("M114")
            line.press("Enter")
            self.page.wait_for_function(
                "(n) => document.querySelectorAll('#log [data-kind=reply]').length >= n", arg=before + number
            )
        line.fill("G1 X9999")
        self.page.get_by_role("button", name="Send").click()
        self.page.locator("#log [data-kind=bad]").last.wait_for()
        assert replies.count() == before + 2, "it comes in the log, and with the answer, and is shown once"
        line.press("ArrowUp")
        assert line.input_value() == "G1 X9999"
        line.press("ArrowUp")
        assert line.input_value() == "M114"
        assert self.page.locator("#log [data-kind=sent]").all_text_contents()[-2].endswith("> M114")

    def pauses(self) -> None:
        self.page.get_by_role("button", name="Pause").click()
        self.tab.until_text("state", "paused")
        assert self.machine.ask("job.status")["state"] == "paused"
        self.tab.until_text("speed", "0.0")

    def turns_the_picture_of_the_path(self) -> None:
        canvas = self.page.locator("#path")
        canvas.scroll_into_view_if_needed()
        self.page.wait_for_function(PAINTED, arg=canvas.element_handle(), timeout=PATIENCE_MS)
        seen: list[str] = []

        def changed() -> None:
            frames = "requestAnimationFrame(() => requestAnimationFrame(done))"
            self.page.evaluate(f"() => new Promise((done) => {frames})")
            picture = str(canvas.evaluate("(c) => c.toDataURL()"))
            assert picture not in seen
            seen.append(picture)

        changed()
        box = canvas.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + 120, y + 20, steps=4)
        self.page.mouse.up()
        changed()  # turned
        canvas.focus()
        self.page.keyboard.press("+")
        changed()  # closer
        self.page.keyboard.press("ArrowLeft")
        changed()
        self.page.keyboard.press("0")
        self.page.get_by_role("button", name="Bed").click()
        changed()
        self.page.get_by_role("button", name="2D").click()
        assert self.page.get_by_role("button", name="2D").get_attribute("aria-pressed") == "true"
        changed()
        self.page.get_by_role("button", name="Travels").click()
        changed()

    def knows_what_was_done_before_it_was_opened(self) -> None:
        points: list[int] = []
        late = self.tab.context.new_page()
        late.on("websocket", lambda s: s.on("framereceived", lambda data: points.extend(path_points(data))))
        late.goto(f"http://127.0.0.1:{self.machine.port}/")
        self.tab.wait_for(lambda: bool(points), "the path")
        assert points[0] > 5
        late.close()

    def leaves_an_object_out(self) -> None:
        """It is touched on the toolpath, which opens the list at its entry."""
        tab, path = self.tab, self.page.locator("#path")
        self.page.get_by_role("button", name="Bed").click()
        self.page.get_by_role("button", name="2D").click()
        assert not self.page.get_by_text("LEFT", exact=True).is_visible()
        box = path.bounding_box()
        assert box is not None
        # From above the whole bed, BED_MM square, is fitted into the canvas with these margins (camera.js).
        scale = min((box["width"] - 48) / BED_MM, (box["height"] - 64) / BED_MM)
        middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
        away = (BED_MM / 2 - 30) * scale
        self.page.mouse.click(middle[0] - away, middle[1] + away)
        entry = self.page.locator("#object-list li").filter(has_text="LEFT")
        entry.get_by_role("button", name="Leave out").click()
        assert self.field("modules.exclude_object.excluded_objects") == []
        entry.get_by_role("button", name="Really?").click()
        tab.until("document.querySelector('[data-name=LEFT]').textContent.includes('left out')")
        assert self.field("modules.exclude_object.excluded_objects") == ["LEFT"]
        self.page.get_by_role("button", name="3D").click()

    def asks_about_heaters_after_a_cancel(self) -> None:
        self.page.get_by_text("The job was cancelled. Still heated: bed.").wait_for()
        self.page.get_by_role("button", name="Turn the heaters off").click()
        self.tab.until("document.querySelector('[data-name=heater_bed]').textContent.includes('off')")
        assert self.field("modules.heater_bed.target") == 0
        self.page.get_by_text("Earlier jobs").click()
        self.page.locator("#history-jobs li").filter(has_text="part.gcode").get_by_text(
            "cancelled"
        ).wait_for()

    def moves_by_hand(self) -> None:
        """X and Y are homed, Z is not."""
        up = self.page.get_by_role("button", name="Z +")
        assert up.is_disabled()
        assert up.get_attribute("title") == "home Z first"
        x = self.field("position.commanded")["x"]  # type: ignore[index]
        step, button = (1, "X +") if x < 100 else (-1, "X −")  # noqa: RUF001 (the page's minus)
        self.page.get_by_role("button", name="1", exact=True).click()
        self.page.get_by_role("button", name=button).click()
        self.tab.until_text("pos-x", f"{x + step:.2f}")
        self.page.get_by_role("button", name="Motors off").click()
        self.tab.until_text("homed", "none")

    def cancels_when_asked_twice(self) -> None:
        self.page.get_by_role("button", name="Resume").click()
        self.tab.until_text("state", "printing")
        self.page.get_by_role("button", name="Cancel").click()
        assert self.machine.ask("job.status")["state"] == "printing", "one click alone cancels nothing"
        self.page.get_by_role("button", name="Really cancel?").click()
        self.tab.until_text("job-state", "cancelled")
        self.tab.until_text("state", "ready")

    def stops_at_once(self) -> None:
        tab = self.tab
        self.page.get_by_role("button", name="Print").click()
        tab.until_text("state", "printing")
        tab.until("Number(document.getElementById('job-row').textContent) > 16")
        self.page.get_by_role("button", name="Emergency stop").click()
        tab.until_text("state", "shutdown")
        cause = "emergency stop by 'the live page (127.0.0.1)'"
        assert self.machine.ask("machine.state") == {"state": "shutdown", "cause": cause}
        self.page.get_by_text("All nodes were told to stop").wait_for()
        assert f"{cause[0].upper()}{cause[1:]}." in tab.text("stopped")
        tab.until_text("job-state", "stopped")
        assert self.page.get_by_role("button", name="Print", exact=True).is_disabled()

        def confirmed() -> set[str]:
            told = self.machine.ask("state.get", fields=["machine.stop_confirmed_ms"])["values"]
            return set(told.get("machine.stop_confirmed_ms") or ())

        tab.wait_for(lambda: confirmed() == {"mcu", "toolhead", "zboard"}, "all confirmations")
        self.page.get_by_role("button", name="Start the machine again").click()
        tab.until_text("state", "ready")
        assert self.machine.ask("machine.state")["state"] == "ready"

    def comes_back_when_the_coordinator_does(self) -> None:
        tab = self.tab
        self.machine.end()
        tab.until("!document.getElementById('offline').hidden")
        assert "No connection to the machine since" in tab.text("offline")
        tab.until_text("state", "no connection")
        assert self.page.get_by_role("button", name="Print", exact=True).is_disabled()
        self.machine.start()
        tab.until("document.getElementById('offline').hidden")
        tab.until_text("state", "ready")
        self.page.get_by_text("the coordinator was started again").wait_for()
        assert self.page.get_by_role("button", name="Print", exact=True).is_enabled()


def path_points(data: str | bytes) -> list[int]:
    return [int(n) for n in re.findall(r'"generation":\d+,"first":0,"count":(\d+)', str(data))]


@pytest.mark.timeout(600)  # a minute of the machine's time, and it shares the computer
def test_a_print_from_start_to_stop(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser)
    tab.page.goto(machine.printed_link)
    person = Printing(tab, machine)
    person.shows_a_machine_that_is_ready()
    person.takes_a_table()
    person.sets_a_temperature()
    person.takes_a_file()
    person.runs_a_macro()
    person.prints()
    person.shows_figures_of_nodes_and_buses()
    person.pauses()
    person.turns_the_picture_of_the_path()
    person.leaves_an_object_out()
    person.knows_what_was_done_before_it_was_opened()
    person.cancels_when_asked_twice()
    person.asks_about_heaters_after_a_cancel()
    person.runs_typed_lines()
    person.moves_by_hand()
    person.stops_at_once()
    person.comes_back_when_the_coordinator_does()
    hosts = {urlsplit(url).netloc for url in tab.asked}
    assert hosts == {f"127.0.0.1:{machine.port}"}, "nothing is asked of anybody else"
    # Nobody listens meanwhile, or whoever did just ends: the browser has many words for it.
    tab.close(UNREACHED, WEBSOCKET_REFUSED)


def test_a_file_chosen_while_an_upload_ends_stays_chosen(browser: Browser, machine: Demo) -> None:
    """The upload chooses its file when the list has come; who chose another one meanwhile keeps it."""
    tab = Visitor(browser)
    late: list[tuple[WebSocketRoute, str | bytes]] = []
    uploaded = asked = False

    def route(socket: WebSocketRoute) -> None:
        server = socket.connect_to_server()

        def ask(text: str | bytes) -> None:
            nonlocal asked
            asked = asked or (uploaded and '"job.list"' in str(text))
            server.send(text)

        socket.on_message(ask)
        server.on_message(lambda text: late.append((socket, text)) if asked else socket.send(text))

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.goto(machine.ask("page.link")["url"])
    files = tab.page.get_by_label("File")
    tab.until("document.querySelectorAll('#job-files option[value=\"part.gcode\"]').length === 1")
    uploaded = True
    arrived = FilePayload(name="arrived.gcode", mimeType="text/plain", buffer=b"G1 X1\n")
    tab.page.locator("#upload-file").set_input_files(arrived)
    tab.wait_for(lambda: asked, "the list's turn")
    files.select_option("part.gcode")
    asked = uploaded = False
    for socket, text in late:
        socket.send(text)
    tab.until("document.querySelectorAll('#job-files option[value=\"arrived.gcode\"]').length === 1")
    assert files.input_value() == "part.gcode"
    tab.close()


# --------------------------------------------------------------------------------------------- how it looks


def test_layout_names_and_colours(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser)
    sent: list[str] = []
    tab.page.on("websocket", lambda s: s.on("framesent", lambda data: sent.append(str(data))))
    tab.page.goto(machine.ask("page.link")["url"])
    tab.until("document.querySelectorAll('.node').length === 3")
    tab.until("[...document.querySelectorAll('.node dd')].every((e) => e.textContent !== '')")
    check_layout(tab)
    check_names(tab)
    for colours in ("auto", "light", "dark", "night"):
        shown = check_colours(tab, colours)
    tab.page.reload()
    assert tab.page.evaluate("document.documentElement.dataset.colours") == shown, "it is remembered"
    tab.until_text("state", "ready")
    check_hiding(tab, sent)
    stopped = tab.page.evaluate("fetch('https://example.com/').then(() => 'sent', (error) => String(error))")
    assert "TypeError" in stopped
    tab.wait_for(lambda: any("Content Security Policy" in text for text in tab.wrong), "the refusal")
    tab.close("Content Security Policy", "Fetch API cannot load")


def check_layout(tab: Visitor) -> None:
    for width, height in (
        (390, 844),
        (844, 390),
        (320, 640),
        (768, 1024),
        (1024, 768),
        (2560, 1300),
        (1440, 900),
    ):
        tab.page.set_viewport_size({"width": width, "height": height})
        assert tab.page.evaluate("document.documentElement.scrollWidth") <= width
        assert tab.page.evaluate(OVERFLOWING) == [], width
        for at in (0, 500, 5000):  # wherever one is, the stop is there, and large
            tab.page.evaluate("(y) => scrollTo(0, y)", at)
            box = tab.page.locator("#stop").bounding_box()
            assert box is not None
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= height
            assert box["x"] + box["width"] <= width
            assert box["height"] >= 44
            assert box["width"] >= 80
            middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
            assert tab.page.evaluate(
                "([x, y]) => document.elementFromPoint(x, y).closest('#stop') !== null", middle
            )


OVERFLOWING: Final = """() => [...document.querySelectorAll("main *, header *")]
  .filter((e) => !e.closest("#log, .unseen, svg") && e.clientWidth && e.scrollWidth > e.clientWidth + 1
    && !["ellipsis"].includes(getComputedStyle(e).textOverflow) && getComputedStyle(e).display !== "inline")
  .map((e) => `${e.tagName}#${e.id}.${e.className}: ${e.textContent.slice(0, 30)}`)"""


def check_names(tab: Visitor) -> None:
    nameless = tab.page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, canvas")].filter((e) => {
          const labels = [...(e.labels ?? [])].map((l) => l.textContent).join("");
          const name = (e.getAttribute("aria-label") || labels || e.textContent).trim();
          return !name && !e.hidden && e.id !== "path";
        }).map((e) => e.outerHTML)"""
    )
    assert nameless == []
    assert tab.page.locator("#path").get_attribute("aria-describedby") == "path-keys"


def check_hiding(tab: Visitor, sent: list[str]) -> None:
    """A hidden tab is told nothing until it is seen again."""

    def twice(method: str) -> None:
        tab.wait_for(lambda: [watches(text) for text in sent].count(method) == 2, f"{method} twice")

    sent.clear()
    tab.page.evaluate(HIDE, True)
    twice("api.unwatch")
    assert "motion.path" not in "".join(sent[-2:])
    sent.clear()
    tab.page.evaluate(HIDE, False)
    twice("api.watch")


def watches(text: str) -> str:
    found = re.search(r'"method":"(api\.(?:un)?watch)"', text)
    return found[1] if found else ""


def check_colours(tab: Visitor, colours: str) -> str:
    """Check the contrasts of COLOURS; return which are shown."""
    tab.page.get_by_label("Colours").select_option(colours)
    shown = "light" if colours == "auto" else colours
    assert tab.page.evaluate("document.documentElement.dataset.colours") == shown
    names = ["card", "sunk", "ground", "text", "dim", "ok", "warn", "bad", "main"]
    names += ["stop", "on-stop", "on-main", "edge"]
    read = """(names) => {
      const style = getComputedStyle(document.documentElement);
      return names.map((name) => style.getPropertyValue("--" + name).trim());
    }"""
    colour = dict(zip(names, tab.page.evaluate(read, names), strict=True))
    for text in ("text", "dim", "ok", "warn", "bad", "main"):
        for ground in ("card", "sunk", "ground"):
            assert contrast(colour[text], colour[ground]) >= 4.5, (text, ground)
    assert contrast(colour["on-stop"], colour["stop"]) >= 4.5
    assert contrast(colour["on-main"], colour["main"]) >= 4.5
    assert contrast(colour["edge"], colour["card"]) >= 3
    return shown


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, #rrggbb, as WCAG counts it."""

    def light(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    bright, dark = sorted((light(one), light(other)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)
