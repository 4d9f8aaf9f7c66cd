"""The monitor's screen, with keys pressed while a node and its host talk."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING

import pytest
from textual.widgets import DataTable, Input, RichLog, Static

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.bus.computer import now_s
from canbus_tools.monitor.bus_watch import BusWatch, MonitorOptions
from canbus_tools.monitor.screen import KEPT, LINES_AT_ONCE, LOG_LINES, MonitorScreen
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.filters import read_filter
from canbus_tools.protocol.frame import Frame
from nodes.support.option_values import UsageError
from tests.stages.can_stage import MAIN, MAIN_ID, CanStage, conversation_parts
from tests.stages.simulated_computer import WireListener

if TYPE_CHECKING:
    from textual.pilot import Pilot

SMALL, WIDE = (80, 24), (160, 40)


class Stand:
    """The screen, and what it hears."""

    def __init__(
        self, stage: CanStage, listener: WireListener, screen: MonitorScreen, pilot: "Pilot[None]"
    ) -> None:
        self.listener = listener
        self.screen = screen
        self.pilot = pilot
        self._stage = stage

    async def hear(self, part: int) -> None:
        """Have it hear a part of a host's conversation with the node, and show it."""
        frames = conversation_parts()[part]
        self._stage.replay(frames, after_s=0.5)
        self._stage.world.run_for(1.0 + frames[-1].time_s - frames[0].time_s)
        await self.refresh()

    async def refresh(self) -> None:
        """Let it take what came, and draw."""
        self.screen.refresh_now()
        await self.pilot.pause()

    async def press(self, *keys: str) -> None:
        """Press KEYS; what is on the screen follows."""
        await self.pilot.press(*keys)
        await self.refresh()

    async def resize(self, size: tuple[int, int]) -> None:
        """Change the terminal's size."""
        await self.pilot.resize_terminal(*size)
        await self.refresh()

    def log(self) -> list[str]:
        return [line.text.rstrip() for line in self.screen.query_one("#log", RichLog).lines]

    def text(self, widget: str) -> str:
        return str(self.screen.query_one(widget, Static).render())

    def row(self, nodeid: int) -> dict[str, str]:
        table = self.screen.query_one("#nodes", DataTable)
        cells = table.get_row(str(nodeid))
        return {str(key.value): str(cell) for key, cell in zip(table.columns, cells, strict=True)}


def on_screen(stage: CanStage, size: tuple[int, int], test: Callable[[Stand], Awaitable[None]]) -> None:
    """Run TEST with the screen; the bus's time goes on when the test says so."""

    async def run() -> None:
        options = MonitorOptions(bus=stage.options, bitrate=1_000_000, bitrate_is_known=True, dictionaries={})
        with stage.computer.listen(stage.options) as listener:
            watch = BusWatch(BusDecoder(), LoadMeter(1_000_000), now_s(stage.computer))
            screen = MonitorScreen(stage.computer, options, watch, listener)
            async with screen.run_test(size=size) as pilot:
                await test(Stand(stage, listener, screen, pilot))

    conversation_parts()  # which runs a loop of its own, is made now
    asyncio.run(run())


