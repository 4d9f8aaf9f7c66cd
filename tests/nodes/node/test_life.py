"""Nodes that restart by themselves, sleep, are doubled, or may be absent."""

import asyncio
import re

import pytest

from nodes.bus.can_bus import CanBus
from nodes.link import Frame
from nodes.link.interfaces import OnFrame, OnLost
from nodes.node.errors import NodeError, NodeRestarted
from nodes.node.states import NodeState
from nodes.support.can_protocol import BUS_OFF
from nodes.support.errors import CanductorError
from tests.nodes import virtual_time
from tests.nodes.machine import Machine, make_config, stepper_x, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode, source_of, with_canbus_id


def now_s() -> float:
    return asyncio.get_running_loop().time()


# ---------------------------------------------------------------------------------------------- restarts


def test_a_node_that_asks_for_an_id_again_is_known_to_have_restarted_before_its_link_is_lost() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        await asyncio.sleep(3)
        machine.twin.reboot()
        before_s = now_s()
        await machine.changed_to(NodeState.LOST)
        # Up to the next sample of the clock, then its timeout and that of the proof that it does not live.
        assert now_s() - before_s < 0.9843 + 0.25 + 0.1 + 0.05
        assert isinstance(machine.node.failure, NodeRestarted)
        assert str(machine.node.failure) == (
            "node mainboard restarted by itself (its uuid requests an id again); check its power supply"
        )
        await machine.node.restart()
        assert (machine.twin.nodeid, machine.twin.configured) == (4, True)
        assert str(machine.states[-1]) == str(NodeState.READY)

    machine.run(machine.bus.start, check)


def test_commands_without_an_answer_raise_the_suspicion_too() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        await asyncio.sleep(3)
        samples = len(machine.estimates)
        while len(machine.estimates) == samples:  # noqa: ASYNC110  virtual time
            await asyncio.sleep(0.001)
        machine.twin.reboot()
        machine.io.links[0].on_silent()  # something was sent, and not acknowledged
        before_s = now_s()
        await machine.changed_to(NodeState.LOST)
        assert now_s() - before_s < 0.45
        assert "requests an id again" in str(machine.node.failure)

    machine.run(machine.bus.start, check)


def test_an_uptime_that_runs_backwards_is_a_restart() -> None:
    machine = Machine(TwinNode(start_ticks=1 << 36))

    async def check() -> None:
        await asyncio.sleep(3)
        machine.twin.start_ticks = 0  # and somebody gave it the same configuration
        await machine.changed_to(NodeState.LOST)
        assert str(machine.node.failure) == (
            "node mainboard restarted by itself (its uptime ran backwards); check its power supply"
        )

    machine.run(machine.bus.start, check)


def test_another_host_that_configures_a_node_is_found_out() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.twin.crc += 1
        await machine.changed_to(NodeState.LOST)
        assert "was given another configuration; let only one host drive it" in str(machine.node.failure)

    machine.run(machine.bus.start, check)


def test_the_clock_of_a_node_with_a_long_uptime_rolls_over_without_suspicion() -> None:
    twin = TwinNode()
    twin.start_ticks = (1 << 32) - twin.ticks(virtual_time.START_S + 5)
    machine = Machine(twin)

    async def check() -> None:
        assert twin.ticks(now_s()) < 1 << 32
        await asyncio.sleep(20)
        assert twin.ticks(now_s()) > 1 << 32
        assert machine.node.state is NodeState.READY

    machine.run(machine.bus.start, check)


# ------------------------------------------------------------------------------------- two of something


def test_a_second_board_with_a_nodes_uuid_is_named_and_the_node_goes_on() -> None:
    said: list[str] = []
    twin, clone = TwinNode(uuid(1)), TwinNode(uuid(1), alive=False)
    bus = CanBus("can0", TwinIO([twin, clone]), on_notice=said.append)
    node = bus.add_node("mainboard", uuid(1), make_config())

    async def main() -> None:
        await bus.start()
        clone.alive = True
        for _ in range(3):
            bus.suspect()
            await asyncio.sleep(1)
        assert node.state is NodeState.READY
        await bus.close()

    virtual_time.run(main())
    [sentence] = said
    assert sentence == (
        "two boards on bus can0 have the uuid 010203040501 (cloned chips?); take one of them off; "
        "the second one waits for an id and is not used"
    )


def test_a_board_that_answers_in_anothers_place_is_found_out() -> None:
    machine = Machine(TwinNode(source=with_canbus_id(), says_uuid=uuid(2)))
    with pytest.raises(
        NodeError,
        match=r"two boards answer on node id 4 of bus can0: 010203040501, .* reports 010203040502; switch",
    ):
        machine.run(machine.bus.start)


def test_the_right_board_in_its_place_is_taken() -> None:
    machine = Machine(TwinNode(source=with_canbus_id()))

    async def check() -> None:
        assert machine.node.state is NodeState.READY
        assert "get_canbus_id" in machine.twin.executed

    machine.run(machine.bus.start, check)


