"""The emergency stop as a request of its own, to a free loop; to a held one: ipc/server/test_stop_lane.py."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.auth import FAILURES_MAX
from coordinator.web.settings import WebSettings
from coordinator.web.stop_request import BODY_BYTES_MAX, STOP_PATH
from tests.coordinator.ipc.served import TOKENS, tokens_file
from tests.coordinator.web.paged import LOOPBACK, Paged, paging
from tests.stages import jump_loop


def run(
    folder: Path,
    go: Callable[[Paged], Coroutine[Any, Any, None]],
    page: WebSettings = LOOPBACK,
    **settings: Any,
) -> None:
    async def main() -> None:
        async with paging(folder, page, **settings) as paged:
            await go(paged)

    jump_loop.run(main())


@pytest.mark.parametrize("secret", [False, True], ids=["plain", "tls"])
def test_it_stops_the_machine(tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool) -> None:
    page = replace(LOOPBACK, certificate=certificate[0], private_key=certificate[1]) if secret else LOOPBACK

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        assert await paged.stop() == (200, {"state": "shutdown"})
        assert await paged.stop({"key": paged.key}) == (200, {"state": "shutdown"})
        assert await paged.stop({"key": paged.key, "who": 1}) == (200, {"state": "shutdown"}), "it is urgent"
        assert paged.served.stops == ["me"] + ["the live page (127.0.0.1)"] * 2

    run(tmp_path, go, page)


@pytest.mark.parametrize("scope", Scope)
def test_the_scope_of_the_token_counts(tmp_path: Path, scope: Scope) -> None:
    async def go(paged: Paged) -> None:
        await paged.log_in(TOKENS[scope])
        status, told = await paged.stop({"key": paged.key})
        if scope is Scope.WATCH:
            assert (status, told["code"]) == (403, "not_allowed")
            assert paged.served.stops == []
        else:
            assert status == 200
            assert paged.served.stops == [f"the live page (127.0.0.1, token of-{scope.word})"]
        paged.served.server._tokens = None
        assert (await paged.stop())[0] == 401, "the token was taken away"

    run(tmp_path, go, tokens=tokens_file(tmp_path))


def test_others_are_refused_and_counted(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        port, before = paged.page.port, paged.page.refused
        async with paged.other() as other:
            await other.sign_in()
            foreign = [
                (await paged.stop(Origin="http://evil.example"), 403, "not_allowed"),
                (await paged.stop(Origin="null"), 403, "not_allowed"),
                (await paged.stop(Origin=f"http://127.0.0.1:{port + 1}"), 403, "not_allowed"),
                (await replace(paged, key=other.key).stop(), 403, "bad_token"),
                (await replace(paged, key="x" * 43).stop(), 403, "bad_token"),
                (await paged.stop({}), 400, "bad_message"),
                (await paged.stop(b"{"), 400, "bad_message"),
                (await paged.stop([1]), 400, "bad_message"),
            ]
        async with paged.other() as stranger:
            foreign.append((await replace(stranger, key=paged.key).stop(), 401, "no_token"))
        assert [(found[0], found[1]["code"]) for found, _, _ in foreign] == [
            (status, code) for _, status, code in foreign
        ]
        assert paged.page.refused == before + len(foreign)
        posted = paged.http.post(
            f"{paged.at}{STOP_PATH}", data=b"{}", headers={"Origin": paged.at, "Host": "evil.example"}
        )
        async with posted as answer:
            assert answer.status == 403
        assert (await paged.stop(b"x" * (BODY_BYTES_MAX + 1)))[0] == 413
        async with paged.http.get(f"{paged.at}{STOP_PATH}", headers={"Origin": paged.at}) as answer:
            assert (answer.status, answer.headers["Allow"]) == (405, "POST")
        assert paged.served.stops == []
        assert (await paged.stop())[0] == 200, "nobody is shut out for what others try"

    run(tmp_path, go)


def test_who_guesses_tokens_keeps_nobody_from_stopping(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        key = paged.key
        for _ in range(FAILURES_MAX + 1):
            await paged.log_in("x" * 32)
        assert (await replace(paged, key=key).stop())[0] == 200

    run(tmp_path, go, tokens=tokens_file(tmp_path))


def test_a_stop_that_comes_in_parts_is_carried_out_once(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        data = paged.stop_request()
        reader, writer = await asyncio.open_connection("127.0.0.1", paged.page.port)
        for at in range(0, len(data), 50):
            assert paged.served.stops == []
            writer.write(data[at : at + 50])
            await asyncio.sleep(0.1)
        assert paged.served.stops == ["me"]
        writer.write(data)
        await asyncio.sleep(0.1)
        assert paged.served.stops == ["me"] * 2
        assert (await reader.read(65_536)).count(b"HTTP/1.1 200 ") == 2
        writer.close()

    run(tmp_path, go)
