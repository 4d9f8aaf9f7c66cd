"""The gateway's Unix socket, with real sockets in virtual time, before there is any machine."""

import asyncio
import json
import socket
import stat
from pathlib import Path
from typing import Any, NoReturn

import pytest

from coordinator.cli import main as cli
from coordinator.ipc.server.state import StateTree
from coordinator.klippy_api.gateway import CLIENTS_MAX, Gateway
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from nodes.support.errors import CanductorError
from tests.stages.jump_loop import run


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


def _gateway(notices: list[str]) -> Gateway:
    settings = ServiceSettings(name="test")
    service = MachineService(_load, LinuxHost(), StateTree(), settings, on_line=lambda _entry: None)
    return Gateway(service, Path("printer.cfg"), on_notice=notices.append)


async def _ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, method: str) -> Any:
    writer.write(json.dumps({"id": 1, "method": method}).encode() + b"\x03")
    return json.loads((await reader.readuntil(b"\x03"))[:-1])


def test_the_socket_is_the_owners_and_takes_the_place_of_a_stale_one(tmp_path: Path) -> None:
    path = tmp_path / "comms" / "klippy.sock"
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(path))

    async def main() -> None:
        notices: list[str] = []
        gateway = _gateway(notices)
        await gateway.start(path)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        with pytest.raises(CanductorError, match="another coordinator serves at"):
            await _gateway(notices).start(path)
        client = await asyncio.open_unix_connection(path)
        answer = await _ask(*client, "info")
        assert answer["result"]["state"] == "startup"
        assert "starting" in answer["result"]["state_message"]
        client[1].write(b'{"method": "info", "id": "cut off')
        others = [await asyncio.open_unix_connection(path) for _ in range(CLIENTS_MAX)]
        assert await others[-1][0].read() == b"", "one too many"
        assert [notice for notice in notices if f"{CLIENTS_MAX} clients" in notice] == notices[-1:]
        for _, writer in others:
            writer.close()
        client[1].write(b'"}\x03')
        assert json.loads((await client[0].readuntil(b"\x03"))[:-1])["id"] == "cut off"
        await gateway.close()
        assert await client[0].read() == b""
        client[1].close()
        assert not path.exists()

    run(main())


def test_a_path_that_cannot_be_served(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("mine")

    async def main() -> None:
        with pytest.raises(CanductorError, match="exists and is not a socket"):
            await _gateway([]).start(path)

    run(main())
    assert path.read_text() == "mine"


def test_the_word_goes_with_serving(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = str(tmp_path / "printer.cfg")
    words = ["run", config, "--klippy-api", str(tmp_path / "s"), "--gcode", config]
    (tmp_path / "printer.cfg").write_text("")
    assert cli.main(words) != 0
    assert "--gcode prints a file and exits" in capsys.readouterr().err
