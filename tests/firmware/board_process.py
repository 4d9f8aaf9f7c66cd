"""A node as a process: a real executable on a real socket or pseudo-terminal, and a patient host for it.

What is tested with it is the Linux board itself. A computer that stands still delays the answers and nothing
else: waits are for events, and PATIENCE_S only bounds the wait for a broken node.
"""

import json
import os
import select
import socket
import struct
import subprocess
from pathlib import Path

from tests import wire_twin
from tests.firmware import twin
from tests.firmware.host import FROM_NODE, NODE_ID, TO_NODE

BIN = Path(__file__).parents[2] / "nodes" / "virtual" / "bin"
UUID = "0123456789ab"
FREQUENCIES_HZ = {"mainboard": 168_000_000, "toolhead": 64_000_000, "uart": 16_000_000}
FRAME = struct.Struct("=IB3x8s")
PATIENCE_S = 60.0
ROLLOVER = 1 << 32
EXPIRED = 2
NS_PER_S = 1_000_000_000


class BoardProcess:
    """One node process; speaks CAN frames or plain bytes over a file descriptor; `close` ends it."""

    def __init__(self, folder: Path, flavour: str, *options: str, preload: Path | None = None) -> None:
        self.edge_log = folder / "edges"
        self.freq_hz = FREQUENCIES_HZ[flavour]
        self.on_can = flavour != "uart"
        self.signals: list[tuple[int, bytes]] = []
        """Frames it sent that are no data of its link."""
        self._listener = socket.socket(socket.AF_UNIX)
        link = ["--uart", str(folder / "tty")]
        if self.on_can:
            self._listener.bind(str(folder / "bus"))
            self._listener.listen()
            link = ["--can", str(folder / "bus"), "--uuid", UUID]
        executable = str(BIN / f"canductor-node-{flavour}")
        self.process = subprocess.Popen(
            [executable, *link, "--edge-log", str(self.edge_log), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | ({} if preload is None else {"LD_PRELOAD": str(preload)}),
        )
        assert self.process.stdout
        self.ready = json.loads(self.process.stdout.readline())
        if self.on_can:
            self._socket = self._listener.accept()[0]
            self._fd = self._socket.fileno()
        else:
            self._fd = os.open(self.ready["uart"], os.O_RDWR | os.O_NOCTTY)
        self.words = twin.Vocabulary()
        self.seq = 0
        self._raw = self._stream = b""

    def start(self) -> None:
        """Take up contact and download its dictionary."""
        if self.on_can:
            self.frame(0x3F0, b"\x00")
            assert self.read_signal() == (0x3F1, b"\x20" + bytes.fromhex(UUID) + b"\x01")
            self.frame(0x3F0, b"\x01" + bytes.fromhex(UUID) + bytes([NODE_ID]))
        else:
            seq, content = self.read_block()
            assert (seq, len(content)) == (0, 1), "starting"
        self.words.raw, _ = twin.download(lambda text: self.send(text)[0])

    def reopen(self) -> None:
        """Close its pseudo-terminal and open it again."""
        os.close(self._fd)
        self._fd = os.open(self.ready["uart"], os.O_RDWR | os.O_NOCTTY)

    def frame(self, can_id: int, data: bytes) -> None:
        """Send one CAN frame."""
        os.write(self._fd, FRAME.pack(can_id, len(data), data))

    def _more(self) -> bytes:
        assert select.select([self._fd], [], [], PATIENCE_S)[0], "the node is silent"
        return os.read(self._fd, 4096)

    def _take(self) -> None:
        """Wait for more of the stream, or for a signal."""
        if not self.on_can:
            self._stream += self._more()
            return
        while len(self._raw) < FRAME.size:
            self._raw += self._more()
        can_id, size, data = FRAME.unpack_from(self._raw)
        self._raw = self._raw[FRAME.size :]
        if can_id == FROM_NODE:
            self._stream += data[:size]
        else:
            self.signals.append((can_id, data[:size]))

    def read_signal(self) -> tuple[int, bytes]:
        """Wait for the next frame that is no data of its link."""
        while not self.signals:
            self._take()
        return self.signals.pop(0)

    def read_block(self) -> tuple[int, bytes]:
        """Wait for the next block: (sequence, content)."""
        while not self._stream or len(self._stream) < self._stream[0]:
            self._take()
        size = self._stream[0]
        (block,) = twin.blocks(self._stream[:size])
        self._stream = self._stream[size:]
        return block

    def write(self, data: bytes) -> None:
        """Send bytes of the link, on CAN in frames."""
        if not self.on_can:
            os.write(self._fd, data)
            return
        for at in range(0, len(data), 8):
            self.frame(TO_NODE, data[at : at + 8])

    def post(self, *commands: str) -> None:
        """Send one block and wait for nothing."""
        self.write(wire_twin.block(self.seq, b"".join(map(self.words.encode, commands))))
        self.seq = (self.seq + 1) & 15

    def read_acknowledged(self) -> list[twin.Answer]:
        """Wait until the last block is acknowledged; return the answers before that, but for statistics."""
        answers: list[twin.Answer] = []
        while True:
            seq, content = self.read_block()
            if not content and seq == self.seq:
                return [answer for answer in answers if answer.name != "stats"]
            if content:
                answers.append(self.words.decode(seq, content))

    def send(self, *commands: str) -> list[twin.Answer]:
        """Send one block; return the answers that came before its acknowledgement, but for statistics."""
        self.post(*commands)
        return self.read_acknowledged()

    def read_answer(self, name: str) -> twin.Answer:
        """Wait for the answer NAME, past everything else."""
        while True:
            seq, content = self.read_block()
            if content and (answer := self.words.decode(seq, content)).name == name:
                return answer

    def clock(self) -> int:
        """Ask for its clock: 64 bits."""
        uptime = self.send("get_uptime")[0]
        return uptime["high"] * ROLLOVER + uptime["clock"]

    def clock_at(self, monotonic_ns: int) -> int:
        """Return its clock at a time of CLOCK_MONOTONIC, by the header of its edge log."""
        _, rate_hz, start_ns, start_clock = self.edge_header()
        return int(start_clock + (monotonic_ns - start_ns) * rate_hz / NS_PER_S)

    def monotonic_ns_at(self, clock: int) -> float:
        """Return the time of CLOCK_MONOTONIC at which its clock is CLOCK."""
        _, rate_hz, start_ns, start_clock = self.edge_header()
        return float(start_ns + (clock - start_clock) / rate_hz * NS_PER_S)

    def edge_header(self) -> tuple[float, float, int, int]:
        """Return nominal rate, true rate (both Hz), start in ns of CLOCK_MONOTONIC, clock at the start."""
        with self.edge_log.open("rb") as log:
            nominal_hz, rate_hz, start_ns, start_clock = struct.unpack_from("<ddQQ", log.read(64), 8)
        return nominal_hz, rate_hz, start_ns, start_clock

    def arm(self, oid: int, clock: int) -> None:
        """Let OID, a configured trsync, expire when its clock is CLOCK; `wait_expired` waits for that."""
        self.send(f"trsync_start oid={oid} report_clock=0 report_ticks=0 expire_reason={EXPIRED}")
        self.send(f"trsync_set_timeout oid={oid} clock={clock % ROLLOVER}")

    def wait_expired(self) -> None:
        """Wait until the trsync of `arm` expires."""
        state = self.read_answer("trsync_state")
        assert (state["can_trigger"], state["trigger_reason"]) == (0, EXPIRED)

    def end(self, *, close: bool = False) -> dict[str, float]:
        """End the process, by SIGTERM or by closing the bus; return its statistics."""
        if close and self.on_can:
            self._socket.close()
        else:
            self.process.terminate()
        out, err = self.process.communicate(timeout=PATIENCE_S)
        assert (self.process.returncode, err) == (0, "")
        statistics: dict[str, float] = json.loads(out)
        return statistics

    def close(self) -> None:
        """Kill the process and close everything."""
        self.process.kill()
        self.process.communicate()
        self._listener.close()
        if self.on_can:
            self._socket.close()
        else:
            os.close(self._fd)
