"""A bus of slow Python nodes behind the API of the link: stands in for firmware where that is not the point.

Nodes answer through the project's own dictionary; frames and responses can get lost, from one seed.
"""

import asyncio
import json
import random
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nodes.bus.assign import Uuid
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.link import BusLoad, Forecast, Frame, IOStats, LinkError, LinkSettings, Response
from nodes.link.interfaces import OnFrame, OnLost, OnResponses
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID, BUS_STOP_ID

DATA = Path(__file__).parents[1] / "data" / "dictionary.json"
DELAY_S = 0.0003
SURVIVING = {
    "identify",
    "get_clock",
    "get_uptime",
    "get_config",
    "get_canbus_id",
    "emergency_stop",
    "reset",
    "config_reset",
}
"""Commands that a node takes when it is shut down."""


def source_of(**parts: Any) -> dict[str, Any]:
    """The small dictionary with PARTS replaced; a part of None is dropped."""
    source: dict[str, Any] = json.loads(DATA.read_text()) | parts
    return {key: value for key, value in source.items() if value is not None}


def with_canbus_id() -> dict[str, Any]:
    """The small dictionary of firmware that tells which board it runs on."""
    source = source_of()
    commands = source["commands"] | {"get_canbus_id": 101}
    responses = source["responses"] | {"canbus_id canbus_uuid=%.*s canbus_nodeid=%u": 102}
    return source_of(commands=commands, responses=responses)


def without_commands(*names: str) -> dict[str, Any]:
    commands = source_of()["commands"]
    return source_of(commands={text: i for text, i in commands.items() if text.split()[0] not in names})


