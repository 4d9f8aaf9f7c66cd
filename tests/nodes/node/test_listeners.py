"""Listeners that fail: what they raise is reported once, and takes nothing from anybody else."""

import asyncio
from typing import Any

import pytest

from nodes.link import Response
from nodes.node.request_reply import QueryTimeout
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.machine import Machine
from tests.nodes.node.talk_bench import TalkBench
from tests.nodes.twin_bus import TwinNode

TIMEOUT_S = 0.05


def fail(*_: object) -> Any:
    raise ZeroDivisionError


def bugs_of_this_loop() -> list[dict[str, Any]]:
    """Return what is reported to the exception handler of the running loop from now on."""
    bugs: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context))
    return bugs


def test_a_listener_that_fails_takes_nothing_from_the_next_responses_and_listeners() -> None:
    async def main() -> None:
        bench, seen, bugs = TalkBench(), list[str](), bugs_of_this_loop()
        for response in ("stats", "uptime"):
            bench.talk.on(response, None, fail)
            bench.talk.on(response, None, lambda message: seen.append(message.name))
        stats = bench.twin.response("stats", count=1, sum=1, sumsq=1)
        uptime = bench.twin.response("uptime", high=0, clock=5)
        bench.talk.receive([Response(content, 0, 1) for content in (stats, uptime, stats)])
        assert seen == ["stats", "uptime", "stats"]
        assert [bug["message"].partition(" could")[0] for bug in bugs] == [
            "node mainboard: stats",
            "node mainboard: uptime",
        ], "each once"
        assert {type(bug["exception"]) for bug in bugs} == {ZeroDivisionError}

    virtual_time.run(main())


def test_a_question_ends_though_what_it_takes_from_the_link_cannot_be_handled() -> None:
    """Failed before: neither a repeat nor a result followed, and a clock was never asked again."""

    async def main() -> None:
        bench, bugs = TalkBench(), bugs_of_this_loop()
        bench.twin.alive = False
        bench.link.take = fail  # type: ignore[method-assign]
        with pytest.raises(QueryTimeout, match=r"did not answer get_clock within 0\.15 s"):
            async with asyncio.timeout(10 * TIMEOUT_S):
                await bench.talk.ask("get_clock", "clock", tries=3, timeout_s=TIMEOUT_S)
        assert len(bench.link.sent) == 3
        assert [type(bug["exception"]) for bug in bugs] == [ZeroDivisionError] * 3

    virtual_time.run(main())


def test_a_shutdown_is_not_hidden_by_what_explains_it() -> None:
    machine = Machine(TwinNode())
    bugs: list[dict[str, Any]] = []

    async def check() -> None:
        bugs.extend(bugs_of_this_loop())
        machine.node.explain_shutdown(fail)
        machine.node.explain_shutdown(lambda reason: f"as was known of {reason}")
        machine.io.links[0].say(machine.twin.shutdown(asyncio.get_running_loop().time(), 1))
        await machine.changed_to(NodeState.SHUTDOWN)
        assert str(machine.node.failure) == (
            "node mainboard shut down: Timer too close (as was known of Timer too close)"
        )

    machine.run(machine.bus.start, check)
