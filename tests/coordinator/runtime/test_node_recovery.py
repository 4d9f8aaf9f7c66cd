"""What the machine does when a node goes that may: notices, waiting jobs, sleep; on twin nodes."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection, UartConnection
from coordinator.modules.module_set import build_modules
from coordinator.runtime.host import Port
from coordinator.runtime.machine import Machine, MachineStopped
from coordinator.runtime.node_recovery import LAST_TRY_S
from nodes.clock.clock import HostTime
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError
from tests.nodes import virtual_time
from tests.nodes.machine import uuid
from tests.nodes.twin_bus import TwinIO, TwinNode
from tests.stages.printer_text import PRINTER_CFG, write

NODES = f"""\
[mcu]
canbus_uuid: {uuid(1)}

[mcu toolhead]
canbus_uuid: {uuid(2)}

[mcu light]
canbus_uuid: {uuid(3)}
policy: optional

[mcu scale]
canbus_uuid: {uuid(4)}
policy: pause

[mcu plug]
serial: /dev/plug
policy: optional
"""


class TwinHost:
    """A computer with one CAN bus and one UART in virtual time."""

    def __init__(self) -> None:
        self.main, self.toolhead, self.light, self.scale = (TwinNode(uuid(n)) for n in (1, 2, 3, 4))
        self.plug = TwinNode()
        self.plugged = True
        self.can = TwinIO([self.main, self.toolhead, self.light, self.scale])
        self.uart = TwinIO([self.plug])
        self.open_ports = 0

    def now(self) -> HostTime:
        return HostTime(round(asyncio.get_running_loop().time() * 1e9))

    def open_can(self, connection: CanConnection) -> Port:
        return self._port(connection.interface, self.can)

    def open_uart(self, connection: UartConnection) -> Port:
        if not self.plugged:
            raise CanductorError(f"UART {connection.path}: there is no such device")
        return self._port(connection.path, self.uart)

    def usb_power(self) -> None:
        pass

    def _port(self, name: str, io: TwinIO) -> Port:
        self.open_ports += 1

        def start(*, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
            return io(on_frame=on_frame, on_closed=on_closed)

        def close() -> None:
            self.open_ports -= 1

        return Port(name, start, close)


class Job:
    """Notes what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def hold(self, cause: str) -> None:
        self.told.append(f"hold: {cause}")

    def release(self) -> None:
        self.told.append("release")

    def call(self) -> None:
        self.told.append("call")