@dataclass
class TwinNode:
    """What a node does with its commands. ``compressed`` is its dictionary as downloaded."""

    uuid: Uuid | None = None
    source: dict[str, Any] = field(default_factory=source_of)
    nodeid: int = 0
    set_command: int = 0x01
    ppm: float = 0.0
    start_ticks: int = 0
    crc: int = 0
    configured: bool = False
    shut_down: bool = False
    alive: bool = True
    strict_id: bool = False
    """Without its node id it hears nothing on its link."""
    says_uuid: Uuid | None = None
    """What it answers get_canbus_id with, where its dictionary has that."""
    compressed: bytes = b""
    executed: list[str] = field(default_factory=list)
    refuse: Callable[[Message], int | None] = lambda _: None
    """Returns the id of the text with which a command shuts the node down."""

    def __post_init__(self) -> None:
        text = json.dumps(self.source).encode()
        self.dictionary = Dictionary.from_json(text)
        self.compressed = self.compressed or zlib.compress(text)

    def ticks(self, now_s: float) -> int:
        return self.start_ticks + round(now_s * self.dictionary.clock_freq_hz * (1 + self.ppm * 1e-6))

    def response(self, name: str, **values: Value) -> bytes:
        return self.dictionary.responses[name].encode(values)

    def admin(self, data: bytes) -> bytes | None:
        if self.uuid is None or not self.alive:
            return None
        if data == b"\x00" and not self.nodeid:
            return bytes((0x20, *self.uuid.raw, self.set_command))
        if len(data) == 8 and data[0] == self.set_command:
            if data[1:7] == self.uuid.raw:
                self.nodeid = data[7]
            elif data[7] == self.nodeid:
                self.nodeid, self.shut_down = 0, True
        return None

    def reset(self) -> None:
        self.nodeid, self.crc, self.configured, self.shut_down = 0, 0, False, False

    def reboot(self) -> None:
        """Restart as a CAN node does: it forgets its id, and says nothing until it has one."""
        self.reset()
        self.strict_id = True

    def shutdown(self, now_s: float, text_id: int) -> bytes:
        self.shut_down = True
        return self.response("shutdown", clock=self.ticks(now_s) % (1 << 32), static_string_id=text_id)

    def execute(self, content: bytes, now_s: float) -> list[bytes]:
        messages = self.dictionary.decode_commands(content)
        assert messages is not None, content.hex()
        answers: list[bytes] = []
        for message in messages:
            self.executed.append(str(message))
            refused = self.refuse(message)
            if refused is not None and not self.shut_down:
                answers.append(self.shutdown(now_s, refused))
            else:
                answers += self._answer(message, now_s)
        return answers

    def _answer(self, message: Message, now_s: float) -> list[bytes]:
        if self.shut_down and message.name not in SURVIVING:
            return [self.response("is_shutdown", static_string_id=2)]
        handler = getattr(self, "_" + message.name, None)
        answer: bytes | None = handler(message, now_s) if handler else None
        return [answer] if answer else []

    def _identify(self, message: Message, _: float) -> bytes:
        offset, count = message.integer("offset"), message.integer("count")
        return self.response(
            "identify_response", offset=offset, data=self.compressed[offset : offset + count]
        )

    def _get_clock(self, _: Message, now_s: float) -> bytes:
        return self.response("clock", clock=self.ticks(now_s) % (1 << 32))

    def _get_uptime(self, _: Message, now_s: float) -> bytes:
        ticks = self.ticks(now_s)
        return self.response("uptime", high=ticks >> 32, clock=ticks % (1 << 32))

    def _get_config(self, _: Message, __: float) -> bytes:
        config = {"is_config": int(self.configured), "crc": self.crc, "is_shutdown": int(self.shut_down)}
        return self.response("config", **config, move_count=512 if self.configured else 0)

    def _emergency_stop(self, _: Message, now_s: float) -> bytes | None:
        return None if self.shut_down else self.shutdown(now_s, 2)

    def _reset(self, _: Message, __: float) -> None:
        self.reset()

    def _config_reset(self, _: Message, now_s: float) -> bytes | None:
        if not self.shut_down:  # as firmware does: only a stopped node forgets what it is
            return self.shutdown(now_s, 1)
        self.configured, self.crc, self.shut_down = False, 0, False
        return None

    def _finalize_config(self, message: Message, _: float) -> None:
        self.configured, self.crc = True, message.integer("crc")

    def _stepper_get_position(self, message: Message, _: float) -> bytes:
        oid = message.integer("oid")
        return self.response("stepper_position", oid=oid, pos=-100 * oid)

    def _get_canbus_id(self, _: Message, __: float) -> bytes:
        said = self.says_uuid or self.uuid
        assert said is not None
        return self.response("canbus_id", canbus_uuid=said.raw, canbus_nodeid=self.nodeid)

    def _debug_ping(self, message: Message, _: float) -> bytes:
        return self.response("pong", data=message.data("data"))


