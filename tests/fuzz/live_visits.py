"""Visits of clients that are random, wrong, slow or rude to a service that runs.

Usage: python -m tests.fuzz.live_visits SOCKET PORT TOKEN SEED; ends with its standard input. What they may do
over TCP is what TOKEN gives, and over the socket what its owner's programs may. After a line ``rest`` on
standard input nobody comes any more until a line ``go``.

Every visit is made from a seed. What the server says must always be readable, whoever it cuts off is told
why, and no method may fail by a mistake of the program; ``problems`` has the seeds of those where it was not.
"""

import asyncio
import json
import os
import random
import socket
import struct
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.client import Client
from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import Encoding, WireReader
from tests.fuzz.ipc_target import line, packed

ENDS: Final = frozenset(
    (
        *("bad_message", "too_long", "too_deep", "timeout", "no_hello", "bad_version", "no_token"),
        *("bad_token", "too_many_failures", "not_reading", "busy", "closing", "bad_params", "no_such_method"),
    )
)
"""Why a connection may be ended; the last two are told of a hello."""
PATIENCE_S: Final = 10.0
"""For the server to end a connection that it must end."""
WILD: Final[tuple[Any, ...]] = (
    *(
        None,
        True,
        0,
        -1,
        1,
        2**31,
        2**53,
        2**63 - 1,
        -(2**63),
        0.5,
        1e308,
        -0.0,
        "",
        "x" * 3000,
        "ü\0\x1b[2J",
    ),
    *("%s%n{0}", "../../etc/passwd", "*", [], [[[[]]]], {}, {"a": {"b": [None]}}, ["*"] * 70, "9" * 400),
    *(["*a*b*c"], ["*a" * 60] * 64),
)


@dataclass
class Tally:
    """What became of all visits."""

    counts: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Site:
    """Where to go, and what can be asked there."""

    path: Path
    port: int
    token: str
    methods: tuple[dict[str, Any], ...]
    """As api.methods lists them."""


