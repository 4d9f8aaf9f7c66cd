"""A serial host on a service in virtual time: what OctoPrint sends, and what comes back."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from coordinator.front_ends.log_file import STATISTICS_S, ServiceLog
from coordinator.serial_host.host import BUSY_S, SerialHost
from coordinator.serial_host.protocol import BUSY
from tests.coordinator.serial_host.framing import numbered
from tests.stages.printer import PRINTING, Printer
from tests.stages.served import Served

LIMIT_S = 120.0


class Line:
    """The serial line between a host and the service."""

    def __init__(self, served: Served) -> None:
        self._news = asyncio.Event()
        self.lines: list[str] = []
        """Read by the host and not looked at yet."""
        self.host = SerialHost(served.service, self._read)

    def _read(self) -> None:
        data = self.host.protocol.output
        self.host.protocol.sent(len(data))
        self.lines += data.decode().splitlines()
        self._news.set()

    def send(self, data: bytes) -> None:
        self.host.receive(data)

    async def ask(self, *texts: str) -> list[str]:
        """Send lines at once; return what comes until the last one's ``ok``."""
        self.send("".join(f"{text}\n" for text in texts).encode())
        return await self.answers(len(texts))

    async def answers(self, count: int) -> list[str]:
        """Return all lines up to the ``ok`` number COUNT."""
        async with asyncio.timeout(LIMIT_S):
            while True:
                ends = [n for n, line in enumerate(self.lines) if line.split(" ")[0] == "ok"]
                if len(ends) >= count:
                    found, self.lines = self.lines[: ends[count - 1] + 1], self.lines[ends[count - 1] + 1 :]
                    return found
                self._news.clear()
                await self._news.wait()


@asynccontextmanager
async def connected(served: Served) -> AsyncIterator[Line]:
    line = Line(served)
    served.listeners.append(line.host.note)
    line.host.start()
    try:
        yield line
    finally:
        served.listeners.remove(line.host.note)
        await line.host.close()


def test_a_host_connects_prints_and_stops(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING)
    log = tmp_path / "canductor.log"

    async def main(served: Served) -> None:
        kept = ServiceLog(served.service, printer.config, log)
        served.listeners.append(kept.note)
        async with connected(served) as line:
            await _check_hello(line)
            await _check_replies(line)
            await _check_print(line, served)
            await _check_restart(line, served)
            await _check_stop(line, served)
        await asyncio.sleep(STATISTICS_S)
        served.service.log.add("notice", "bell \x07 and\nsecond line")
        await kept.close()

    printer.serve(main)
    text = log.read_text(encoding="utf-8")
    assert text.startswith("======== canductor ")
    assert f"configuration file: {printer.config}" in text
    assert text.count("======== configuration\n") == 1 + 1, "of each start"
    assert "[virtual_sdcard]\npath = jobs\n" in text
    assert " state: shutdown: emergency stop by M112 of the serial host\n" in text
    statistics = [line for line in text.splitlines() if " statistics: " in line]
    assert "nodes.toolhead.bytes_sent=" in statistics[-1]
    assert "temperature=" in statistics[-1]
    assert "notice: bell ? and\n    second line\n" in text
    assert all(line.isprintable() for line in text.splitlines())


async def _check_hello(line: Line) -> None:
    for _ in range(3):
        line.send(numbered(0, "M110 N0"))
    line.send(numbered(1, "M115"))
    *oks, firmware = await line.answers(4)
    assert oks == ["ok"] * 3
    assert firmware.startswith("ok FIRMWARE_NAME:canductor FIRMWARE_VERSION:")
    (temperatures,) = await line.ask("M105")
    assert temperatures.startswith("ok B:")
    assert " T0:" in temperatures
    assert await line.ask("", "; nothing", "M110") == ["ok"] * 3


async def _check_replies(line: Line) -> None:
    *plain, ok = await line.ask("M114")
    assert (len(plain), ok) == (1, "ok")
    assert plain[0].startswith("X:")
    unknown, ok = await line.ask("M155 S2")
    assert unknown.startswith("// ")
    assert "M155" in unknown
    assert await line.ask("RESPOND TYPE=command MSG=action:pause") == ["// action:pause", "ok"]
    error, _ = await line.ask("G1 X(")
    assert error.startswith("!! ")
    line.send(numbered(2, "G90").replace(b"G90", b"G91"))
    assert await line.answers(1) == ["Resend: 2", "ok"]
    line.send(numbered(2, "G90"))
    assert await line.answers(1) == ["ok"]


async def _check_print(line: Line, served: Served) -> None:
    job = ["G28", "G90", "M83", "G1 Z1 F600", "M109 S210"]
    job += [f"G1 X{20 + 20 * (n % 2)} Y{20 + n} E0.5 F6000" for n in range(40)]
    heard: list[str] = []
    for number, text in enumerate(job, 3):
        line.send(numbered(number, text))
        heard += await line.answers(1)
    assert heard.count("ok") == len(job)
    assert BUSY in heard, "heating takes longer than a host waits"
    assert all(text in ("ok", BUSY) or text.startswith("B:") for text in heard), heard
    await line.ask("M400")
    began_s = served.service.now_s
    for number in range(100):  # 2 s of motion, each line when the one before it is acknowledged
        assert await line.ask(f"G1 X{40 + number / 2} F1500") == ["ok"]
    assert served.service.now_s - began_s < 0.5, "a host that waits for each ok keeps the planner supplied"
    answers = [text for text in await line.ask("G1 X9999", "G4 P1") if text != BUSY]
    assert [text[:3] for text in answers] == ["ok", "!! ", "ok"], "before the answer of what comes behind it"
    reply = await line.ask("M114")
    assert reply[0].startswith("X:89.500 Y:59.000")
    assert reply[1:] == ["ok"]
    began_s = served.service.now_s
    assert await line.ask("G4 P9000") == [BUSY] * int((served.service.now_s - began_s) / BUSY_S) + ["ok"]
    assert served.planned[:2] == (89.5, 59.0)


async def _check_restart(line: Line, served: Served) -> None:
    await line.ask("M400")
    line.send(b"RESTART\n")
    # Sent while it starts: M105 and M115 are answered at once, what comes then when the machine is ready.
    await served.until_state("startup")
    line.send(b"M105\nM115\nM21\n")
    found = await line.answers(4)
    assert "// Klipper state: Disconnect" in found
    assert "ok T:0" in found
    assert found.index("// Klipper state: Ready") > found.index("ok T:0")
    await served.until_state("ready")


async def _check_stop(line: Line, served: Served) -> None:
    line.send(b"G28\n" + b"G4 P60000\n" * 500 + b"G1 X1\n")
    await asyncio.sleep(1.0)
    line.lines.clear()
    line.send(b"G4 P60000\nN9 M112*1\n")
    assert served.service.cause == "emergency stop by M112 of the serial host", "before receive returns"
    found = await line.answers(2)
    assert "// Klipper state: Shutdown" in found
    assert sum(text.startswith("!! ") for text in found) == 1, "what waited is forgotten"
    (temperatures,) = await line.ask("M105")
    assert temperatures.startswith("ok B:")
    error, *_, ok = await line.ask("G28")
    assert error.startswith("!! ")
    assert ok == "ok"
