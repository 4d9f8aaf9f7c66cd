"""An emergency stop over the interface, whatever else is asked and however badly."""

import json
import os
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.connection import REQUESTS_PER_TURN
from tests.coordinator.ipc.served import (
    Served,
    run,
)


def test_an_emergency_stop_overtakes_what_waits(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        for number in range(REQUESTS_PER_TURN - 2):
            script.send("machine.info", number + 10)
        script.send("machine.emergency_stop", 1)
        first = await script.receive()
        assert first["id"] == 1
        assert served.order[0] == "stop"

    run(tmp_path, body)


def test_what_is_asked_for_before_a_stop_knows_that_it_was_overtaken(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        for number, method in enumerate(("machine.info", "machine.emergency_stop", "machine.info")):
            script.send(method, number)
        assert [(await script.receive())["id"] for _ in range(3)] == [1, 0, 2]
        assert served.order == ["stop", "info, overtaken", "info"]

    run(tmp_path, body)


def test_an_emergency_stop_comes_through_when_nothing_else_does(tmp_path: Path) -> None:
    """All places to run and to wait are taken, answers are not read: it acts all the same."""

    async def body(served: Served) -> None:
        script = await served.script()
        limits = served.settings.limits
        for number in range(limits.running_requests + limits.pending_requests + 10):
            script.send("wait", 100 + number)
        for _ in range(10):
            assert (await script.receive())["error"]["code"] == "busy"
        script.send("machine.emergency_stop", 1)
        assert (await script.receive())["id"] == 1
        assert len(served.stops) == 1
        script.writer.close()
        await served.cancelled.wait()  # what ran for it ends with it

    run(tmp_path, body)


@pytest.mark.parametrize(
    ("params", "who", "ignored"),
    [
        ({"who": "me"}, "me", None),
        ({"who": "me", "reason": "x"}, "me", "has no parameter 'reason'"),
        ({"who": 5, "why": "fire"}, None, "who is 5, must be a string"),
        ({"who": "x" * 101}, None, "must be a string of at most 100 characters"),
        (["me"], None, "params must be a map"),
    ],
)
def test_an_emergency_stop_is_carried_out_whatever_its_parameters_are(
    tmp_path: Path, params: object, who: str | None, ignored: str | None
) -> None:
    async def body(served: Served) -> None:
        script = await served.script(client="red")
        message = {"id": 1, "method": "machine.emergency_stop", "params": params}
        script.writer.write(json.dumps(message).encode() + b"\n")
        result = (await script.receive())["result"]
        assert served.stops == [who or f"red (uid {os.getuid()}, pid {os.getpid()})"]
        assert result.pop("state") == "shutdown"
        assert (ignored or "None") in str(result.pop("ignored", None))
        assert not result
        watching = await served.script(scope="watch")
        watching.writer.write(json.dumps(message).encode() + b"\n")
        assert (await watching.receive())["error"]["code"] == "not_allowed"
        assert len(served.stops) == 1

    run(tmp_path, body)


def test_an_emergency_stop_is_carried_out_whatever_its_id_is(tmp_path: Path) -> None:
    """A script may give all its requests one id, or a name."""

    async def body(served: Served) -> None:
        for scope, stops in ((Scope.WATCH, 0), (Scope.OPERATE, 1)):
            script = await served.script(scope=scope.word)
            script.send("wait", 5)
            answer = await script.ask("machine.emergency_stop", 5)
            assert len(served.stops) == stops
            assert answer["id"] == 5
            if stops:
                assert answer["result"]["ignored"] == "the id 5 is that of a request without answer yet"
                assert (
                    "is that of a request without"
                    in (await script.ask("machine.info", 5))["error"]["message"]
                )
                script.send("api.cancel", 6, id=5)  # what has the id is found by it still
                found = {a["id"]: a for a in [await script.receive() for _ in range(2)]}
                assert found[6]["result"] == {"found": True}
            script.writer.write(b'{"id":"halt","method":"machine.emergency_stop"}\n')
            (end,) = await script.rest()
            assert end["error"]["code"] == "bad_message"
            assert ("carried out" in end["error"]["message"]) == bool(stops)
            assert len(served.stops) == 2 * stops

    run(tmp_path, body)
