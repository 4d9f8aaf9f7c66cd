"""A small, patient host for one simulated node, speaking through the twin of the wire protocol."""

from typing import Literal, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from tests import wire_twin
from tests.firmware import twin
from tests.stages.sim_node import SimNode, edge_clocks

NODE_ID = 4
TO_NODE, FROM_NODE = NODE_ID * 2 + 0x100, NODE_ID * 2 + 0x101


class NodeOptions(TypedDict, total=False):
    clock_freq: int
    move_count: int
    dictionary: bytes
    legacy: bool


class Host:
    """Sends one block at a time; keeps what the node says of its own accord in `unasked`.

    Frames with ids below 0x100 which the node sent gather in `signals`.
    """

    def __init__(
        self,
        *,
        start_clock: int = 0,
        transport: Literal["can", "uart"] = "uart",
        uuid: str = "0123456789ab",
        node_id: int = NODE_ID,
        learn: bool = True,
        **options: Unpack[NodeOptions],
    ) -> None:
        self.node = SimNode(uuid, start_clock, transport, **options)
        self.uuid, self.node_id = bytes.fromhex(uuid), node_id
        self.transport = transport
        self.words = twin.Vocabulary()
        self.seq = 0
        self.unasked: list[twin.Answer] = []
        self.signals: list[tuple[int, bytes]] = []
        if transport == "can":
            self.assign()
        self.first_words = self.read()
        if learn:
            self.words.raw, self.blob = twin.download(self.ask)
        self.receive()

    @property
    def now(self) -> int:
        return self.node.clock

    def assign(self) -> None:
        self.node.receive_frame(0x3F0, b"\x01" + self.uuid + bytes([self.node_id]))

    def write(self, data: bytes) -> None:
        if self.transport == "uart":
            self.node.receive_bytes(data)
            return
        for at in range(0, len(data), 8):
            self.node.receive_frame(self.node_id * 2 + 0x100, data[at : at + 8])

    def read(self) -> bytes:
        if self.transport == "uart":
            return self.node.take_bytes()
        frames = self.node.take_frames()
        from_node = self.node_id * 2 + 0x101
        self.signals += [frame for frame in frames if frame[0] < 0x100]
        data = [frame for frame in frames if frame[0] >= 0x100]
        assert {can_id for can_id, _ in data} <= {from_node}
        return b"".join(piece for _, piece in data)

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all blocks waiting, as (seq, content), and keep the answers."""
        found = list(twin.blocks(self.read()))
        self.unasked += [self.words.decode(seq, content) for seq, content in found if content]
        return found

    def send(self, *commands: str) -> list[twin.Answer]:
        """Send COMMANDS in one block, which must be acknowledged; return all answers."""
        before = len(self.unasked)
        self.write(wire_twin.block(self.seq, b"".join(self.words.encode(text) for text in commands)))
        self.seq = (self.seq + 1) & 15
        found = self.receive()
        assert found, "nothing came back"
        assert found[-1][0] == self.seq, "not acknowledged"
        answers = self.unasked[before:]
        del self.unasked[before:]
        return answers

    def pour(self, command: str, count: int) -> None:
        """Send a block of COUNT times COMMAND and take nothing of what comes back."""
        self.write(wire_twin.block(self.seq, self.words.encode(command) * count))
        self.seq = (self.seq + 1) & 15

    def fill(self) -> None:
        """Ask until the board takes no frames any more and the node stops executing."""
        while self.node.counters()["rx_overflow_bytes"] == 0:
            self.pour("get_uptime", 59)

    def fill_board(self) -> None:
        """Fill the board's room for frames, but not the node's own transmit buffer."""
        for _ in range(4096 + 4):
            self.pour("debug_nop", 1)

    def restart(self) -> None:
        """Power-cycle the node, and drop its first words."""
        self.node.reset()
        self.seq = 0
        self.receive()
        self.unasked.clear()

    def ask(self, command: str) -> twin.Answer:
        """Send a command with exactly one answer."""
        (answer,) = self.send(command)
        return answer

    def configure(self, *commands: str, oids: int = 16) -> None:
        """Bring the node into a configuration; it must be alive afterwards."""
        for command in (f"allocate_oids count={oids}", *commands, "finalize_config crc=1234"):
            assert self.send(command) == [], command
        state = self.ask("get_config")
        assert (state["is_config"], state["crc"], state["is_shutdown"]) == (1, 1234, 0)

    def run(self, ticks: int) -> list[twin.Answer]:
        """Let TICKS pass; return what the node said meanwhile, but for its periodic statistics."""
        self.node.run_until(self.now + ticks)
        self.receive()
        said, self.unasked = [a for a in self.unasked if a.name != "stats"], []
        return said

    def text(self, answer: twin.Answer) -> str:
        """Return the text of a shutdown."""
        texts: dict[int, str] = {
            number: text for text, number in self.words.raw["enumerations"]["static_string_id"].items()
        }
        return texts[answer["static_string_id"]]

    def dies(self, *commands: str, run: int = 0) -> str:
        """Send COMMANDS and let RUN ticks pass; return why the node shut down."""
        answers = self.send(*commands) if commands else []
        answers += self.run(run)
        reports = [answer for answer in answers if answer.name == "shutdown"]
        assert len(reports) == 1, f"{len(reports)} shutdowns: {answers}"
        assert self.ask("get_config")["is_shutdown"] == 1
        return self.text(reports[0])

    def steps(self, pin: int) -> npt.NDArray[np.uint64]:
        return edge_clocks(self.node.edges(), pin)
