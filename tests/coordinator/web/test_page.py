"""The live page in Chromium, used as a person would: by looking at it, clicking, typing."""

import re
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, ViewportSize, WebSocketRoute

from tests.coordinator.web.browser import DESKTOP, PATIENCE_MS, PHONE, Demo, Visitor, chromium, demo


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def machine(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Demo]:
    """One machine for all; each test leaves it ready and at rest."""
    del browser  # without one there is nothing to serve
    with demo(tmp_path_factory.mktemp("page")) as served:
        yield served


@pytest.fixture
def visitor(browser: Browser, machine: Demo) -> Iterator[Visitor]:
    tab = Visitor(browser, machine.url).visit()
    try:
        yield tab
        assert tab.wrong == []
    finally:
        tab.close()


def begin_print(tab: Visitor) -> None:
    tab.page.get_by_role("button", name="Print").click()
    tab.until_text("state", "printing")


def end_print(tab: Visitor) -> None:
    """Cancel, which a print asks for twice, and wait for rest."""
    tab.page.get_by_role("button", name="Cancel").click()
    tab.page.get_by_role("button", name="Really cancel?").click()
    tab.until_text("job-state", "cancelled")
    tab.until_text("state", "ready")


def start_again(tab: Visitor) -> None:
    tab.page.get_by_role("button", name="Start the machine again").click()
    tab.until_text("state", "ready")


# --------------------------------------------------------------------------------------------- what it shows


