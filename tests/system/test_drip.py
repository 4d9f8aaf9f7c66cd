"""A program of any length over a serial line into a machine on virtual nodes: paused, cut off, begun anew."""

import asyncio
from pathlib import Path
from typing import Any

from coordinator.ipc.client import Client
from tests.coordinator.dnc.cable import Cable
from tests.stages.processes import Command, Hardware

LIMIT_S = 120.0
LINES = 20_000
"""Far more than wait for the machine anywhere, planned moves included."""
FAST = ("--baud", "115200", "--silence", "0.05")


def write_program(folder: Path, name: str, lines: int) -> None:
    """Write a program of LINES that goes along X and back at constant speed, 2 ms a line."""
    text = ["G28", "G90", "G1 X20 Y20 F6000"]
    text += [f"G1 X{20 + (n if n < 500 else 1000 - n) / 5:g}" for n in (i % 1000 for i in range(lines))]
    (folder / name).write_text("\n".join(text[:lines]) + "\n", encoding="utf-8")


async def until(client: Client, **wanted: Any) -> dict[str, Any]:
    """Wait until fields of the job are as WANTED: values, or what they have to exceed."""
    seen: dict[str, Any] = {}
    async for update in client.watch(["job.*", "position.*"], rate_hz=20):
        seen.update(update.values)
        fields = {name: seen.get(f"job.{name}") for name in wanted}
        if all(
            value > wanted[name] if isinstance(value, int) else value == wanted[name]
            for name, value in fields.items()
        ):
            return seen
    raise AssertionError("the machine is gone")


async def stops(cable: Cable, client: Client) -> int:
    """Return how much the peripheral had sent when it was left without an answer for half a second."""
    before = -1
    while cable.carried[0] != before:
        before = cable.carried[0]
        await asyncio.sleep(0.5)
        assert (await client.call("job.status"))["state"] == "paused"
    return before


async def drip(client: Client, cable: Cable, sock: Path, serve: Command) -> None:
    words = ("dnc", "drip", "--from", "LONG", "-p", cable.names[1], *FAST, "--at", sock)
    with Command(*words, "--answer-timeout", "2") as feeding:
        await until(client, state="printing", line=100)
        await client.call("job.pause")
        await until(client, state="paused")
        sent = await stops(cable, client)
        told = await client.call("job.status")
        assert told["file"] == "LONG"
        assert 100 < told["line"] < told["lines_fed"] < LINES // 4, "it does not wait for the machine"
        await asyncio.sleep(2.4)  # longer than patience: the pause is the machine's
        assert cable.carried[0] == sent
        await client.call("job.resume")
        await until(client, state="printing", lines_fed=told["lines_fed"] + 100)
        serve.process.kill()  # the peripheral dies midway
        seen = await until(client, state="failed")
        count, message = seen["job.lines_fed"], seen["job.message"]
        assert message == (
            f"LONG: nothing came after line {count}, the last one that came in time; check the cable, the"
            f" other side and its settings; all that came, to line {count}, is carried out"
        )
        assert seen["position.moving"] is False
        ended = feeding.end()
        assert ended.sentence().startswith(f"LONG: nothing came after line {count}")


async def killed(client: Client, cable: Cable, sock: Path) -> None:
    with Command("dnc", "drip", "--from", "LONG", "-p", cable.names[1], *FAST, "--at", sock) as feeding:
        await until(client, state="printing", line=50)
        feeding.process.kill()
        seen = await until(client, state="failed")
        assert seen["job.message"].startswith("LONG: the client 'canductor dnc")
        assert "left; all that came, to line" in seen["job.message"]
        assert seen["position.moving"] is False


async def control_sends(client: Client, cable: Cable, sock: Path, programs: Path) -> None:
    with Command("dnc", "drip", "--from-control", "-p", cable.names[1], *FAST, "--at", sock) as feeding:
        feeding.stderr.wait_for("waiting for a control")
        with Command(
            "dnc", "send", programs / "SHORT.nc", "--name", "THEIRS", "-p", cable.names[0], *FAST
        ) as control:
            seen = await until(client, state="done", file="THEIRS")
            assert (seen["job.line"], seen["job.lines_fed"]) == (300, 300)
            assert control.end().status == 0
        ended = feeding.end()
        assert (ended.status, ended.stdout) == (0, "THEIRS: 300 lines were printed as they came\n")


def test_drip(machine: Hardware) -> None:
    programs, sock = machine.folder / "programs", machine.folder / "run.sock"
    programs.mkdir()
    write_program(programs, "LONG.nc", LINES)
    write_program(programs, "SHORT.nc", 300)

    async def main(cable: Cable) -> None:
        serve = ("dnc", "serve", programs, "-p", cable.names[0], *FAST, "--answer-timeout", "60")
        async with asyncio.timeout(LIMIT_S), Client.connect(str(sock)) as client:
            with Command(*serve) as server:
                server.stderr.wait_for("serving")
                await drip(client, cable, sock, server)
            with Command(*serve) as server:
                server.stderr.wait_for("serving")
                await killed(client, cable, sock)
            await control_sends(client, cable, sock, programs)

    with Command("run", machine.config, "--ipc", sock) as command, Cable() as cable:
        command.stdout.wait_for("ready")
        asyncio.run(main(cable))
