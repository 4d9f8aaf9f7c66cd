"""Several questions in one block: their answers, one that is lost, and what ends them."""

import asyncio

import pytest

from nodes.dictionary.message_format import MessageError
from nodes.node.errors import NodeLost, NodeShutdown
from nodes.node.request_reply import QUERY_TIMEOUT_S
from tests.nodes import virtual_time
from tests.nodes.node.talk_bench import BOTH, TalkBench
from tests.nodes.twin_bus import DELAY_S


def now_s() -> float:
    return asyncio.get_running_loop().time()


def test_one_block_asks_all_and_each_answer_says_what_was_asked() -> None:
    bench = TalkBench()

    async def main() -> None:
        before_s = now_s()
        answers = await bench.talk.ask_together(BOTH)
        assert now_s() - before_s == pytest.approx(2 * DELAY_S, abs=1e-6)
        assert [answer and answer.message.name for answer in answers] == ["config", "uptime"]
        [(content, _, _)] = bench.link.sent
        assert [answer and answer.asked_bytes for answer in answers] == [len(content)] * 2
        assert bench.twin.executed == ["get_config", "get_uptime"]

    virtual_time.run(main())


def test_what_is_not_answered_in_time_is_none_and_is_not_asked_again() -> None:
    bench = TalkBench()

    async def main() -> None:
        bench.twin.alive = False
        before_s = now_s()
        asking = asyncio.ensure_future(bench.talk.ask_together(BOTH))
        await asyncio.sleep(0.1)
        bench.link.say(bench.twin.response("uptime", high=0, clock=5))
        answers = await asking
        assert now_s() - before_s == pytest.approx(QUERY_TIMEOUT_S, abs=1e-6)
        assert answers[0] is None
        assert answers[1] is not None
        assert len(bench.link.sent) == 1

    virtual_time.run(main())


def test_a_shutdown_ends_no_question_and_a_loss_ends_both() -> None:
    bench, bugs = TalkBench(), list[dict[str, object]]()

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: bugs.append(context))
        bench.twin.alive = False
        asking = asyncio.ensure_future(bench.talk.ask_together(BOTH))
        await asyncio.sleep(0.01)
        bench.talk.fail(NodeShutdown("it stopped"), shutdown=True)
        await asyncio.sleep(0.01)
        assert not asking.done()
        bench.talk.fail(NodeLost("it is gone"))
        with pytest.raises(NodeLost, match="it is gone"):
            await asking

    virtual_time.run(main())
    assert bugs == [], "the second failure is not reported as forgotten"


def test_a_message_that_the_firmware_lacks_is_not_asked_for() -> None:
    bench = TalkBench()

    async def main() -> None:
        with pytest.raises(MessageError, match="no response 'weather' to get_config"):
            await bench.talk.ask_together((("get_config", "weather"),))
        assert bench.link.sent == []

    virtual_time.run(main())
