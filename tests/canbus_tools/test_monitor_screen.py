"""The monitor's screen, with keys pressed and a real node talking."""

import asyncio
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from textual.widgets import DataTable, Input, RichLog, Static

from canbus_tools.bus_load import LoadMeter
from canbus_tools.bus_watch import BusWatch
from canbus_tools.decoder import BusDecoder
from canbus_tools.filters import Filter
from canbus_tools.frame import Frame
from canbus_tools.frame_queue import FrameQueue
from canbus_tools.monitor import MonitorOptions
from canbus_tools.monitor_screen import KEPT, LINES_AT_ONCE, LOG_LINES, MonitorScreen
from canbus_tools.monitor_text import read_filter
from canbus_tools.open_bus import open_bus
from canbus_tools.talk import NodeTalk
from coordinator.cli import main
from nodes.option_values import UsageError
from tests.canbus_tools.stage import BOOT, MAIN, MAIN_ID, PATIENCE_S, Place, Stage, set_nodeid

if TYPE_CHECKING:
    from textual.pilot import Pilot

SMALL, WIDE = (80, 24), (160, 40)


@pytest.fixture
def node(place: Place) -> Iterator[Place]:
    """One node of our firmware with id 4."""
    with place.start_node("mainboard", MAIN) as process:
        process.wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, MAIN, MAIN_ID)
        yield place


