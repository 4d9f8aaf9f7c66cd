"""The life of nodes on a bus: starting, being configured anew, shutting down, getting lost, restarting."""

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from nodes.bus.assign import AssignError
from nodes.bus.bus import UartBus
from nodes.bus.can_bus import CanBus
from nodes.clock.clock import HostTime
from nodes.node.errors import NodeError, NodeLost, NodeShutdown
from nodes.node.request_reply import QUERY_TRIES
from nodes.node.states import NodeState
from nodes.support.can_protocol import ADMIN_ID
from nodes.support.errors import CanductorError
from tests.nodes import virtual_time
from tests.nodes.machine import Machine, make_config, stepper_x, uuid
from tests.nodes.twin_bus import DELAY_S, TwinIO, TwinLink, TwinNode, source_of, without_commands

if TYPE_CHECKING:
    from nodes.node.node import Node

# ---------------------------------------------------------------------------------------------------- start


def test_a_node_is_assigned_identified_configured_and_kept_in_time() -> None:
    stepper = stepper_x()
    machine = Machine(TwinNode(ppm=120), make_config(stepper, init="set_digital_out pin=PA4 value=1"))

    async def check() -> None:
        assert machine.node.state is NodeState.READY
        assert machine.node.move_count == 512
        assert machine.twin.nodeid == 4
        assert machine.io.settings[0].nodeid == 4
        assert [line for line in machine.twin.executed if not line.startswith(("identify", "get_"))] == [
            "allocate_oids count=1",
            "config_stepper oid=0 step_pin=1 dir_pin=18 invert_step=0 step_pulse_ticks=2",
            f"finalize_config crc={machine.twin.crc}",
            "set_digital_out pin=4 value=1",
        ]
        assert await stepper.position(machine.node) == 0
        now_s = asyncio.get_running_loop().time()
        error = machine.node.clock.ticks_at(HostTime(round(now_s * 1e9))) - machine.twin.ticks(now_s)
        assert abs(error) < 20
        assert machine.io.links[0].clocks[-1] == (
            machine.estimates[-1].freq_hz,
            machine.estimates[-1].at_ns,
            machine.estimates[-1].at_ticks,
        )

    machine.run(machine.bus.start, check)
    assert machine.states == [
        NodeState.IDENTIFYING,
        NodeState.CONFIGURING,
        NodeState.READY,
        NodeState.CLOSED,
    ]
    assert machine.io.closed


def test_ready_when_the_clock_is_learnt() -> None:
    machine = Machine(TwinNode(), make_config(stepper_x()))

    async def check() -> None:
        assert asyncio.get_running_loop().time() < virtual_time.START_S + 2.5

    machine.run(machine.bus.start, check)


@pytest.mark.parametrize("seed", range(8))
def test_lost_responses_and_frames_are_asked_for_again(seed: int) -> None:
    machine = Machine(TwinNode(start_ticks=(1 << 32) - 1000), make_config(stepper_x()), loss=0.1, seed=seed)

    async def check() -> None:
        assert machine.node.state is NodeState.READY
        for i in range(50):
            answer = await machine.node.query("debug_ping", "pong", data=bytes((i,)), tries=20)
            assert answer.name == "pong"

    machine.run(machine.bus.start, check)


