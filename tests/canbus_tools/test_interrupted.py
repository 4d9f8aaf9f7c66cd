"""A tool that is interrupted, and a bus that ends below it."""

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from canbus_tools.discovery import take_census
from canbus_tools.open_bus import BusOptions
from canbus_tools.talk import BusTalk
from nodes.assign import ADMIN_ID
from nodes.dictionary_cache import DictionaryCache
from nodes.errors import CanductorError
from nodes.link import Frame
from nodes.transport import CanFrame
from nodes.transport.frame import BUS_OFF
from nodes.virtual.hub import VirtualBus
from tests.canbus_tools.stage import PATIENCE_S, Place


def test_ctrl_c_ends_a_tool_in_order(place: Place) -> None:
    words = [sys.executable, "-m", "coordinator.cli", "can", "nodes", "--listen", "60", *place.words]
    host = place.open()
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tool:
        while (frame := host.receive(PATIENCE_S)) != CanFrame(ADMIN_ID, b"\x00"):
            assert frame is not None, "the tool does not ask"
        host.close()
        tool.send_signal(signal.SIGINT)
        out, err = tool.communicate(timeout=PATIENCE_S)
    assert (tool.returncode, out, err) == (130, "", "canductor: stopped by Ctrl-C\n")


def test_a_controller_that_goes_off_the_bus_ends_the_question(place: Place) -> None:
    async def ask() -> None:
        async with BusTalk.open(place.options, DictionaryCache()) as bus:
            loop = asyncio.get_running_loop()
            # No bus here has a controller: the kernel's report is put where it would arrive.
            loop.call_later(0.02, bus._frame_came, Frame(BUS_OFF, bytes(8), 0))
            await take_census(bus)

    with pytest.raises(CanductorError, match=r"went off the bus \(bus-off\).*bit rate.*canductor can doctor"):
        asyncio.run(ask())


def test_a_bus_that_ends_ends_the_question_in_a_sentence(tmp_path: Path) -> None:
    async def ask(hub: VirtualBus) -> None:
        async with BusTalk.open(BusOptions(interface="canductor", channel=str(hub.path))) as bus:
            asyncio.get_running_loop().call_later(0.02, hub.close)
            await take_census(bus)

    with VirtualBus(tmp_path / "hub") as hub, pytest.raises(CanductorError, match="the connection ended"):
        asyncio.run(ask(hub))