class Stage:
    def __init__(self, folder: Path) -> None:
        text = NODES + PRINTER_CFG[PRINTER_CFG.index("\n[printer]") :]
        self.host = TwinHost()
        self.said: list[str] = []
        self.job = Job()
        description = load_machine(write(folder, text))
        self.machine = Machine(description, self.host, build_modules(description), on_notice=self.said.append)

    def run(self, check: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def main() -> None:
            await self.machine.start()
            try:
                await check()
            finally:
                await self.machine.close()
            assert self.host.open_ports == 0

        virtual_time.run(main())

    def state(self, name: str) -> NodeState:
        return self.machine.nodes[name].state

    async def until(self, name: str, state: NodeState) -> None:
        while self.state(name) is not state:  # noqa: ASYNC110  virtual time
            await asyncio.sleep(0.01)


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def lose(twin: TwinNode, io: TwinIO) -> None:
    """Switch a node off; its link notices."""
    twin.alive = False
    twin.reboot()
    next(link for link in reversed(io.links) if link.node is twin).on_lost("no answer for 1 s")


def test_an_optional_node_goes_and_comes_and_the_machine_does_not_mind(stage: Stage) -> None:
    async def check() -> None:
        with stage.machine.job(stage.job):
            lose(stage.host.light, stage.host.can)
            await asyncio.sleep(300)
            assert stage.said == ["lost node light: no answer for 1 s; its features are off until it is back"]
            stage.host.light.alive = True
            began_s = asyncio.get_running_loop().time()
            await stage.until("light", NodeState.READY)
            assert asyncio.get_running_loop().time() - began_s < LAST_TRY_S + 5
            await asyncio.sleep(0.1)
        assert len(stage.said) == 2
        assert stage.said[1].startswith("node light is back after 3")
        assert (stage.host.light.nodeid, stage.host.light.configured) == (6, True)
        assert stage.machine.stopped is None
        assert stage.job.told == ["release"]

    stage.run(check)


def test_an_optional_node_that_shuts_down_is_configured_anew(stage: Stage) -> None:
    async def check() -> None:
        stage.host.can.links[2].say(stage.host.light.shutdown(0.0, 1))
        await stage.until("light", NodeState.SHUTDOWN)
        await stage.until("light", NodeState.READY)
        assert not stage.host.light.shut_down
        assert stage.said[0] == (
            "node light shut down: Timer too close; its features are off until it is back"
        )

    stage.run(check)


def test_an_optional_node_that_reboots_is_recognised_and_taken_back(stage: Stage) -> None:
    async def check() -> None:
        await asyncio.sleep(3)
        stage.host.light.reboot()
        await stage.until("light", NodeState.LOST)
        await stage.until("light", NodeState.READY)
        assert "node light restarted by itself (its uuid requests an id again)" in stage.said[0]

    stage.run(check)


def test_absent_optional_nodes_do_not_keep_the_machine_from_starting(stage: Stage) -> None:
    stage.host.light.alive = stage.host.plugged = False

    async def check() -> None:
        assert [stage.state(name) for name in ("mcu", "toolhead", "scale")] == [NodeState.READY] * 3
        assert len(stage.said) == 2
        assert "not found on bus can0" in stage.said[0]
        assert "there is no such device" in stage.said[1]
        stage.host.light.alive = stage.host.plugged = True
        await stage.until("light", NodeState.READY)
        await stage.until("plug", NodeState.READY)

    stage.run(check)


def test_an_absent_pause_node_does(stage: Stage) -> None:
    stage.host.scale.alive = False

    async def check() -> None:
        raise AssertionError

    with pytest.raises(CanductorError, match=f"node {uuid(4)} not found"):
        stage.run(check)


def test_a_wire_with_only_optional_nodes_may_end(stage: Stage) -> None:
    async def check() -> None:
        assert stage.host.uart.on_closed is not None
        stage.host.plugged = False
        stage.host.uart.on_closed("/dev/plug: the connection ended")
        await asyncio.sleep(30)
        assert stage.state("plug") is NodeState.LOST
        assert stage.machine.stopped is None
        stage.host.plugged = True
        await stage.until("plug", NodeState.READY)
        assert [line.partition(";")[0] for line in stage.said][:1] == [
            "lost node plug: /dev/plug: the connection ended"
        ]

    stage.run(check)


def test_a_job_waits_for_a_pause_node(stage: Stage) -> None:
    async def check() -> None:
        with stage.machine.job(stage.job):
            lose(stage.host.scale, stage.host.can)
            lose(stage.host.light, stage.host.can)
            assert stage.job.told == ["hold: lost node scale: no answer for 1 s"]
            stage.host.light.alive = True
            await stage.until("light", NodeState.READY)
            await asyncio.sleep(0.1)
            assert "release" not in stage.job.told
            stage.host.scale.alive = True
            await stage.until("scale", NodeState.READY)
            await asyncio.sleep(0.1)
            assert stage.job.told[1:] == ["release"]
        assert stage.said[0] == ("lost node scale: no answer for 1 s; the job pauses until the node is back")

    stage.run(check)


def test_a_job_that_begins_while_a_pause_node_is_away_waits_at_once(stage: Stage) -> None:
    async def check() -> None:
        lose(stage.host.scale, stage.host.can)
        with stage.machine.job(stage.job):
            assert stage.job.told == ["hold: node scale is not there"]

    stage.run(check)


def test_a_fatal_node_stops_all_and_nobody_is_brought_back_any_more(stage: Stage) -> None:
    async def check() -> None:
        lose(stage.host.light, stage.host.can)
        stage.host.light.alive = True
        lose(stage.host.toolhead, stage.host.can)
        assert isinstance(stage.machine.stopped, MachineStopped)
        assert "lost node toolhead" in str(stage.machine.stopped)
        await asyncio.sleep(30)
        assert stage.state("light") is NodeState.LOST
        assert [stage.state(name) for name in ("mcu", "scale", "plug")] == [NodeState.SHUTDOWN] * 3
        assert len(stage.said) == 1

    stage.run(check)


def test_nodes_sleep_and_wake(stage: Stage) -> None:
    async def check() -> None:
        with stage.machine.job(stage.job):
            with pytest.raises(CanductorError, match="toolhead cannot sleep while a job runs: it carries"):
                await stage.machine.sleep("toolhead")
            with pytest.raises(CanductorError, match="mcu cannot sleep while a job runs: its clock"):
                await stage.machine.sleep("mcu")
            await stage.machine.sleep("scale")
            stage.host.scale.alive = False
            await asyncio.sleep(30)
            assert stage.job.told == []
        await stage.machine.sleep("toolhead")
        with pytest.raises(CanductorError, match="not found on bus can0"):
            await stage.machine.wake("scale")
        assert stage.state("scale") is NodeState.SLEEPING
        with pytest.raises(CanductorError, match="there is no node 'fan'; there are mcu, toolhead, light"):
            await stage.machine.sleep("fan")
        stage.host.scale.alive = True
        stage.host.scale.reboot()
        await stage.machine.wake("scale")
        await stage.machine.wake("toolhead")
        assert {stage.state(name) for name in stage.machine.nodes} == {NodeState.READY}
        assert stage.machine.stopped is None
        assert stage.said == []

    stage.run(check)


def test_a_node_that_is_being_brought_back_can_be_put_to_sleep(stage: Stage) -> None:
    async def check() -> None:
        for delay_s in (0.1, 0.6, 1.3, 3.2):
            with stage.machine.job(stage.job):
                lose(stage.host.scale, stage.host.can)
                stage.host.scale.alive = True
                await asyncio.sleep(delay_s)
                await stage.machine.sleep("scale")
                assert stage.job.told[-1] == "release"
            assert stage.state("scale") is NodeState.SLEEPING
            await stage.machine.wake("scale")

    stage.run(check)


def test_a_bug_in_bringing_back_comes_to_light(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []

    async def broken() -> None:
        raise ZeroDivisionError

    async def check() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context["exception"]))
        monkeypatch.setattr(stage.machine.nodes["light"], "restart", broken)
        lose(stage.host.light, stage.host.can)
        await asyncio.sleep(1)

    stage.run(check)
    assert [type(bug) for bug in told] == [ZeroDivisionError]
