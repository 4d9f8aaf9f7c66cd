"""The live page in Chromium, used as a person would: by looking at it, clicking, typing."""

import re
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, WebSocketRoute

from tests.coordinator.web.browser import PATIENCE_MS, PHONE, Demo, Visitor, chromium, demo


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def machine(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Demo]:
    """One machine for all; each test leaves it ready, or printing."""
    del browser  # without one there is nothing to serve
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        with demo(folder) as served:
            yield served


@pytest.fixture
def visitor(browser: Browser, machine: Demo) -> Iterator[Visitor]:
    tab = Visitor(browser, machine.link()).visit()
    try:
        yield tab
        assert tab.wrong == []
    finally:
        tab.close()


@pytest.fixture
def printing(machine: Demo) -> None:
    """The machine prints, and may go on with it."""
    assert machine.ask("machine.state")["cause"] == ""
    state = machine.ask("job.status")["state"]
    if state == "paused":
        machine.ask("job.resume")
    elif state != "printing":
        machine.ask("job.start", file="part.gcode")


TABLE = {"axis": "x", "positions": [0, 100], "forward": [0, 0.01], "reverse": [-0.02, -0.01]}


def start_again(tab: Visitor) -> None:
    tab.page.get_by_role("button", name="Start the machine again").click()
    tab.until_text("state", "ready")


# --------------------------------------------------------------------------------------------- what it shows