class Stand:
    """The screen with a way to the node."""

    def __init__(self, screen: MonitorScreen, pilot: "Pilot[None]", talk: NodeTalk) -> None:
        self.screen = screen
        self.pilot = pilot
        self.talk = talk

    def log(self) -> list[str]:
        return [line.text.rstrip() for line in self.screen.query_one("#log", RichLog).lines]

    def text(self, widget: str) -> str:
        return str(self.screen.query_one(widget, Static).render())

    def row(self, nodeid: int) -> dict[str, str]:
        table = self.screen.query_one("#nodes", DataTable)
        cells = table.get_row(str(nodeid))
        return {str(key.value): str(cell) for key, cell in zip(table.columns, cells, strict=True)}

    async def until(self, told: Callable[[], bool]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not told():
            if time.monotonic() > end_s:
                pytest.fail("\n".join([self.text("#state"), self.text("#load"), *self.log()]))
            await self.pilot.pause(0.01)


def on_screen(
    place: Place, size: tuple[int, int], test: Callable[[Stand], Awaitable[None]], nodes: Filter | None = None
) -> None:
    @asynccontextmanager
    async def stand(queue: FrameQueue) -> AsyncIterator[Stand]:
        watch = BusWatch(BusDecoder(), LoadMeter(1_000_000), asyncio.get_running_loop().time())
        options = MonitorOptions(
            bus=place.options,
            bitrate=1_000_000,
            bitrate_is_known=True,
            filter_=nodes or Filter(),
            dictionaries={},
        )
        screen = MonitorScreen(options, watch, queue)
        async with (
            screen.run_test(size=size) as pilot,
            NodeTalk.open(place.options, MAIN_ID, force=True) as talk,
        ):
            yield Stand(screen, pilot, talk)

    async def run() -> None:
        with FrameQueue(open_bus(place.options), "bus") as queue:
            async with stand(queue) as ready:
                await test(ready)

    asyncio.run(run())


def test_traffic_is_shown_by_names(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.talk.ask("get_canbus_id", "canbus_id")
        await stand.until(lambda: any("canbus_id canbus_uuid" in line for line in stand.log()))
        # More than one when a busy computer had the question asked again.
        line, *_ = [line for line in stand.log() if "canbus_id canbus_uuid" in line]
        assert line.endswith(f"4 ← canbus_id canbus_uuid={MAIN} canbus_nodeid=4")
        assert any(line.endswith("4 → get_canbus_id") for line in stand.log())
        assert not any("ack next" in line for line in stand.log())
        await stand.until(lambda: stand.row(MAIN_ID)["mcu"] == "virtual-mainboard")
        row = stand.row(MAIN_ID)
        assert row["node"] == "4"
        assert int(row["repeated"]) <= stand.talk.stats.blocks_repeated  # a busy computer may be late to ack
        assert int(row["bad"]) < 64  # it may have begun to listen in the middle of a block
        assert float(row["rtt"]) > 0
        assert "uuid" not in row  # no room at 80 columns
        assert "frames/s" in stand.text("#load")
        assert "0 dropped" in stand.text("#load")
        assert all(len(line) <= SMALL[0] - 2 for line in stand.text("#load").splitlines())

    on_screen(node, SMALL, test)


def test_a_long_message_is_shown_whole(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.talk.ask("get_canbus_status", "canbus_status")
        await stand.until(lambda: any("canbus_status rx_error" in line for line in stand.log()))
        lines = stand.log()
        at, *_ = [n for n, line in enumerate(lines) if "canbus_status rx_error" in line]
        assert lines[at + 1].strip() == "canbus_bus_state=active"
        assert lines[at + 1].index("canbus") == lines[at].index("canbus")
        await stand.pilot.resize_terminal(*WIDE)
        await stand.until(
            lambda: any("rx_error" in line and line.endswith("=active") for line in stand.log())
        )

    on_screen(node, SMALL, test)


def test_a_wide_screen_has_more_columns(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.talk.ask("get_canbus_id", "canbus_id")
        await stand.until(lambda: MAIN_ID in stand.screen._watch.decoder.nodes)
        await stand.until(lambda: stand.row(MAIN_ID)["uuid"] == str(MAIN))
        await stand.pilot.resize_terminal(*SMALL)
        await stand.until(lambda: "uuid" not in stand.row(MAIN_ID))

    on_screen(node, WIDE, test)


def test_pause_filter_acks_and_clear(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.talk.ask("get_uptime", "uptime")
        await stand.until(lambda: any("uptime high" in line for line in stand.log()))
        await stand.pilot.press("space")
        before = stand.log()
        await stand.talk.ask("get_canbus_status", "canbus_status")
        await stand.until(
            lambda: "PAUSED" in stand.text("#state") and ", 0 since" not in stand.text("#state")
        )
        assert stand.log() == before
        await stand.pilot.press("space")
        await stand.until(lambda: any("canbus_status rx_error" in line for line in stand.log()))

        await stand.pilot.press("a")
        assert any("ack next=" in line for line in stand.log())
        await stand.pilot.press("a")
        assert not any("ack next=" in line for line in stand.log())

        await stand.pilot.press("slash", *"dir=from uptime", "enter")
        assert stand.log()
        assert all("← uptime" in line for line in stand.log())
        await stand.until(lambda: "filter: dir=from uptime" in stand.text("#state"))
        assert not stand.screen.query_one("#filter", Input).has_class("asked")

        await stand.pilot.press("c")
        assert stand.log() == []
        await stand.talk.ask("get_uptime", "uptime")
        await stand.until(lambda: len(stand.log()) > 0)
        assert all("← uptime" in line for line in stand.log())

    on_screen(node, SMALL, test)


def test_a_bad_filter_is_told_and_changes_nothing(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.pilot.press("slash", *"colour=red", "enter")
        assert [n.message for n in stand.screen._notifications] == [
            "'colour=red' is no filter; write node=4 kind=nak dir=to (or from) get_*"
        ]
        assert "filter: none" in stand.text("#state")
        await stand.pilot.press("escape")
        assert not stand.screen.query_one("#filter", Input).has_class("asked")

    on_screen(node, SMALL, test)


def test_memory_is_bounded_and_what_is_left_out_is_said(node: Place) -> None:
    async def test(stand: Stand) -> None:
        many = [Frame(n / 8000, 0x700, b"12345678") for n in range(KEPT + 5000)]
        screen = stand.screen
        screen._queue._waiting.extend(many)
        screen.refresh_now()
        assert len(screen._said) == KEPT
        assert screen.shown >= LINES_AT_ONCE
        await stand.until(lambda: any("more, too fast to show" in line for line in stand.log()))
        for _ in range(LOG_LINES // LINES_AT_ONCE + 2):
            screen._queue._waiting.extend(many[:100])
            screen.refresh_now()
        await stand.pilot.pause()
        assert len(stand.log()) <= LOG_LINES

    on_screen(node, SMALL, test)


def test_a_timer_that_fires_when_the_widgets_are_gone(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.screen.screen.remove_children()
        stand.screen.refresh_now()
        assert stand.screen.failure is None

    on_screen(node, SMALL, test)


def test_quit(node: Place) -> None:
    async def test(stand: Stand) -> None:
        await stand.pilot.press("q")
        assert stand.screen._exit
        assert stand.screen.failure is None

    on_screen(node, SMALL, test)


class Terminal:
    """A terminal of 80x24 with a shell, played by tmux."""

    def __init__(self, folder: Path) -> None:
        self._tmux = ("tmux", "-L", f"canductor-{os.getpid()}", "-f", "/dev/null")
        self._environment = {**os.environ, "TMUX_TMPDIR": str(folder), "PS1": "$ ", "TERM": "xterm-256color"}
        self("new-session", "-d", "-s", "test", "-x", "80", "-y", "24", "sh")

    def __call__(self, *words: str) -> str:
        command = (*self._tmux, *words)
        done = subprocess.run(
            command, env=self._environment, capture_output=True, text=True, timeout=PATIENCE_S, check=True
        )
        return done.stdout

    def type(self, *keys: str) -> None:
        self("send-keys", "-t", "test", *keys)

    def until(self, meanwhile: Callable[[], object], *wanted: str) -> str:
        """Return the screen once all WANTED is on it."""
        end_s = time.monotonic() + PATIENCE_S
        shown = ""
        while not all(words in shown for words in wanted):
            assert time.monotonic() < end_s, f"{wanted} did not come:\n{shown}"
            meanwhile()
            shown = self("capture-pane", "-p", "-t", "test")
        return shown


@pytest.mark.skipif(shutil.which("tmux") is None, reason="tmux is not installed")
@pytest.mark.parametrize("ending", ["q", "SIGTERM"])
def test_in_a_terminal_which_is_left_as_it_was(stage: Stage, tmp_path: Path, ending: str) -> None:
    place = stage.place
    terminal = Terminal(tmp_path)
    try:
        entry = "import sys; from coordinator.entry import main; sys.exit(main())"
        words = shlex.join([sys.executable, "-c", entry, "can", "monitor", *place.words, "-b", "1000000"])
        (tmp_path / "run").write_text(f"echo $$ > {tmp_path}/pid; exec {words}\n")
        terminal.type("-l", f"sh {tmp_path}/run; echo ended $?")
        terminal.type("Enter")

        def talk() -> None:
            asyncio.run(_ask(place))

        lines = terminal.until(talk, "uptime high=", " q Quit ").splitlines()
        assert lines[0].startswith(" load ")
        assert lines[2].split()[:2] == ["node", "MCU"]
        assert lines[-1].split()[:2] == ["q", "Quit"]
        shown = terminal.until(lambda: main(["can", "query", *place.words]), f"need_nodeid uuid={BOOT}")
        assert any(line.split()[:2] == [str(MAIN_ID), "virtual-mainboard"] for line in shown.splitlines())
        assert " ← need_nodeid uuid=" in shown
        assert " → query_unassigned" in shown
        if ending == "q":
            terminal.type("q")
        else:
            os.kill(int((tmp_path / "pid").read_text()), signal.SIGTERM)
        left = terminal.until(lambda: None, "\nended ")
        assert f"\nended {0 if ending == 'q' else 143}" in left
        assert " load " not in left
    finally:
        terminal("kill-server")


async def _ask(place: Place) -> None:
    async with NodeTalk.open(place.options, MAIN_ID, force=True) as talk:
        await talk.ask("get_uptime", "uptime")


@pytest.mark.parametrize("text", ["node=0", "node=x", "kind=foo", "dir=up", "a=b"])
def test_filters_that_are_none(text: str) -> None:
    with pytest.raises(UsageError):
        read_filter(text)