class Visit:
    """One connection, from its SEED."""

    def __init__(self, site: Site, seed: int, tally: Tally) -> None:
        self._site = site
        self._seed = seed
        self._tally = tally
        self._chance = random.Random(seed)
        self._over_tcp = self._chance.random() < 0.5
        self._json = self._chance.random() < 0.4
        self._sent_first: int | None = None
        self._left = False
        self._must_hear = False

    async def go(self) -> None:
        """Connect, send, leave."""
        reader, writer = await self._connect()
        reading = asyncio.ensure_future(self._read(reader))
        self._tally.counts["visits"] += 1
        try:
            await self._behave(writer, reading)
        except OSError:
            pass  # cut off while it was still sending
        finally:
            self._left = True
            writer.transport.abort()
            with suppress(OSError, TimeoutError):
                await asyncio.wait_for(reading, PATIENCE_S)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if not self._over_tcp:
            return await asyncio.open_unix_connection(str(self._site.path), limit=1 << 24)
        # Each address has its own brake for wrong tokens; one alone would be shut out most of the time.
        source = f"127.0.{self._chance.randrange(1, 200)}.{self._chance.randrange(1, 250)}"
        return await asyncio.open_connection(
            "127.0.0.1", self._site.port, local_addr=(source, 0), limit=1 << 24
        )

    # -------------------------------------------------------------------------------------- behaviour

    async def _behave(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        chance = self._chance
        behaviour = chance.choice(
            (self._talk, self._talk, self._dribble, self._break_off, self._attack, self._deaf)
        )
        self._tally.counts[behaviour.__name__.strip("_")] += 1
        await behaviour(writer, reading)

    async def _talk(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        """Send it all, leave when the answers are there, or without waiting."""
        del reading
        self._send(writer, self._stream())
        with suppress(TimeoutError):
            await asyncio.wait_for(writer.drain(), 2.0)
        await asyncio.sleep(self._chance.choice((0.0, 0.05, 0.3)))

    async def _dribble(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        """Send it in small pieces, with pauses that cut messages."""
        data, at = self._stream()[:3000], 0
        while at < len(data) and not reading.done():
            size = self._chance.choice((1, 2, 3, 17, 120, 700))
            self._send(writer, data[at : at + size])
            at += size
            await asyncio.sleep(self._chance.choice((0.0, 0.0, 0.002, 0.02)))

    async def _break_off(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        """Disconnect at any byte: by reset, in order, or by closing one's own side and listening on."""
        del reading
        data = self._stream()
        self._send(writer, data[: self._chance.randrange(len(data) + 1)])
        how = self._chance.randrange(3)
        opened = writer.get_extra_info("socket")
        if how == 0:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        elif how == 1:
            self._left = True  # may end without a word
            writer.write_eof()
            await asyncio.sleep(0.1)

    async def _attack(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        """Do what must end the connection, and wait for that."""
        hello = self._write(self._hello()) if self._chance.random() < 0.5 else b""
        first = not hello
        self._must_hear = True
        attacks = [
            hello + struct.pack(">I", 2**24 - 1) if not self._json else hello + b'{"' + b"x" * 270_000,
            hello + self._write({"id": 1, "method": "x"})[:-1],
            hello + self._deep(),
        ]
        if first:
            attacks += [b"", b"GET / HTTP/1.0\r\n\r\n", self._write({"id": 1, "method": "machine.state"})]
            wrong = {"version": 1, "token": "".join(self._chance.choices("abc", k=40))}
            attacks.append(self._write({"id": 1, "method": "api.hello", "params": wrong}))
        self._send(writer, self._chance.choice(attacks))
        done, _ = await asyncio.wait((reading,), timeout=PATIENCE_S)
        if not done:
            self._problem("an attack did not end the connection")

    def _deep(self) -> bytes:
        depth = self._chance.choice((17, 500, 50_000))
        if self._json:
            return b'{"a":' + b"[" * depth + b"]" * depth + b"}\n"
        body = b"\x81\xa1a" + b"\x91" * depth + b"\xc0"
        return struct.pack(">I", len(body)) + body

    async def _deaf(self, writer: asyncio.StreamWriter, reading: asyncio.Future[None]) -> None:
        """Subscribe to everything, ask for more, and read nothing for a while."""
        del reading
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        data = self._write(self._hello())
        data += self._write({"id": 2, "method": "api.watch", "params": {"rate_hz": 50}})
        data += self._write({"id": 3, "method": "api.listen", "params": {"events": ["*"]}})
        asked = self._chance.choice(("api.methods", "state.get", "motion.dump", "log.tail"))
        data += b"".join(
            self._write({"id": 4 + i, "method": asked}) for i in range(self._chance.randrange(40))
        )
        self._send(writer, data)
        await asyncio.sleep(self._chance.choice((0.2, 1.0, 2.0)))
        if self._chance.random() < 0.7:
            writer.transport.resume_reading()  # type: ignore[attr-defined]
            await asyncio.sleep(0.2)

    # --------------------------------------------------------------------------------------- messages

    def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        if data and self._sent_first is None:
            self._sent_first = data[0]
        self._tally.counts["bytes sent"] += len(data)
        writer.write(data)

    def _write(self, message: object) -> bytes:
        return line(message) if self._json else packed(message)

    def _hello(self) -> dict[str, Any]:
        params: dict[str, Any] = {"version": 1, "client": "fuzzer"}
        if self._over_tcp:
            params["token"] = self._site.token
        return {"id": 1, "method": "api.hello", "params": params}

    def _stream(self) -> bytes:
        """Return a hello and some requests, some of them wrong, and some of their bytes."""
        chance = self._chance
        if chance.random() < 0.05:
            return chance.randbytes(chance.randrange(1, 2000))
        messages = [self._hello()] + [self._request(number) for number in range(chance.randrange(1, 40))]
        data = bytearray(b"".join(map(self._write, messages)))
        if chance.random() < 0.5:
            self._damage(data)
        return bytes(data)

    def _request(self, number: int) -> dict[str, Any]:
        chance, method = self._chance, self._chance.choice(self._site.methods)
        params: dict[str, Any] = {}
        for param in method["params"]:
            if param.get("required", True) or chance.random() < 0.4:
                params[param["name"]] = self._value(param)
        if chance.random() < 0.1:
            params[chance.choice(("", "x", "token", "%s"))] = chance.choice(WILD)
        self._tally.counts["requests sent"] += 1
        message = {"id": number + 2, "method": method["name"], "params": params}
        if chance.random() < 0.05:
            message[chance.choice(("id", "method", "params"))] = chance.choice(WILD)
        if chance.random() < 0.05:
            del message[chance.choice(("id", "method", "params"))]
        return message

    def _value(self, param: dict[str, Any]) -> Any:
        chance = self._chance
        if chance.random() < 0.15:
            return chance.choice(WILD)
        low, high = param.get("low", 0), min(param.get("high", 100), 100)
        sound = {
            "bool": chance.random() < 0.5,
            "int": chance.randint(int(low), max(int(low), int(high))),
            "float": chance.uniform(low, max(low, high)),
            "str": chance.choice(
                param.get("choices") or ["part.gcode", "M114", "G28", "mcu", "get_uptime", "x"]
            ),
            "list": chance.choice((["*"], ["nodes.*", "job.?"], ["position.commanded"], [])),
            "map": chance.choice(({}, {"a": 1})),
        }
        return sound.get(param["kind"], chance.choice(WILD))

    def _damage(self, data: bytearray) -> None:
        chance = self._chance
        for _ in range(chance.randrange(1, 6)):
            at = chance.randrange(len(data))
            match chance.randrange(4):
                case 0:
                    data[at] ^= 1 << chance.randrange(8)
                case 1:
                    data[at:at] = chance.randbytes(chance.randrange(1, 9))
                case 2:
                    del data[at : at + chance.randrange(1, 9)]
                    data += b"\n"
                case _:
                    data += data[at : at + 50]

    # ---------------------------------------------------------------------------------------- answers

    async def _read(self, reader: asyncio.StreamReader) -> None:
        """Read until the server ends it or the visit is over, and look at every message."""
        parser, last, raw = WireReader(Limits(message_bytes=2**24 - 1), checked=False), {}, 0
        while data := await self._receive(reader):
            if parser.encoding is None:
                parser.encoding = self._encoding_of(data)
            raw += len(data)
            parser.feed(data, 0.0)
            while (message := parser.next_message()) is not None:
                if isinstance(message, EndReason):
                    self._problem(f"it said what is no message: {message.sentence}")
                    return
                last = message
                self._look(message)
        self._tally.counts["bytes received"] += raw
        if not self._left:
            code = last.get("error", {}).get("code") if "id" not in last else None
            self._tally.counts[f"ended: {code}"] += 1
            if code not in ENDS:
                self._problem(f"it was cut off without a reason; last came {str(last)[:100]}")

    def _encoding_of(self, data: bytes) -> Encoding:
        """Return the encoding of what came first. JSON is also for whom it did not hear in time."""
        sent = Encoding.MSGPACK if self._sent_first == 0 else Encoding.JSON
        came = Encoding.MSGPACK if data[0] == 0 else Encoding.JSON
        if came is not sent and b'"timeout"' not in data:
            self._problem(f"it spoke {came.name} to one who spoke {sent.name}: {data[:200]!r}")
        return came

    async def _receive(self, reader: asyncio.StreamReader) -> bytes:
        try:
            return await reader.read(1 << 18)
        except ConnectionError:
            if self._must_hear:
                self._problem("it was reset, and not told why")
            self._left = True  # by its own doing, or the reason is lost with what was unread
            self._tally.counts["reset"] += 1
            return b""

    def _look(self, message: dict[str, Any]) -> None:
        self._tally.counts["messages received"] += 1
        error = message.get("error")
        if "id" in message:
            self._tally.counts[f"answered: {'with a result' if error is None else error['code']}"] += 1
        if error is None:
            if not message.keys() & {"id", "event"}:
                self._problem(f"a message means nothing: {str(message)[:100]}")
            return
        if error["code"] == "internal" or "\n" in error["message"] or not error["message"]:
            self._problem(f"{error['code']}: {error['message']}")

    def _problem(self, sentence: str) -> None:
        self._tally.problems.append(f"seed {self._seed}: {sentence}")


async def pester(site: Site, seed: int, orders: "Orders", *, at_once: int = 16) -> Tally:
    """Visit SITE, AT_ONCE at a time, until ORDERS end."""
    tally, seeds = Tally(), iter(range(seed, seed + 2**31))

    async def go_on() -> None:
        while await orders.may_go_on():
            visit = Visit(site, next(seeds), tally)
            try:
                await visit.go()
            except OSError as error:
                tally.problems.append(f"no way in: {error}")
                await asyncio.sleep(0.1)

    await asyncio.gather(*(go_on() for _ in range(at_once)))
    return tally


class Orders:
    """What standard input says: ``rest``, ``go``, or its end."""

    def __init__(self) -> None:
        self._ended = False
        self._go = asyncio.Event()
        self._go.set()
        asyncio.get_running_loop().add_reader(sys.stdin, self._read)

    def _read(self) -> None:
        match os.read(sys.stdin.fileno(), 4096).split()[-1:]:  # what was said last counts
            case [b"rest"]:
                self._go.clear()
            case [b"go"]:
                self._go.set()
            case _:
                self._ended = True
                self._go.set()
                asyncio.get_running_loop().remove_reader(sys.stdin)

    async def may_go_on(self) -> bool:
        """Wait while it is to rest; return whether it has not ended."""
        await self._go.wait()
        return not self._ended


async def main() -> None:
    """Visit until standard input ends, and print what became of it."""
    path, port, token, seed = sys.argv[1:]
    async with Client(path) as client:
        methods = (await client.call("api.methods"))["methods"]
    tally = await pester(Site(Path(path), int(port), token, tuple(methods)), int(seed), Orders())
    sys.stdout.write(json.dumps({"counts": tally.counts, "problems": tally.problems}) + "\n")


if __name__ == "__main__":
    asyncio.run(main())
