"""Responses that may wait for others: which ones, how long, and who is in a hurry meanwhile."""

import asyncio

import pytest

from nodes.link import LinkError, Response
from nodes.node.errors import NodeLost
from nodes.node.node import MEASURED, PATIENCE_S, REST_PATIENCE_S, STATE
from nodes.node.request_reply import QUERY_TIMEOUT_S, QueryTimeout
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.machine import Machine
from tests.nodes.node.talk_bench import BOTH, TalkBench
from tests.nodes.twin_bus import TwinNode, source_of


def now_s() -> float:
    return asyncio.get_running_loop().time()


def test_the_link_is_told_by_the_id_on_the_wire_and_once() -> None:
    bench = TalkBench()
    bench.talk.let_wait("config", 0.1)
    bench.talk.let_wait("uptime", 1.0)
    bench.talk.let_wait("nothing_that_the_firmware_has", 1.0)
    assert bench.link.patience_s == {bench.id_of("config"): 0.1, bench.id_of("uptime"): 1.0}
    bench.link.patience_s.clear()
    bench.talk.let_wait("config", 0.1)
    assert bench.link.patience_s == {}
    bench.talk.let_wait("config", 0.2)
    assert bench.link.patience_s == {bench.id_of("config"): 0.2}


def test_a_new_link_knows_of_none() -> None:
    bench = TalkBench()
    bench.talk.let_wait("config", 0.1)
    bench.talk.detach()
    bench.talk.attach(bench.link)
    bench.talk.dictionary = bench.twin.dictionary
    bench.link.patience_s.clear()
    bench.talk.let_wait("config", 0.1)
    assert bench.link.patience_s == {bench.id_of("config"): 0.1}


def test_nothing_waits_while_an_answer_is_wanted_at_once() -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.talk.let_wait("config", 0.1)
        asking = [asyncio.ensure_future(bench.talk.ask("get_config", "config")) for _ in range(2)]
        await asyncio.sleep(0)
        assert bench.link.hurries[-1]
        assert len(bench.link.sent) == 2
        asking[0].cancel()
        await asyncio.sleep(0)
        assert bench.link.hurries[-1], "the other still asks"
        await asking[1]
        assert not bench.link.hurries[-1]

    virtual_time.run(main())


def test_who_has_time_hurries_nobody_and_waits_as_long_as_the_answer_may() -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.talk.let_wait("config", 0.1)
        bench.talk.let_wait("uptime", 1.0)
        bench.twin.alive = False
        before_s = now_s()
        with pytest.raises(QueryTimeout):
            await bench.talk.ask("get_config", "config", tries=2, patient=True)
        assert now_s() - before_s == pytest.approx(2 * QUERY_TIMEOUT_S, abs=1e-6)
        before_s = now_s()
        assert await bench.talk.ask_together(BOTH) == [None, None]
        assert now_s() - before_s == pytest.approx(1.0, abs=1e-6)
        assert bench.link.hurries == []

    virtual_time.run(main())


def test_an_answer_that_came_in_time_counts_although_it_waits() -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.talk.let_wait("config", 0.1)
        bench.twin.alive = False
        asking = asyncio.ensure_future(bench.talk.ask("get_config", "config", tries=1, patient=True))
        await asyncio.sleep(0.1)
        content = bench.twin.response("config", is_config=1, crc=7, is_shutdown=0, move_count=5)
        bench.link.waiting.append(Response(content, 5, 6))
        assert (await asking).message.integer("crc") == 7
        assert not bench.link.waiting

    virtual_time.run(main())


def test_without_patience_nobody_has_to_hurry() -> None:
    bench = TalkBench()

    async def main() -> None:
        await bench.talk.ask("get_config", "config")
        await bench.talk.ask("get_config", "config", patient=True)
        assert bench.link.hurries == []

    virtual_time.run(main())


@pytest.mark.parametrize("ends", ["lost", "detached"])
def test_a_link_that_ends_meanwhile_ends_the_hurry(ends: str) -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.talk.let_wait("config", 0.1)
        asking = asyncio.ensure_future(bench.talk.ask("get_config", "config"))
        await asyncio.sleep(0)
        bench.talk.fail(NodeLost("lost node mainboard"))
        if ends == "lost":
            bench.link.failure = LinkError("can0 node 4: lost")
        else:
            bench.talk.detach()
        with pytest.raises(NodeLost):
            await asking
        assert bench.link.hurries == [True], "there is no link to tell"
        bench.link.failure = None
        bench.talk.attach(bench.link)
        bench.talk.dictionary = bench.twin.dictionary
        bench.talk.let_wait("config", 0.1)
        await bench.talk.ask("get_config", "config")
        assert bench.link.hurries == [True, True, False]

    virtual_time.run(main())


def test_a_link_that_is_lost_already_leaves_no_hurry_behind() -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.talk.let_wait("config", 0.1)
        bench.link.failure = LinkError("can0 node 4: lost")
        with pytest.raises(LinkError):
            await bench.talk.ask("get_config", "config")
        bench.link.failure = None
        bench.link.hurries.clear()
        await bench.talk.ask("get_config", "config")
        assert bench.link.hurries == [True, False]

    virtual_time.run(main())


def test_a_node_that_is_ready_lets_what_comes_all_the_time_wait() -> None:
    measured = source_of()["responses"] | {f"{MEASURED} oid=%c next_clock=%u value=%hu": 102}
    machine = Machine(TwinNode(source=source_of(responses=measured)))

    def patience_s(response: str) -> float | None:
        return machine.io.links[-1].patience_s.get(machine.node.dictionary.responses[response].prefix)

    def together() -> int:
        return machine.io.links[-1].together[machine.node.dictionary.responses[MEASURED].prefix]

    async def check() -> None:
        responses = machine.node.dictionary.responses
        assert machine.node.state is NodeState.READY
        for name, seconds in PATIENCE_S.items():
            assert patience_s(name) == seconds if name in responses else name == "sync_pulse"
        for state in (True, False):
            machine.node.let_reports_wait(measurements=True, state=state, clock=state)
            assert patience_s(MEASURED) == REST_PATIENCE_S
            for name in responses.keys() & set(STATE):
                assert patience_s(name) == (REST_PATIENCE_S if state else PATIENCE_S[name])
        machine.node.let_reports_wait(measurements=False, state=False, clock=False)
        assert patience_s(MEASURED) == PATIENCE_S[MEASURED]
        assert together() == 0, "nobody knows how many there are"
        ends = [machine.node.on(MEASURED, oid, lambda _: None) for oid in (1, 2, 3)]
        machine.node.on(MEASURED, None, lambda _: None)  # of whatever sensor
        ends[0]()
        machine.node.let_reports_wait(measurements=True, state=False, clock=False)
        assert together() == 0, "it waits for others"
        machine.node.let_reports_wait(measurements=False, state=False, clock=False)
        assert together() == 2
        machine.node.let_reports_wait(measurements=True, state=True, clock=True)
        machine.io.links[-1].failure = LinkError("can0 node 4: lost")
        machine.node.let_reports_wait(
            measurements=False, state=False, clock=False
        )  # a lost link is reported elsewhere
        machine.io.links[-1].failure = None
        await machine.node.restart()
        assert patience_s(MEASURED) == PATIENCE_S[MEASURED]
        machine.node.let_reports_wait(measurements=True, state=True, clock=True)
        assert patience_s(MEASURED) == REST_PATIENCE_S, "a restart ends what was set before"

    machine.run(machine.bus.start, check)
    machine.node.let_reports_wait(
        measurements=True, state=True, clock=True
    )  # without effect on one that is closed