def test_traffic_is_shown_by_names(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        assert "no frame received yet" in stand.text("#state")
        for part in (0, 2, 3):
            await stand.hear(part)
        lines = stand.log()
        [line] = [line for line in lines if "canbus_id canbus_uuid" in line]
        assert line.endswith(f"4 ← canbus_id canbus_uuid={MAIN} canbus_nodeid=4")
        assert any(line.endswith("4 → get_canbus_id") for line in lines)
        assert not any("ack next" in line for line in lines)
        row = stand.row(MAIN_ID)
        assert (row["node"], row["mcu"], row["repeated"], row["bad"]) == ("4", "virtual-mainboard", "0", "0")
        assert float(row["rtt"]) > 0
        assert "uuid" not in row, "no room at 80 columns"
        assert "frames/s" in stand.text("#load")
        assert "0 dropped" in stand.text("#load")
        assert all(len(line) <= SMALL[0] - 2 for line in stand.text("#load").splitlines())

        [at] = [n for n, line in enumerate(lines) if "canbus_status rx_error" in line]
        assert lines[at + 1].strip() == "canbus_bus_state=active", "a long message is shown whole"
        assert lines[at + 1].index("canbus") == lines[at].index("canbus")

        await stand.resize(WIDE)
        assert stand.row(MAIN_ID)["uuid"] == str(MAIN)
        assert any("rx_error" in line and line.endswith("=active") for line in stand.log())
        await stand.resize(SMALL)
        assert "uuid" not in stand.row(MAIN_ID)

    on_screen(stage, SMALL, test)


def test_pause_filter_acks_and_clear(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        await stand.hear(0)
        await stand.hear(1)
        assert any("uptime high" in line for line in stand.log())
        await stand.press("space")
        before = stand.log()
        await stand.hear(3)
        assert "PAUSED, 2 since" in stand.text("#state")
        assert stand.log() == before
        await stand.press("space")
        assert any("canbus_status rx_error" in line for line in stand.log())

        await stand.press("a")
        assert any("ack next=" in line for line in stand.log())
        await stand.press("a")
        assert not any("ack next=" in line for line in stand.log())

        await stand.press("slash")
        stand.screen.query_one("#filter", Input).value = "dir=from uptime"
        await stand.press("enter")
        assert stand.log()
        assert all("← uptime" in line for line in stand.log())
        assert "filter: dir=from uptime" in stand.text("#state")
        assert not stand.screen.query_one("#filter", Input).has_class("asked")

        await stand.press("c")
        assert stand.log() == []
        await stand.hear(4)
        assert ["← uptime" in line for line in stand.log()] == [True]

    on_screen(stage, SMALL, test)


def test_a_bad_filter_is_told_and_changes_nothing_and_q_quits(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        await stand.press("slash", *"a=q", "enter")  # which are keys of the screen, too
        assert [n.message for n in stand.screen._notifications] == [
            "'a=q' is not a filter; write node=4 kind=nak dir=to (or from) get_*"
        ]
        assert "filter: none" in stand.text("#state")
        await stand.press("escape")
        assert not stand.screen.query_one("#filter", Input).has_class("asked")
        await stand.pilot.press("q")
        assert stand.screen._exit
        assert stand.screen.failure is None

    on_screen(stage, SMALL, test)


def test_memory_is_bounded_and_what_is_left_out_is_said(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        def put(count: int) -> None:
            for frame in many[:count]:
                stand.listener.put(frame)

        many: Sequence[Frame] = [Frame(n / 8000, 0x700, b"12345678") for n in range(KEPT + 100)]
        put(len(many))
        await stand.refresh()
        assert len(stand.screen._said) == KEPT
        assert stand.screen.shown == LINES_AT_ONCE
        assert any("more omitted" in line for line in stand.log())
        for _ in range(LOG_LINES // LINES_AT_ONCE + 2):
            put(100)
            stand.screen.refresh_now()
        await stand.pilot.pause()
        assert len(stand.log()) <= LOG_LINES

    on_screen(stage, SMALL, test)


def test_a_bus_that_ends_ends_it_and_the_cause_is_kept(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        stage.computer.unplug()
        stage.world.run_for(0.1)
        stand.screen.refresh_now()
        assert stand.screen._exit
        assert "the connection ended" in str(stand.screen.failure)

    on_screen(stage, SMALL, test)


def test_a_timer_that_fires_when_the_widgets_are_gone(stage: CanStage) -> None:
    async def test(stand: Stand) -> None:
        await stand.screen.screen.remove_children()
        stand.screen.refresh_now()
        assert stand.screen.failure is None

    on_screen(stage, SMALL, test)


@pytest.mark.parametrize("text", ["node=0", "node=x", "kind=foo", "dir=up", "a=b"])
def test_filters_that_are_none(text: str) -> None:
    with pytest.raises(UsageError):
        read_filter(text)