def test_a_print_from_start_to_cancel(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    tab.until_text("state", "ready")
    assert tab.text("about").startswith("canductor ")
    begin_print(tab)
    places = set()
    for _ in range(4):  # the head moves on: each time another place
        places.add((tab.text("pos-x"), tab.text("pos-y")))
        tab.until(f"document.getElementById('pos-x').textContent !== '{tab.text('pos-x')}'")
    assert len(places) >= 3
    tab.until("document.getElementById('speed').textContent > '0.0'")
    progress = tab.page.locator("#job-progress")
    before = float(progress.get_attribute("value") or progress.evaluate("e => e.value"))
    tab.until(f"document.getElementById('job-progress').value > {before} + 0.005")
    assert tab.text("job-file") == "part.gcode" == tab.text("top-file")
    tab.until("document.getElementById('job-row').textContent.match(/^[1-9]/)")

    assert tab.page.get_by_role("button", name="Print", exact=True).is_disabled()
    tab.page.get_by_role("button", name="Pause").click()
    tab.until_text("state", "paused")
    assert machine.ask("job.status")["state"] == "paused"
    assert tab.text("speed") == "0.0"
    tab.page.get_by_role("button", name="Resume").click()
    tab.until_text("state", "printing")

    tab.page.get_by_role("button", name="Cancel").click()
    assert machine.ask("job.status")["state"] == "printing", "one click alone cancels nothing"
    tab.page.get_by_role("button", name="Really cancel?").click()
    tab.until_text("job-state", "cancelled")
    tab.until_text("state", "ready")


def test_every_node_and_bus_is_there_with_its_figures(visitor: Visitor) -> None:
    tab = visitor
    begin_print(tab)
    cards = tab.page.locator(".node")
    tab.until("document.querySelectorAll('.node').length === 3")
    assert cards.locator("h3").all_text_contents() == ["mcu", "toolhead", "zboard"]
    assert set(cards.locator(".pill").all_text_contents()) == {"ready"}
    tab.until(  # every figure of the boards that print has a value
        "[...document.querySelectorAll('.node[data-node=mcu] dd, .node[data-node=toolhead] dd')]"
        ".every((e) => e.textContent !== '\\u2013')"
    )
    for name in ("Drift, ppm", "Offset gained, ms", "Queue", "Load, %", "Lead of commands, ms"):
        chart = tab.page.locator(".node[data-node=mcu]").get_by_role("img", name=re.compile(f"^{name}: "))
        chart.scroll_into_view_if_needed()
        assert NONE not in (chart.get_attribute("aria-label") or "")
        tab.page.wait_for_function(PAINTED, arg=chart.element_handle(), timeout=PATIENCE_MS)
    bus = tab.page.locator(".bus").filter(has=tab.page.get_by_role("heading", name="can0.bus"))
    load = bus.get_by_role("img")
    load.scroll_into_view_if_needed()
    tab.page.wait_for_function(PAINTED, arg=load.element_handle(), timeout=PATIENCE_MS)
    tab.until("document.querySelector('.bus .keys b').textContent > '0.0 %'")
    tab.page.locator("#path").scroll_into_view_if_needed()
    end_print(tab)


NONE = "\u2013"
"""What the page shows where there is no value."""
PAINTED = """(canvas) => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const seen = new Set();
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3]) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
  }
  return seen.size > 3;
}"""


def test_the_toolpath_from_above_and_turned(visitor: Visitor) -> None:
    tab = visitor
    begin_print(tab)
    tab.until("document.getElementById('job-row').textContent.replace(',', '') > '100'")
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
    end_print(tab)


def test_a_page_opened_in_the_middle_knows_the_path_so_far(
    browser: Browser, machine: Demo, visitor: Visitor
) -> None:
    begin_print(visitor)
    visitor.until("document.getElementById('job-row').textContent.replace(',', '') > '100'")
    late = Visitor(browser, machine.url)
    points: list[int] = []
    late.page.on("websocket", lambda s: s.on("framereceived", lambda data: points.extend(path_points(data))))
    late.visit()
    late.until_text("state", "printing")
    while not points:
        late.page.wait_for_timeout(50)
    assert points[0] > 20
    late.close()
    end_print(visitor)


def path_points(data: str | bytes) -> list[int]:
    return [int(n) for n in re.findall(r'"generation":\d+,"first":0,"count":(\d+)', str(data))]


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


# --------------------------------------------------------------------------------------------------- stopping


def test_emergency_stop_stops(visitor: Visitor, machine: Demo) -> None:
    tab = visitor
    begin_print(tab)
    tab.until("document.getElementById('speed').textContent !== '0.0'")
    tab.page.get_by_role("button", name="Emergency stop").click()
    tab.until_text("state", "shutdown")
    told = machine.ask("machine.state")
    assert told == {"state": "shutdown", "cause": "emergency stop by 'the live page (127.0.0.1)'"}
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert "Emergency stop by 'the live page (127.0.0.1)'." in tab.text("stopped")
    tab.until_text("job-state", "stopped")
    assert tab.page.get_by_role("button", name="Print", exact=True).is_disabled()
    told = machine.ask("state.get", fields=["machine.stop_confirmed_ms"])["values"]
    assert set(told["machine.stop_confirmed_ms"]) == {"mcu", "toolhead", "zboard"}
    start_again(tab)
    assert machine.ask("machine.state")["state"] == "ready"


def test_the_stop_by_keyboard(visitor: Visitor, machine: Demo) -> None:
    visitor.page.keyboard.press("Control+Shift+.")
    visitor.until_text("state", "shutdown")
    assert machine.ask("machine.state")["state"] == "shutdown"
    start_again(visitor)
    visitor.page.get_by_label("Colours").focus()
    visitor.page.keyboard.press("Tab")
    visitor.page.keyboard.press("Enter")
    visitor.until_text("state", "shutdown")
    start_again(visitor)


def test_the_stop_has_a_way_of_its_own(browser: Browser, machine: Demo) -> None:
    """The connection that carries everything else is stuck: nothing comes or goes. The stop gets through."""
    tab = Visitor(browser, machine.url)
    opened: list[WebSocketRoute] = []

    def route(socket: WebSocketRoute) -> None:
        opened.append(socket)
        if len(opened) > 1:
            socket.connect_to_server()

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.goto(machine.url)
    tab.until("document.getElementById('stop').dataset.line === 'up'")
    assert tab.text("state") == "connecting"
    tab.page.get_by_role("button", name="Emergency stop").click()
    tab.page.get_by_text("All nodes were told to stop").wait_for()
    assert machine.ask("machine.state")["state"] == "shutdown"
    tab.close()
    machine.ask("machine.restart")
    other = Visitor(browser, machine.url).visit()
    other.until_text("state", "ready")
    other.close()


def test_a_stop_that_could_not_be_sent_is_not_sent_much_later(browser: Browser, machine: Demo) -> None:
    """It says so at once, goes on trying for 10 s, and then leaves the next life of the machine alone."""
    tab = Visitor(browser, machine.url)
    way_is_open, sent = False, []

    def route(socket: WebSocketRoute) -> None:
        if way_is_open:
            server = socket.connect_to_server()
            socket.on_message(lambda text: (sent.append(str(text)), server.send(text)))
        else:
            socket.close()

    tab.page.route_web_socket(re.compile("/socket$"), route)
    tab.page.clock.install()
    tab.page.goto(machine.url)
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
    stop.click()
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
    begin_print(tab)
    end_print(tab)
    tab.wrong = [text for text in tab.wrong if "ERR_CONNECTION_REFUSED" not in text]


def test_a_hidden_tab_is_told_nothing(browser: Browser, machine: Demo) -> None:
    tab = Visitor(browser, machine.url)
    sent: list[str] = []
    tab.page.on("websocket", lambda s: s.on("framesent", lambda data: sent.append(str(data))))
    tab.visit()
    assert [watches(text) for text in sent].count("api.watch") == 2
    sent.clear()
    tab.page.evaluate(HIDE, True)
    while [watches(text) for text in sent].count("api.unwatch") < 2:
        tab.page.wait_for_timeout(50)
    assert "motion.path" not in "".join(sent[-2:])
    sent.clear()
    tab.page.evaluate(HIDE, False)
    while [watches(text) for text in sent].count("api.watch") < 2:
        tab.page.wait_for_timeout(50)
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
    tab = Visitor(browser, machine.url).visit()
    tab.until("document.querySelectorAll('.node').length === 3")
    hosts = {urlsplit(url).netloc for url in tab.asked}
    assert hosts == {f"127.0.0.1:{machine.port}"}
    assert len([url for url in tab.asked if url.endswith("/socket")]) == 2
    stopped = tab.page.evaluate(
        "() => fetch('https://example.com/').then(() => 'sent', (error) => String(error))"
    )
    assert "TypeError" in stopped
    assert any("Content Security Policy" in text for text in tab.wrong)
    tab.close()


@pytest.mark.parametrize(
    "viewport",
    [
        DESKTOP,
        PHONE,
        ViewportSize(width=844, height=390),
        ViewportSize(width=1024, height=768),
        ViewportSize(width=320, height=640),
    ],
    ids=lambda v: f"{v['width']}x{v['height']}",
)
def test_layout(browser: Browser, machine: Demo, viewport: ViewportSize) -> None:
    tab = Visitor(browser, machine.url, viewport, touch=viewport["width"] < 500).visit()
    tab.until("document.querySelectorAll('.node').length === 3")
    tab.until("[...document.querySelectorAll('.node dd')].every((e) => e.textContent !== '')")
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]
    assert tab.page.evaluate(OVERFLOWING) == []
    for at in (0, 500, 5000):  # wherever one is, the stop is there, and large
        tab.page.evaluate("(y) => scrollTo(0, y)", at)
        box = tab.page.locator("#stop").bounding_box()
        assert box is not None
        assert box["y"] >= 0
        assert box["y"] + box["height"] <= viewport["height"]
        assert box["x"] + box["width"] <= viewport["width"]
        assert box["height"] >= 44
        assert box["width"] >= 80
        assert tab.page.evaluate(
            "([x, y]) => document.elementFromPoint(x, y).closest('#stop') !== null",
            [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2],
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


@pytest.mark.parametrize("colours", ["auto", "light", "dark", "night"])
def test_colours_can_be_read(browser: Browser, machine: Demo, colours: str) -> None:
    tab = Visitor(browser, machine.url, color_scheme="light").visit()
    tab.page.get_by_label("Colours").select_option(colours)
    shown = "light" if colours == "auto" else colours
    assert tab.page.evaluate("document.documentElement.dataset.colours") == shown
    names = [
        "card",
        "sunk",
        "ground",
        "text",
        "dim",
        "ok",
        "warn",
        "bad",
        "main",
        "stop",
        "on-stop",
        "on-main",
        "edge",
    ]
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
    tab.close()


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, #rrggbb, as WCAG counts it."""

    def light(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    bright, dark = sorted((light(one), light(other)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)