def test_axis_tables_come_and_go(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    tab.until_text("state", "ready")
    tab.until("!document.getElementById('tables-part').hidden")
    tab.until("document.querySelector('[data-axis=x]').textContent.includes('no table')")
    machine.ask("table.send", **TABLE)
    tab.until("document.querySelector('[data-axis=x]').textContent.includes('2 of 2 ok, 2 in use')")
    tab.until(
        "document.querySelector('[data-axis=x] .pill').textContent === 'waits for homing and standstill'"
    )
    machine.ask("gcode.run", script="G28 X\nG1 X50 F6000")
    tab.until("document.querySelector('[data-axis=x] .pill').textContent === 'corrected'")
    tab.until("document.querySelector('[data-axis=x]').textContent.includes('5.0 µm')")
    tab.until("document.querySelector('[data-axis=x]').textContent.includes('forward')")
    machine.ask("table.remove", axis="x")
    tab.until("document.querySelector('[data-axis=x]').textContent.includes('no table')")


def test_a_print_from_start_to_cancel(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    tab.until_text("state", "ready")
    assert tab.text("about").startswith("canductor ")
    tab.page.get_by_role("button", name="Print").click()
    tab.until_text("state", "printing")
    places: set[str] = set()
    while len(places) < 3:  # the head moves on
        places.add(tab.text("pos-x"))
        tab.until(f"document.getElementById('pos-x').textContent !== '{tab.text('pos-x')}'")
    tab.until("document.getElementById('speed').textContent > '0.0'")
    before = tab.page.locator("#job-progress").evaluate("(progress) => progress.value")
    tab.until(f"document.getElementById('job-progress').value > {before}")
    assert tab.text("job-file") == "part.gcode" == tab.text("top-file")
    tab.until("document.getElementById('job-row').textContent.match(/^[1-9]/)")
    assert tab.page.get_by_role("button", name="Print", exact=True).is_disabled()

    tab.page.get_by_role("button", name="Pause").click()
    tab.until_text("state", "paused")
    assert machine.ask("job.status")["state"] == "paused"
    tab.until_text("speed", "0.0")
    tab.page.get_by_role("button", name="Resume").click()
    tab.until_text("state", "printing")

    tab.page.get_by_role("button", name="Cancel").click()
    assert machine.ask("job.status")["state"] == "printing", "one click alone cancels nothing"
    tab.page.get_by_role("button", name="Really cancel?").click()
    tab.until_text("job-state", "cancelled")
    tab.until_text("state", "ready")


@pytest.mark.usefixtures("printing")
def test_every_node_and_bus_is_there_with_its_figures(visitor: Visitor) -> None:
    tab = visitor
    cards = tab.page.locator(".node")
    tab.until("document.querySelectorAll('.node').length === 3")
    assert cards.locator("h3").all_text_contents() == ["mcu", "toolhead", "zboard"]
    tab.until("[...document.querySelectorAll('.node .pill')].every((e) => e.textContent === 'ready')")
    tab.until(  # every figure of the boards that print has a value
        "[...document.querySelectorAll('.node[data-node=mcu] dd, .node[data-node=toolhead] dd')]"
        ".every((e) => e.textContent !== '\\u2013')"
    )
    for name in ("Drift, ppm", "Offset gained, ms", "Queue", "Load, %", "Lead of commands, ms"):
        chart = tab.page.locator(".node[data-node=mcu]").get_by_role("img", name=re.compile(f"^{name}: "))
        chart.scroll_into_view_if_needed()
        tab.page.wait_for_function(TOLD, arg=chart.element_handle(), timeout=PATIENCE_MS)
        tab.page.wait_for_function(PAINTED, arg=chart.element_handle(), timeout=PATIENCE_MS)
    bus = tab.page.locator(".bus").filter(has=tab.page.get_by_role("heading", name="can0.bus"))
    load = bus.get_by_role("img")
    load.scroll_into_view_if_needed()
    tab.page.wait_for_function(PAINTED, arg=load.element_handle(), timeout=PATIENCE_MS)
    tab.until("document.querySelector('.bus .keys b').textContent > '0.0 %'")


TOLD = """(chart) => !chart.getAttribute("aria-label").includes("\u2013")"""
"""Whether a chart has a value: a dash stands for none."""
PAINTED = """(canvas) => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const seen = new Set();
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3]) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
  }
  return seen.size > 3;
}"""


@pytest.mark.usefixtures("printing")
def test_the_toolpath_from_above_and_turned(browser: Browser, machine: Demo, visitor: Visitor) -> None:
    tab = visitor
    tab.until("document.getElementById('speed').textContent > '0.0'")  # homed, and hot
    # Far enough that a travel is behind the head: its picture without it is another one.
    tab.until("Number(document.getElementById('job-row').textContent.replace(',', '')) > 16")
    canvas = tab.page.locator("#path")
    tab.page.wait_for_function(PAINTED, arg=canvas.element_handle(), timeout=PATIENCE_MS)
    tab.page.get_by_role("button", name="Pause").click()
    tab.until_text("state", "paused")

    def picture() -> str:
        tab.page.evaluate(
            "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        return str(canvas.evaluate("(c) => c.toDataURL()"))

    seen = [picture()]

    def changed() -> None:
        seen.append(picture())
        assert seen[-1] not in seen[:-1]

    box = canvas.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x + 120, y + 20, steps=4)
    tab.page.mouse.up()
    changed()  # turned
    canvas.focus()
    tab.page.keyboard.press("+")
    changed()  # closer
    tab.page.keyboard.press("ArrowLeft")
    changed()
    tab.page.keyboard.press("0")
    tab.page.get_by_role("button", name="Bed").click()
    changed()
    tab.page.get_by_role("button", name="2D").click()
    assert tab.page.get_by_role("button", name="2D").get_attribute("aria-pressed") == "true"
    changed()
    tab.page.get_by_role("button", name="Travels").click()
    changed()

    # A page that is opened now knows what was done before.
    late = Visitor(browser, machine.link())
    points: list[int] = []
    late.page.on("websocket", lambda s: s.on("framereceived", lambda data: points.extend(path_points(data))))
    late.visit()
    late.wait_for(lambda: bool(points), "the path")
    assert points[0] > 5
    late.close()
    tab.page.get_by_role("button", name="Resume").click()
    tab.until_text("state", "printing")


def path_points(data: str | bytes) -> list[int]:
    return [int(n) for n in re.findall(r'"generation":\d+,"first":0,"count":(\d+)', str(data))]


@pytest.mark.usefixtures("printing")
def test_console(visitor: Visitor) -> None:
    tab = visitor
    line = tab.page.get_by_label("G-code", exact=True)
    line.fill("M114")
    line.press("Enter")
    tab.page.locator("#log [data-kind=reply]", has_text="X:").last.wait_for()
    line.fill("G1 X9999")
    tab.page.get_by_role("button", name="Send").click()
    tab.page.locator("#log [data-kind=bad]").last.wait_for()
    line.press("ArrowUp")
    assert line.input_value() == "G1 X9999"
    line.press("ArrowUp")
    assert line.input_value() == "M114"
    assert tab.page.locator("#log [data-kind=sent]").all_text_contents()[-2].endswith("> M114")


def test_a_reply_is_shown_once(visitor: Visitor, machine: Demo) -> None:
    """It comes in the log, and with the answer."""
    tab = visitor
    if machine.ask("job.status")["state"] in ("printing", "paused"):
        machine.ask("job.cancel")
    tab.until_text("state", "ready")
    line = tab.page.get_by_label("G-code", exact=True)
    replies = tab.page.locator("#log [data-kind=reply]")
    before = replies.count()
    for number in (1, 2):
        line.fill("M114")
        line.press("Enter")
        tab.page.wait_for_function(
            "(n) => document.querySelectorAll('#log [data-kind=reply]').length >= n", arg=before + number
        )
    line.fill("G1 X9999")
    line.press("Enter")
    tab.page.locator("#log [data-kind=bad]").last.wait_for()
    assert replies.count() == before + 2


# --------------------------------------------------------------------------------------------------- stopping


@pytest.mark.usefixtures("printing")
def test_emergency_stop_stops(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    tab.until("document.getElementById('speed').textContent !== '0.0'")
    tab.page.get_by_role("button", name="Emergency stop").click()
    tab.until_text("state", "shutdown")
    told = machine.ask("machine.state")
    assert told == {"state": "shutdown", "cause": "emergency stop by 'the live page (127.0.0.1)'"}
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert "Emergency stop by 'the live page (127.0.0.1)'." in tab.text("stopped")
    tab.until_text("job-state", "stopped")
    assert tab.page.get_by_role("button", name="Print", exact=True).is_disabled()

    def confirmed() -> set[str]:
        told = machine.ask("state.get", fields=["machine.stop_confirmed_ms"])["values"]
        return set(told.get("machine.stop_confirmed_ms") or ())

    tab.wait_for(lambda: confirmed() == {"mcu", "toolhead", "zboard"}, "all confirmations")
    start_again(tab)
    assert machine.ask("machine.state")["state"] == "ready"


def test_the_stop_has_a_way_of_its_own(browser: Browser, machine: Demo) -> None:
    """The connection that carries everything else is stuck: nothing comes or goes. The stop gets through."""
    tab = Visitor(browser, machine.link())
    opened: list[WebSocketRoute] = []

    def route(socket: WebSocketRoute) -> None:
        opened.append(socket)
        if len(opened) == 2:  # and none that follows, should the stuck one be given up
            socket.connect_to_server()

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.goto(tab.url)
    tab.until("document.getElementById('stop').dataset.line === 'up'")
    assert tab.text("state") in ("connecting", "no connection")
    tab.page.keyboard.press("Control+Shift+.")
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert machine.ask("machine.state")["state"] == "shutdown"
    tab.close()
    other = Visitor(browser, machine.link()).visit()
    start_again(other)
    other.close()


def test_a_stop_that_could_not_be_sent_is_not_sent_much_later(browser: Browser, machine: Demo) -> None:
    """It says so at once, goes on trying for 10 s, and then leaves the next life of the machine alone."""
    tab = Visitor(browser, machine.link())
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
    tab.page.clock.install()
    tab.page.goto(tab.url)
    stop = tab.page.get_by_role("button", name="Emergency stop")
    stop.click()
    tab.page.get_by_text("NOT stopped: the machine cannot be reached").wait_for()
    tab.page.clock.fast_forward(11_000)
    way_is_open = True
    tab.until_text("state", "ready")
    tab.until("document.getElementById('stop').dataset.line === 'up'")
    assert "machine.emergency_stop" not in "".join(sent)
    assert machine.ask("machine.state")["state"] == "ready"

    way_is_open = False
    tab.page.reload()
    tab.page.get_by_label("Colours").focus()
    tab.page.keyboard.press("Tab")
    tab.page.keyboard.press("Enter")
    tab.page.get_by_text("NOT stopped: the machine cannot be reached").wait_for()
    way_is_open = True
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert machine.ask("machine.state")["state"] == "shutdown"
    start_again(tab)
    tab.close()


# ---------------------------------------------------------------------------------------- coming and going


def test_it_comes_back_when_the_coordinator_does(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    tab.until_text("state", "ready")
    machine.end()
    tab.until("!document.getElementById('offline').hidden")
    assert "No connection to the machine since" in tab.text("offline")
    tab.until_text("state", "no connection")
    assert tab.page.get_by_role("button", name="Print", exact=True).is_disabled()
    machine.start()
    tab.until("document.getElementById('offline').hidden")
    tab.until_text("state", "ready")
    tab.page.get_by_text("the coordinator was started again").wait_for()
    assert tab.page.get_by_role("button", name="Print", exact=True).is_enabled()
    # Nobody listens meanwhile, or whoever did just ends: the browser has many words for it.
    tab.wrong = [
        text
        for text in tab.wrong
        if "ERR_CONNECTION" not in text and not text.startswith("WebSocket connection to ")
    ]


def test_a_hidden_tab_is_told_nothing(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser, machine.link())
    sent: list[str] = []
    tab.page.on("websocket", lambda s: s.on("framesent", lambda data: sent.append(str(data))))

    def twice(method: str) -> None:
        tab.wait_for(lambda: [watches(text) for text in sent].count(method) == 2, f"{method} twice")

    tab.visit()
    twice("api.watch")
    sent.clear()
    tab.page.evaluate(HIDE, True)
    twice("api.unwatch")
    assert "motion.path" not in "".join(sent[-2:])
    sent.clear()
    tab.page.evaluate(HIDE, False)
    twice("api.watch")
    assert tab.wrong == []
    tab.close()


HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


def watches(text: str) -> str:
    found = re.search(r'"method":"(api\.(?:un)?watch)"', text)
    return found[1] if found else ""


# ------------------------------------------------------------------------------------------------------ frame


def test_nothing_is_asked_of_anybody_else(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser, machine.link()).visit()
    tab.until("document.querySelectorAll('.node').length === 3")
    tab.wait_for(lambda: sum(url.endswith("/socket") for url in tab.asked) >= 2, "two connections")
    hosts = {urlsplit(url).netloc for url in tab.asked}
    assert hosts == {f"127.0.0.1:{machine.port}"}
    assert len([url for url in tab.asked if url.endswith("/socket")]) == 2
    stopped = tab.page.evaluate(
        "() => fetch('https://example.com/').then(() => 'sent', (error) => String(error))"
    )
    assert "TypeError" in stopped
    tab.wait_for(lambda: any("Content Security Policy" in text for text in tab.wrong), "the refusal")
    tab.close()


def test_layout(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser, machine.link(), PHONE, touch=True).visit()
    tab.until("document.querySelectorAll('.node').length === 3")
    tab.until("[...document.querySelectorAll('.node dd')].every((e) => e.textContent !== '')")
    for width, height in (
        (390, 844),
        (844, 390),
        (320, 640),
        (768, 1024),
        (1024, 768),
        (1440, 900),
        (2560, 1300),
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
    assert tab.wrong == []
    tab.close()


OVERFLOWING = """() => [...document.querySelectorAll("main *, header *")]
  .filter((e) => !e.closest("#log, .unseen, svg") && e.clientWidth && e.scrollWidth > e.clientWidth + 1
    && !["ellipsis"].includes(getComputedStyle(e).textOverflow) && getComputedStyle(e).display !== "inline")
  .map((e) => `${e.tagName}#${e.id}.${e.className}: ${e.textContent.slice(0, 30)}`)"""


def test_everything_has_a_name(visitor: Visitor) -> None:
    nameless = visitor.page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, canvas")].filter((e) => {
          const labels = [...(e.labels ?? [])].map((l) => l.textContent).join("");
          const name = (e.getAttribute("aria-label") || labels || e.textContent).trim();
          return !name && !e.hidden && e.id !== "path";
        }).map((e) => e.outerHTML)"""
    )
    assert nameless == []
    assert visitor.page.locator("#path").get_attribute("aria-describedby") == "path-keys"


def test_colours_can_be_read(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser, machine.link(), color_scheme="light").visit()
    for colours in ("auto", "light", "dark", "night"):
        check_colours(tab, colours)
    tab.close()


def check_colours(tab: Visitor, colours: str) -> None:
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
    tab.page.reload()
    assert tab.page.evaluate("document.documentElement.dataset.colours") == shown, "it is remembered"


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, #rrggbb, as WCAG counts it."""

    def light(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    bright, dark = sorted((light(one), light(other)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)
