"""A node with a wrong dictionary, or with wrong answers, fails itself: its bus and the others go on."""

import asyncio
import json
import zlib
from typing import Any

import pytest

from nodes.bus.can_bus import BUS_STOP_FRAMES, CanBus
from nodes.clock.sync_pulse import PulseKeeper
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfig
from nodes.node.connector import BuildConfig
from nodes.node.errors import NodeError, NodeLost
from nodes.node.states import NodeState
from nodes.support.can_protocol import BUS_STOP_ID
from tests.nodes import virtual_time
from tests.nodes.machine import Machine, make_config, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode, source_of

STOPPING = source_of(config={"CLOCK_FREQ": 1_000_000, "CAN_BUS_STOP": 1})


class Pair:
    """A bus with a sound node and FAN, an optional one; reports of the bus, exceptions of the loop."""

    def __init__(self, fan: TwinNode, build: BuildConfig | None = None) -> None:
        fan.uuid = uuid(2)
        self.sound_twin = TwinNode(uuid(1), source=STOPPING)
        self.io = TwinIO([self.sound_twin, fan])
        self.notices: list[str] = []
        self.bugs: list[dict[str, Any]] = []
        self.bus = CanBus("can0", self.io, on_notice=self.notices.append)
        self.sound = self.bus.add_node("mainboard", uuid(1), make_config())
        self.fan = self.bus.add_node("fan", uuid(2), build or make_config(), may_be_absent=True)

    def start_and_stop(self) -> None:
        """Start the bus, stop it in an emergency and close it."""

        async def main() -> None:
            asyncio.get_running_loop().set_exception_handler(lambda _, context: self.bugs.append(context))
            await self.bus.start()
            assert self.sound.state is NodeState.READY
            self.bus.emergency_stop()
            await asyncio.sleep(0.1)
            await self.bus.close()

        virtual_time.run(main())
        assert self.io.closed
        assert [can_id for can_id, _ in self.io.frames].count(BUS_STOP_ID) == BUS_STOP_FRAMES
        assert self.sound_twin.shut_down


def firmware(**parts: Any) -> TwinNode:
    """A node whose dictionary says PARTS of what it does not do."""
    return TwinNode(compressed=zlib.compress(json.dumps(source_of(**parts)).encode()))


@pytest.mark.parametrize(
    ("constant", "value", "is_what"),
    [
        ("CLOCK_FREQ", None, r"1\.\.4294967295 and is missing"),
        ("CLOCK_FREQ", 2**32, r"1\.\.4294967295 and is 4294967296"),
        ("RECEIVE_WINDOW", 63, r"64\.\.1048575 and is 63"),
        ("STATS_SUMSQ_BASE", 0, r"1\.\.4294967295 and is 0"),
        ("CANBUS_FREQUENCY", 1, r"10000\.\.1000000 and is 1"),
        ("CANBUS_FREQUENCY", -1, r"10000\.\.1000000 and is -1"),
        ("CANBUS_FREQUENCY", 2**32, r"10000\.\.1000000 and is 4294967296"),
        ("CAN_BUS_STOP", "1", r"0\.\.255 and is '1'"),
        ("CAN_BUS_STOP", 1.0, r"0\.\.255 and is 1\.0"),
        ("CAN_SYNC_PULSE", "9" * 99, r"0\.\.255 and is '9{59}"),
        ("CAN_TRIGGER_GROUPS", 256, r"0\.\.255 and is 256"),
        ("MT_AXLES", -1, r"0\.\.255 and is -1"),
        ("STEPPER_BOTH_EDGE", "yes", r"0\.\.255 and is 'yes'"),
        ("ADC_MAX", 0, r"1\.\.65535 and is 0"),
        ("ADC_MAX", -5, r"1\.\.65535 and is -5"),
        ("PWM_MAX", 65536, r"1\.\.65535 and is 65536"),
    ],
)
def test_a_constant_that_cannot_be_fails_its_node_alone(
    constant: str, value: float | str | None, is_what: str
) -> None:
    config = {key: v for key, v in {"CLOCK_FREQ": 1_000_000, constant: value}.items() if v is not None}
    pair = Pair(firmware(config=config))
    pair.start_and_stop()
    wanted = rf"node fan: dictionary: constant {constant} must be a whole number of {is_what}.*; flash the"
    with pytest.raises(NodeError, match=wanted):
        raise pair.fan.failure or AssertionError


def test_a_sync_pulse_that_is_answered_without_its_number_fails_the_node_alone() -> None:
    responses = source_of()["responses"] | {"sync_pulse clock=%u": 99}
    pair = Pair(firmware(responses=responses))
    pair.start_and_stop()
    assert "has no response 'sync_pulse seq=%c clock=%u' and cannot be driven" in str(pair.fan.failure)


def test_a_bug_in_building_a_configuration_fails_its_node_alone_and_is_reported() -> None:
    def build(_: Dictionary) -> NodeConfig:
        raise ZeroDivisionError("by it")

    pair = Pair(TwinNode(), build)
    pair.start_and_stop()
    (bug,) = pair.bugs
    assert isinstance(bug["exception"], ZeroDivisionError)
    assert str(pair.fan.failure) == (
        "the configuration of node fan cannot be built (ZeroDivisionError('by it')); this is a bug, please"
        " report it"
    )


def test_a_bug_in_the_sync_pulses_is_reported_and_keeps_no_bus_open(monkeypatch: pytest.MonkeyPatch) -> None:
    async def stumble(_: PulseKeeper) -> None:
        raise KeyError("seq")

    monkeypatch.setattr(PulseKeeper, "run", stumble)
    pair = Pair(TwinNode())
    pair.start_and_stop()
    (bug,) = pair.bugs
    assert isinstance(bug["exception"], KeyError)
    assert pair.notices == ["watching bus can0 failed (KeyError('seq')); this is a bug, please report it"]


def test_an_uptime_that_cannot_be_is_refused() -> None:
    machine = Machine(TwinNode(start_ticks=2**63))
    wanted = r"lost node mainboard: its clock cannot be right: an uptime of 922337\d{13} ticks at 1000000 Hz"
    with pytest.raises(NodeLost, match=wanted):
        machine.run(machine.bus.start)
    assert not machine.estimates