def test_a_node_whose_id_was_given_away_says_what_to_do() -> None:
    texts = source_of()["enumerations"]["static_string_id"] | {"Another CAN node assigned this ID": 77}
    enumerations = source_of()["enumerations"] | {"static_string_id": texts}
    machine = Machine(TwinNode(source=source_of(enumerations=enumerations)))

    async def check() -> None:
        machine.io.links[0].say(machine.twin.shutdown(0.0, 77))
        await machine.changed_to(NodeState.SHUTDOWN)
        assert "Another CAN node assigned this ID: another board was given its node id" in str(
            machine.node.failure
        )

    machine.run(machine.bus.start, check)


@pytest.mark.parametrize(("ahead_s", "named"), [(0.5, True), (-0.5, False)])
def test_a_node_that_shuts_down_with_a_clock_that_is_ahead_says_so(ahead_s: float, named: bool) -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        now_s = asyncio.get_running_loop().time()
        machine.io.links[0].say(machine.twin.shutdown(now_s + ahead_s, 1))
        await machine.changed_to(NodeState.SHUTDOWN)
        assert (
            bool(re.search(r"\(its clock was (499|500)\.\d ms ahead of ", str(machine.node.failure))) is named
        )

    machine.run(machine.bus.start, check)


# ------------------------------------------------------------------------------------------------- sleep


def test_a_node_that_sleeps_is_neither_asked_nor_missed_and_wakes_as_new() -> None:
    machine = Machine(TwinNode(), make_config(stepper_x()))

    async def check() -> None:
        await machine.node.sleep()
        machine.twin.alive = False
        executed = len(machine.twin.executed)
        machine.io.links[0].on_lost("an old link's last words")
        machine.node.lose("nothing")
        await asyncio.sleep(60)
        assert machine.node.state is NodeState.SLEEPING
        assert len(machine.twin.executed) == executed
        with pytest.raises(NodeError, match="node mainboard is asleep and takes no commands"):
            machine.node.send("get_clock")
        with pytest.raises(NodeError, match="is asleep and cannot be put to sleep"):
            await machine.node.sleep()
        machine.twin.alive = True
        machine.twin.reboot()
        await machine.node.wake()
        assert (machine.twin.nodeid, machine.twin.configured) == (4, True)
        assert str(machine.node.state) == str(NodeState.READY)
        with pytest.raises(NodeError, match="is ready and cannot be woken"):
            await machine.node.wake()

    machine.run(machine.bus.start, check)


# --------------------------------------------------------------------------------------------------- bus


def test_a_controller_that_goes_bus_off_loses_its_nodes_with_what_to_do() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        assert machine.io.on_frame is not None
        machine.io.on_frame(Frame(BUS_OFF, bytes(8), 0))
        assert machine.node.state is NodeState.LOST
        assert "bus-off" in str(machine.node.failure)
        assert "'ip link set can0 type can restart-ms 100'" in str(machine.node.failure)
        await machine.node.restart()  # the interface is back
        assert str(machine.node.state) == str(NodeState.READY)

    machine.run(machine.bus.start, check)


def test_nodes_that_may_be_absent_do_not_keep_the_others_from_starting() -> None:
    bus = CanBus("can0", TwinIO([TwinNode(uuid(1)), TwinNode(uuid(2), alive=False)]))
    there = bus.add_node("mainboard", uuid(1), make_config())
    absent = bus.add_node("fan", uuid(2), make_config(), may_be_absent=True)

    async def main() -> None:
        await bus.start()
        assert (there.state, absent.state) == (NodeState.READY, NodeState.LOST)
        assert "node 010203040502 not found on bus can0" in str(absent.failure)
        await bus.close()

    virtual_time.run(main())


def test_clones_of_a_node_that_may_be_absent_do_not_stop_the_others() -> None:
    bus = CanBus("can0", TwinIO([TwinNode(uuid(1)), TwinNode(uuid(2)), TwinNode(uuid(2))]))
    there = bus.add_node("mainboard", uuid(1), make_config())
    absent = bus.add_node("fan", uuid(2), make_config(), may_be_absent=True)

    async def main() -> None:
        await bus.start()
        assert (there.state, absent.state) == (NodeState.READY, NodeState.LOST)
        assert "two boards on bus can0 have the uuid 010203040502" in str(absent.failure)
        await bus.close()

    virtual_time.run(main())


def test_a_bus_of_nodes_that_may_be_absent_can_be_missing_and_come_later() -> None:
    class Plugged(TwinIO):
        there = False

        def __call__(self, *, on_frame: OnFrame | None, on_closed: OnLost) -> TwinIO:
            if not self.there:
                raise CanductorError("CAN interface can7: there is no such interface")
            return super().__call__(on_frame=on_frame, on_closed=on_closed)

    io = Plugged([TwinNode(uuid(1))])
    bus = CanBus("can7", io)
    node = bus.add_node("fan", uuid(1), make_config(), may_be_absent=True)

    async def main() -> None:
        await bus.start()
        assert node.state is NodeState.LOST
        assert "there is no such interface" in str(node.failure)
        with pytest.raises(CanductorError, match="there is no such interface"):
            bus.ensure_open()
        io.there = True
        bus.ensure_open()
        await node.restart()
        assert str(node.state) == str(NodeState.READY)
        assert io.on_closed is not None
        io.on_closed("the adapter was unplugged")
        assert str(node.state) == str(NodeState.LOST)
        bus.ensure_open()
        await node.restart()
        assert str(node.state) == str(NodeState.READY)
        await bus.close()

    virtual_time.run(main())