def test_late_answers_to_an_earlier_question_are_not_taken_for_the_last_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A busy computer asked six times whether the node is configured, before it read the first answer."""
    machine = Machine(TwinNode(), make_config(stepper_x()))
    said: list[bytes] = []
    say = TwinLink.say

    def repeat(link: TwinLink, answer: bytes, sent_ns: int = 0) -> None:
        say(link, answer, sent_ns)
        if not said and machine.twin.executed[-1] == "get_config":
            said.append(answer)
            for n in range(1, QUERY_TRIES):
                asyncio.get_running_loop().call_later(n * DELAY_S, say, link, answer, sent_ns)

    monkeypatch.setattr(TwinLink, "say", repeat)

    async def check() -> None:
        assert machine.node.state is NodeState.READY

    machine.run(machine.bus.start, check)
    assert said


def test_a_uart_node_starts_without_an_id() -> None:
    io = TwinIO([TwinNode()])
    bus = UartBus("/dev/ttyS9", io)
    node = bus.add_node("mainboard", make_config(stepper_x()))

    async def main() -> None:
        await bus.start()
        assert node.state is NodeState.READY
        assert io.settings[0].nodeid is None
        assert io.on_frame is None
        await bus.close()

    virtual_time.run(main())


def test_several_nodes_start_together_in_the_order_of_their_ids() -> None:
    twins = [TwinNode(uuid(n)) for n in (3, 1, 2)]
    bus = CanBus("can0", TwinIO(twins, loss=0.02))
    for number in (1, 2, 3):
        bus.add_node(f"node{number}", uuid(number), make_config())

    async def main() -> None:
        await bus.start()
        assert {twin.uuid: twin.nodeid for twin in twins} == {uuid(1): 4, uuid(2): 5, uuid(3): 6}
        assert all(node.state is NodeState.READY for node in bus.nodes)
        await bus.close()

    virtual_time.run(main())


# ------------------------------------------------------------------------------- old configurations, resets


def test_the_same_configuration_is_kept() -> None:
    twin = TwinNode()
    first = Machine(twin, make_config(stepper_x()))
    first.run(first.bus.start)
    twin.executed.clear()
    second = Machine(twin, make_config(stepper_x()))
    second.run(second.bus.start)
    assert not [line for line in twin.executed if line.startswith(("allocate", "config_", "finalize"))]


@pytest.mark.parametrize("shut_down", [False, True])
@pytest.mark.parametrize(
    "source", [source_of(), without_commands("config_reset")], ids=["config_reset", "reset"]
)
def test_another_configuration_or_a_shutdown_is_reset(source: dict[str, Any], shut_down: bool) -> None:
    twin = TwinNode(source=source, configured=True, crc=1, shut_down=shut_down)
    machine = Machine(twin, make_config(stepper_x()))

    async def check() -> None:
        assert machine.node.state is NodeState.READY
        assert (twin.configured, twin.shut_down, twin.nodeid) == (True, False, 4)
        assert twin.crc != 1

    machine.run(machine.bus.start, check)
    assert NodeState.SHUTDOWN not in machine.states
    assert NodeState.LOST not in machine.states


def test_a_node_that_cannot_be_reset_is_said_to_need_power() -> None:
    twin = TwinNode(source=without_commands("config_reset", "reset"), configured=True, crc=1)
    machine = Machine(twin)
    with pytest.raises(
        NodeError, match="because it had another configuration, but it has no way to reset; power-cycle it"
    ):
        machine.run(machine.bus.start)


def test_a_node_that_keeps_its_old_configuration_is_given_up() -> None:
    class Stubborn(TwinNode):
        def reset(self) -> None:
            pass

    machine = Machine(Stubborn(source=without_commands("config_reset"), configured=True, crc=1))
    with pytest.raises(
        NodeError, match=r"another configuration, but resets had no effect \(by command\); power"
    ):
        machine.run(machine.bus.start)


def test_a_configuration_the_node_refuses_is_told_with_its_words() -> None:
    twin = TwinNode(refuse=lambda message: 3 if message.name == "config_stepper" else None)
    machine = Machine(twin, make_config(stepper_x()))
    with pytest.raises(NodeShutdown, match="node mainboard shut down: Move queue overflow"):
        machine.run(machine.bus.start)
    assert machine.states[-2:] == [NodeState.SHUTDOWN, NodeState.CLOSED]


def test_an_init_command_the_node_refuses_is_told_too() -> None:
    twin = TwinNode(refuse=lambda message: 1 if message.name == "set_digital_out" else None)
    machine = Machine(twin, make_config(init="set_digital_out pin=PA4 value=1"))
    with pytest.raises(NodeShutdown, match="Timer too close"):
        machine.run(machine.bus.start)


# ---------------------------------------------------------------------------------------- shutdown and loss


def test_a_shutdown_ends_queries_and_refuses_commands() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        waiting = asyncio.ensure_future(
            machine.node.query("stepper_get_position", "uptime", oid=1, tries=100)
        )
        await asyncio.sleep(0)
        machine.io.links[0].say(machine.twin.shutdown(0.0, 1))
        with pytest.raises(NodeShutdown, match="node mainboard shut down: Timer too close"):
            await waiting
        assert machine.node.state is NodeState.SHUTDOWN
        with pytest.raises(NodeShutdown, match="Timer too close"):
            machine.node.send("get_clock")
        samples = len(machine.estimates)
        await asyncio.sleep(3)
        assert len(machine.estimates) > samples  # a node that is shut down keeps its clock
        await machine.node.restart()
        assert machine.states[-1] is NodeState.READY
        assert machine.node.failure is None

    machine.run(machine.bus.start, check)


def test_the_answer_to_a_refused_command_means_shutdown_too() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.io.links[0].say(machine.twin.response("is_shutdown", static_string_id=99))
        await machine.changed_to(NodeState.SHUTDOWN)
        assert str(machine.node.failure) == "node mainboard shut down: ?99"

    machine.run(machine.bus.start, check)


def test_a_lost_link_ends_queries_and_the_node_can_come_back() -> None:
    machine = Machine(TwinNode(), make_config(stepper_x()))

    async def check() -> None:
        machine.twin.alive = False
        waiting = asyncio.ensure_future(machine.node.query("debug_ping", "pong", data=b"", tries=100))
        await asyncio.sleep(0.1)
        machine.io.links[0].on_lost("no answer for 1 s")
        with pytest.raises(NodeLost, match="lost node mainboard: no answer for 1 s"):
            await waiting
        machine.node.emergency_stop()  # to a node that is gone: no harm
        machine.twin.alive = True
        machine.twin.reset()
        await machine.node.restart()
        assert machine.node.state is NodeState.READY
        assert machine.twin.nodeid == 4
        machine.io.links[0].on_lost("an old link's last words")
        assert machine.node.state is NodeState.READY

    machine.run(machine.bus.start, check)


def test_a_restart_that_fails_can_be_tried_again() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.twin.alive = False
        machine.node.lose("unplugged")
        with pytest.raises(AssignError, match="not found on bus can0"):
            await machine.node.restart()
        assert str(machine.states[-1]) == str(NodeState.LOST)
        assert "not found on bus can0" in str(machine.node.failure)
        machine.twin.alive = True
        machine.twin.reset()
        await machine.node.restart()
        assert str(machine.states[-1]) == str(NodeState.READY)

    machine.run(machine.bus.start, check)


def test_a_node_that_restarts_by_itself_is_lost_for_that_reason() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.io.links[0].say(machine.twin.response("starting"))
        await machine.changed_to(NodeState.LOST)
        assert str(machine.node.failure) == (
            "node mainboard restarted by itself (it reported that); check its power supply"
        )

    machine.run(machine.bus.start, check)


@pytest.mark.parametrize(
    ("happens", "state", "sentence"),
    [
        (
            lambda twin: twin.shutdown(0.0, 1),
            NodeState.SHUTDOWN,
            "shut down: the message with the reason got lost",
        ),
        (
            lambda twin: twin.reset(),
            NodeState.LOST,
            "mainboard restarted by itself (its configuration is gone)",
        ),
    ],
)
def test_what_a_node_said_only_once_is_noticed_when_that_was_lost(
    happens: Callable[[TwinNode], object], state: NodeState, sentence: str
) -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        happens(machine.twin)
        before_s = asyncio.get_running_loop().time()
        await machine.changed_to(state)
        assert asyncio.get_running_loop().time() - before_s < 1.1
        assert sentence in str(machine.node.failure)

    machine.run(machine.bus.start, check)


def test_a_bus_that_closes_takes_its_nodes_along() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        assert machine.io.on_closed is not None
        machine.io.on_closed("the adapter was unplugged")
        assert machine.node.state is NodeState.LOST
        with pytest.raises(NodeLost, match="lost node mainboard: the adapter was unplugged"):
            machine.node.send("get_clock")
        with pytest.raises(NodeLost, match="bus can0 cannot be used: the adapter was unplugged"):
            machine.bus.send_frame(ADMIN_ID, b"\0")
        await machine.node.restart()  # opens the bus again
        assert str(machine.node.state) == str(NodeState.READY)

    machine.run(machine.bus.start, check)


@pytest.mark.parametrize("method", ["send", "send_urgent", "set_clock"])
def test_a_link_that_refuses_before_its_loss_is_known_does_no_harm(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(TwinNode())

    def refuse(*_: object, **__: object) -> None:
        raise CanductorError("can0 node 4: no answer for 1 s")

    async def check() -> None:
        monkeypatch.setattr(machine.io.links[0], method, refuse)
        machine.node.emergency_stop()
        if method != "send_urgent":
            await machine.changed_to(NodeState.LOST)
            assert str(machine.node.failure) == "lost node mainboard: can0 node 4: no answer for 1 s"

    machine.run(machine.bus.start, check)


def test_a_bug_in_a_listener_to_the_clock_is_not_silent() -> None:
    machine = Machine(TwinNode())
    told: list[object] = []
    broken: list[bool] = []

    def listener(*_: object) -> None:
        if broken:
            raise ZeroDivisionError

    machine.node._on_clock = listener

    async def check() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context["exception"]))
        broken.append(True)
        await machine.changed_to(NodeState.LOST)
        assert "this is a bug" in str(machine.node.failure)

    machine.run(machine.bus.start, check)
    assert [type(bug) for bug in told] == [ZeroDivisionError]


def test_emergency_stop_reaches_the_node() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.bus.emergency_stop()
        await machine.changed_to(NodeState.SHUTDOWN)
        assert machine.twin.shut_down
        assert str(machine.node.failure) == "node mainboard shut down: Emergency stop"

    machine.run(machine.bus.start, check)


def test_asking_a_node_that_is_gone_again_and_again_keeps_nothing() -> None:
    machine = Machine(TwinNode())

    async def check() -> None:
        machine.bus.emergency_stop()
        await machine.changed_to(NodeState.SHUTDOWN)
        for _ in range(100):
            with pytest.raises(NodeShutdown) as told:
                _ = machine.node.link
        assert len(told.traceback) < 10

    machine.run(machine.bus.start, check)


# --------------------------------------------------------------------------------------------------- states


def test_a_closed_node_takes_nothing() -> None:
    machine = Machine(TwinNode())
    machine.run(machine.bus.start)

    async def main() -> None:
        with pytest.raises(NodeError, match="node mainboard is closed and takes no commands"):
            machine.node.send("get_clock")
        with pytest.raises(NodeError, match="closed and cannot be restarted"):
            await machine.node.restart()

    virtual_time.run(main())


def test_before_its_clock_is_known_a_node_says_so() -> None:
    async def main() -> None:
        node: Node = Machine(TwinNode()).node
        with pytest.raises(NodeError, match="clock of node mainboard is not known yet"):
            _ = node.clock

    virtual_time.run(main())