class TwinLink:
    """Delivers in order and keeps what it was told."""

    def __init__(
        self, io: "TwinIO", node: TwinNode | None, on_responses: OnResponses, on_lost: OnLost
    ) -> None:
        self.io, self.node = io, node
        self.on_responses, self.on_lost = on_responses, on_lost
        self.closed = False
        self._to_node: deque[tuple[bytes, int]] = deque()
        self._to_host: deque[tuple[bytes, int]] = deque()
        self.receive_window = 192
        self.clocks: list[tuple[float, int, int]] = []
        self.sent: list[tuple[bytes, int, int]] = []
        self.on_silent: Callable[[], None] = lambda: None
        self.patience_s: dict[bytes, float] = {}
        self.together: dict[bytes, int] = {}
        self.hurries: list[bool] = []
        self.waiting: deque[Response] = deque()
        """What has arrived and is handed over when it is asked for."""
        self.failure: LinkError | None = None
        """Raised by ``let_wait`` and ``hurry``."""

    def send(self, content: bytes, *, min_clock: int = 0, req_clock: int = 0, bulk: bool = False) -> None:
        assert not self.closed
        assert not bulk, "no test sends bulk data to a twin"
        self.sent.append((content, min_clock, req_clock))
        self._to_node.append((content, self.io.now_ns()))
        asyncio.get_running_loop().call_later(DELAY_S, self._arrive)

    def _arrive(self) -> None:
        # The loop's timers keep no order among equals; the queues do.
        content, sent_ns = self._to_node.popleft()
        loop = asyncio.get_running_loop()
        if self.node is None or not self.node.alive or self.closed:
            return
        if self.node.strict_id and not self.node.nodeid:
            return
        for answer in self.node.execute(content, loop.time()):
            self.say(answer, sent_ns)

    def say(self, answer: bytes, sent_ns: int = 0) -> None:
        """Let the node say ANSWER; it may get lost."""

        if self.io.source.random() >= self.io.loss:
            self._to_host.append((answer, sent_ns))
            asyncio.get_running_loop().call_later(DELAY_S, self._deliver)

    def _deliver(self) -> None:
        answer, sent_ns = self._to_host.popleft()
        if not self.closed:
            self.on_responses([Response(answer, sent_ns, self.io.now_ns())])

    def send_batch(self, buffer: bytes) -> None:
        raise NotImplementedError

    def send_urgent(self, content: bytes) -> None:
        self.send(content)

    async def drained(self) -> None:
        while self._to_node:  # noqa: ASYNC110  virtual time
            await asyncio.sleep(DELAY_S)

    def stats(self) -> dict[str, int]:
        return {"pending": len(self._to_node)}

    def set_receive_window(self, n: int) -> None:
        self.receive_window = n

    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> None:
        self.clocks.append((freq_hz, at_ns, at_ticks))

    def let_wait(self, message_id: bytes, seconds: float, together: int = 0) -> None:
        self._check()
        self.patience_s[message_id] = seconds
        self.together[message_id] = together

    def hurry(self, *, hurry: bool) -> None:
        self._check()
        self.hurries.append(hurry)

    def take(self) -> None:
        while self.waiting:
            self.on_responses([self.waiting.popleft()])

    def _check(self) -> None:
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        self.closed = True


class TwinIO:
    """The I/O of a bus with NODES on it; on a UART the first node is the only one."""

    def __init__(self, nodes: list[TwinNode], *, loss: float = 0.0, seed: int = 0) -> None:
        self.nodes, self.loss = nodes, loss
        self.source = random.Random(seed)
        self.links: list[TwinLink] = []
        self.settings: list[LinkSettings] = []
        self.on_frame: OnFrame | None = None
        self.on_closed: OnLost | None = None
        self.closed = False
        self.frames: list[tuple[int, bytes]] = []
        """Those of no link."""

    def __call__(self, *, on_frame: OnFrame | None, on_closed: OnLost) -> "TwinIO":
        self.on_frame, self.on_closed, self.closed = on_frame, on_closed, False
        return self

    @staticmethod
    def now_ns() -> int:
        return round(asyncio.get_running_loop().time() * 1e9)

    def open_link(self, settings: LinkSettings, *, on_responses: OnResponses, on_lost: OnLost) -> TwinLink:
        nodes = (
            self.nodes if settings.nodeid is None else [n for n in self.nodes if n.nodeid == settings.nodeid]
        )
        link = TwinLink(self, nodes[0] if nodes else None, on_responses, on_lost)
        self.links.append(link)
        self.settings.append(settings)
        return link

    def learn_bitrate(self, bitrate: int) -> None:
        self.bitrate = bitrate

    def forecast(self) -> Forecast:
        raise AssertionError("a twin bus has no budget")

    def stats(self) -> IOStats:
        raise AssertionError("a twin bus counts nothing")

    def load(self) -> BusLoad:
        raise AssertionError("a twin bus measures nothing")

    def send_frame(self, can_id: int, data: bytes) -> None:
        assert can_id in (ADMIN_ID, BUS_STOP_ID)
        self.frames.append((can_id, data))
        for node in self.nodes if can_id == ADMIN_ID else ():
            answer = node.admin(data) if self.source.random() >= self.loss else None
            if answer is not None and self.source.random() >= self.loss:
                frame = Frame(ADMIN_RESPONSE_ID, answer, 0)
                asyncio.get_running_loop().call_later(DELAY_S, self._frame, frame)

    def _frame(self, frame: Frame) -> None:
        if self.on_frame is not None and not self.closed:
            self.on_frame(frame)

    def close(self) -> None:
        self.closed = True
