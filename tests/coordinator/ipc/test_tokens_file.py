"""The tokens' file changes while the server runs."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.server.server import TOKENS_CHECK_S
from coordinator.ipc.server.settings import TcpSettings
from tests.coordinator.ipc.served import Script, Served, serving
from tests.stages import jump_loop

OLD, NEW, THIRD = "o" * 32, "n" * 32, "t" * 32


def write(path: Path, text: str, mode: int = 0o600) -> None:
    fresh = path.with_suffix(".new")
    fresh.write_text(text)
    fresh.chmod(mode)
    fresh.rename(path)


async def hello(served: Served, token: str) -> tuple[Script, dict[str, Any]]:
    script = Script(*await served.dial(tcp=True))
    return script, await script.ask("api.hello", version=1, token=token)


async def notice(served: Served) -> str:
    async with asyncio.timeout(2 * TOKENS_CHECK_S):
        return await served.notices.get()


def test_tokens_come_and_go_without_a_restart(tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    write(tokens, f"operate phone {OLD}\nadmin desk {THIRD}\n")

    async def body() -> None:
        tcp = TcpSettings(host="127.0.0.1", port=0, tokens=tokens, plain_on_loopback=True)
        async with serving(tmp_path, tcp=tcp) as served:
            phone, said = await hello(served, OLD)
            assert said["result"]["scope"] == "operate"
            desk, _ = await hello(served, THIRD)
            write(tokens, f"watch tablet {NEW}\nadmin desk {THIRD}\n")
            assert "read again" in await notice(served)
            (end,) = await phone.rest()
            assert end == {"error": {"code": "bad_token", "message": "the token was revoked"}}
            assert (await hello(served, OLD))[1]["error"]["code"] == "bad_token"
            tablet, said = await hello(served, NEW)
            assert said["result"]["scope"] == "watch"
            write(tokens, f"watch tablet {NEW}\nwatch desk {THIRD}\n")  # less than the desk came in with
            assert "read again" in await notice(served)
            assert (await desk.rest())[-1]["error"]["code"] == "bad_token"
            assert "result" in await tablet.ask("machine.info")

    jump_loop.run(body())


@pytest.mark.parametrize(
    ("text", "mode", "sentence"),
    [
        (f"king phone {OLD}", 0o600, "line 1: must be SCOPE NAME TOKEN"),
        (f"operate phone {OLD}", 0o640, "chmod 600"),
        (None, 0, "cannot be read"),
    ],
)
def test_while_the_file_cannot_be_read_nobody_new_comes_in(
    tmp_path: Path, text: str | None, mode: int, sentence: str
) -> None:
    tokens = tmp_path / "tokens"
    write(tokens, f"operate phone {OLD}\n")

    async def body() -> None:
        tcp = TcpSettings(host="127.0.0.1", port=0, tokens=tokens, plain_on_loopback=True)
        async with serving(tmp_path, tcp=tcp) as served:
            phone, _ = await hello(served, OLD)
            if text is None:
                tokens.unlink()
            else:
                write(tokens, text, mode)
            told = await notice(served)
            assert sentence in told
            assert "until then no token is accepted" in told
            for _ in range(8):  # which is no fault of theirs: nobody is shut out for it
                assert (await hello(served, OLD))[1]["error"]["code"] == "bad_token"
            assert "result" in await phone.ask("machine.info")  # who is in may go on
            write(tokens, f"operate phone {OLD}\n")
            assert "read again" in await notice(served)
            assert "result" in (await hello(served, OLD))[1]

    jump_loop.run(body())
