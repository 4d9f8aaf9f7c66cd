"""The node as a process: the real executables on a real socket and a real pseudo-terminal."""

import json
import os
import select
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nodes.virtual.sim import edge_clocks
from tests import wire_twin
from tests.firmware import twin
from tests.firmware.host import FROM_NODE, NODE_ID, TO_NODE

BIN = Path(__file__).parents[2] / "nodes" / "virtual" / "bin"
UUID = "0123456789ab"
FREQUENCIES = {"mainboard": 168_000_000, "toolhead": 64_000_000, "uart": 16_000_000}
FRAME = struct.Struct("=IB3x8s")
PATIENCE_S = 20  # only a broken node makes anyone wait so long
ROLLOVER = 1 << 32
TO_ROLLOVER_S = 2
"""From the start of a node on: a busy computer takes a part of it to set the node up."""


class Process:
    """One node process and a patient host; speaks CAN frames or plain bytes over a file descriptor."""

    def __init__(self, folder: Path, flavour: str, *options: str, preload: Path | None = None) -> None:
        self.edge_log = folder / "edges"
        self.on_can = flavour != "uart"
        self._listener = socket.socket(socket.AF_UNIX)
        link = ["--uart", str(folder / "tty")]
        if self.on_can:
            self._listener.bind(str(folder / "bus"))
            self._listener.listen()
            link = ["--can", str(folder / "bus"), "--uuid", UUID]
        arguments = [
            str(BIN / f"canductor-node-{flavour}"),
            *link,
            "--edge-log",
            str(self.edge_log),
            *options,
        ]
        self.process = subprocess.Popen(
            arguments,
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
        if self.on_can:
            self.frame(0x3F0, b"\x00")
            assert self.read_frame() == (0x3F1, b"\x20" + bytes.fromhex(UUID) + b"\x01")
            self.frame(0x3F0, b"\x01" + bytes.fromhex(UUID) + bytes([NODE_ID]))
        else:
            seq, content = self.read_block()
            assert (seq, len(content)) == (0, 1), "starting"
        self.words.raw, _ = twin.download(lambda text: self.send(text)[0])

    def frame(self, can_id: int, data: bytes) -> None:
        os.write(self._fd, FRAME.pack(can_id, len(data), data))

    def _more(self) -> bytes:
        assert select.select([self._fd], [], [], PATIENCE_S)[0], "the node is silent"
        return os.read(self._fd, 4096)

    def read_frame(self) -> tuple[int, bytes]:
        while len(self._raw) < FRAME.size:
            self._raw += self._more()
        can_id, size, data = FRAME.unpack_from(self._raw)
        self._raw = self._raw[FRAME.size :]
        return can_id, data[:size]

    def read_block(self) -> tuple[int, bytes]:
        while not self._stream or len(self._stream) < self._stream[0]:
            if self.on_can:
                can_id, data = self.read_frame()
                assert can_id == FROM_NODE
                self._stream += data
            else:
                self._stream += self._more()
        size = self._stream[0]
        (block,) = twin.blocks(self._stream[:size])
        self._stream = self._stream[size:]
        return block

    def write(self, data: bytes) -> None:
        if not self.on_can:
            os.write(self._fd, data)
            return
        for at in range(0, len(data), 8):
            self.frame(TO_NODE, data[at : at + 8])

    def send(self, *commands: str) -> list[twin.Answer]:
        """Send one block; return the answers that came before its acknowledgement, but for statistics."""
        self.write(wire_twin.block(self.seq, b"".join(map(self.words.encode, commands))))
        self.seq = (self.seq + 1) & 15
        answers: list[twin.Answer] = []
        while True:
            seq, content = self.read_block()
            if not content and seq == self.seq:
                return [answer for answer in answers if answer.name != "stats"]
            if content:
                answers.append(self.words.decode(seq, content))

    def read_answer(self, name: str) -> twin.Answer:
        """Wait for the answer NAME, past everything else."""
        while True:
            seq, content = self.read_block()
            if content and (answer := self.words.decode(seq, content)).name == name:
                return answer

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

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()
        self._listener.close()
        if self.on_can:
            self._socket.close()
        else:
            os.close(self._fd)


@pytest.fixture(params=["mainboard", "toolhead", "uart"])
def flavour(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def process(tmp_path: Path, flavour: str) -> Iterator[Process]:
    start_clock = 3 * ROLLOVER - TO_ROLLOVER_S * FREQUENCIES[flavour]
    running = Process(tmp_path, flavour, "--rate-ppm", "-200", "--start-clock", str(start_clock))
    yield running
    running.kill()


def test_identity_clock_and_edge_log(process: Process, flavour: str) -> None:
    freq = FREQUENCIES[flavour]
    process.start()
    config: dict[str, object] = dict(process.words.raw["config"])
    assert (config["CLOCK_FREQ"], config["MCU"]) == (freq, f"virtual-{flavour}")
    beside = json.loads((BIN / f"canductor-node-{flavour}.json").read_text())
    assert beside == process.words.raw
    process.send("allocate_oids count=2")
    process.send("config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0")
    process.send("config_stepper oid=1 step_pin=5 dir_pin=6 invert_step=0 step_pulse_ticks=10")
    process.send("finalize_config crc=9")
    uptime = process.send("get_uptime")[0]
    now = uptime["high"] * ROLLOVER + uptime["clock"]
    first = 3 * ROLLOVER - freq // 40  # the steps go on behind the rollover
    for oid in (0, 1):
        process.send(f"reset_step_clock oid={oid} clock={first % ROLLOVER}")
        process.send(f"queue_step oid={oid} interval={freq // 10000} count=500 add=-1")
    process.send("set_next_step_dir oid=1 dir=1", f"queue_step oid=1 interval={freq // 10000} count=3 add=0")
    wanted = [-500, -497]
    deadline = time.monotonic() + PATIENCE_S
    positions = [0, 0]
    while positions != wanted:  # real time: the node takes two seconds
        assert time.monotonic() < deadline
        positions = [process.send(f"stepper_get_position oid={oid}")[0]["pos"] for oid in (0, 1)]
    statistics = process.end()
    log = process.edge_log.read_bytes()
    nominal, rate, start_ns, start_clock = struct.unpack_from("<ddQQ", log, 8)
    assert (log[:8], nominal, rate) == (b"CNDEDGE1", freq, pytest.approx(freq * (1 - 200e-6), rel=1e-12))
    assert start_clock == 3 * ROLLOVER - TO_ROLLOVER_S * freq
    assert 0 < time.monotonic_ns() - start_ns < PATIENCE_S * 10**9
    assert log[40:64] == bytes(24)
    edges = np.frombuffer(log[64:], np.uint64)
    assert statistics["edges"] == len(edges)
    assert np.all(np.diff(edges >> np.uint64(16)).astype(np.int64) >= 0)
    steps = first + np.cumsum(freq // 10000 - np.arange(500))
    assert steps[-1] > 3 * ROLLOVER > now
    assert edge_clocks(edges, 3).tolist() == steps.tolist()
    steps = np.append(steps, steps[-1] + (freq // 10000) * np.arange(1, 4))
    assert edge_clocks(edges, 5).tolist() == np.stack([steps, steps + 10], axis=1).ravel().tolist()
    assert statistics["late_us_max"] >= statistics["late_us_mean"] > 0


def test_its_clock_is_the_monotonic_clock_at_its_rate_and_offset(process: Process, flavour: str) -> None:
    process.start()
    header = process.edge_log.read_bytes()
    _, rate, start_ns, start_clock = struct.unpack_from("<ddQQ", header, 8)
    for _ in range(50):
        before = time.monotonic_ns()
        answer = process.send("get_uptime")[0]
        after = time.monotonic_ns()
        clock = answer["high"] * ROLLOVER + answer["clock"]
        read_ns = start_ns + (clock - start_clock) / rate * 1e9
        assert before - 1000 <= read_ns <= after + 1000


def test_a_late_command_is_late(process: Process) -> None:
    process.start()
    process.send(
        "allocate_oids count=1",
        "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0",
    )
    process.send("finalize_config crc=9")
    now = process.send("get_clock")[0]["clock"]
    process.send(f"reset_step_clock oid=0 clock={(now - 100_000) % ROLLOVER}")
    process.send("queue_step oid=0 interval=100 count=1 add=0")
    seen = process.send("get_config")
    assert seen[-1]["is_shutdown"] == 1
    assert process.end()["edges"] == 0


def test_input_finds_the_slots_that_are_free_by_then(tmp_path: Path) -> None:
    """As on a chip, whose timers go on while input comes in: here the process is stopped meanwhile."""
    held_read, hold = tmp_path / "held_read.so", tmp_path / "hold"
    source = Path(__file__).with_name("held_read.c")
    defines = [f'-DHOLD="{hold}"', "-O2", "-shared", "-fPIC"]
    subprocess.run(["gcc", *defines, source, "-o", held_read], check=True)
    process = Process(tmp_path, "uart", preload=held_read)
    process.start()
    process.send(
        "allocate_oids count=1",
        "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0",
    )
    process.send("finalize_config crc=9")
    freq, slots = FREQUENCIES["uart"], process.send("get_config")[0]["move_count"]
    free_at = process.send("get_clock")[0]["clock"] + 2 * freq
    process.send(f"reset_step_clock oid=0 clock={(free_at - freq) % ROLLOVER}")
    process.send(f"queue_step oid=0 interval={freq} count=1 add=0")
    for _ in range(slots - 1):
        process.send(f"queue_step oid=0 interval={20 * freq} count=1 add=0")
    hold.touch()
    process.write(wire_twin.block(process.seq, process.words.encode("get_clock")))
    state = Path(f"/proc/{process.process.pid}/stat")
    deadline = time.monotonic() + PATIENCE_S
    while state.read_text().rpartition(")")[2].split()[0] != "T":
        assert time.monotonic() < deadline
    hold.unlink()
    _, rate, start_ns, start_clock = struct.unpack_from("<ddQQ", process.edge_log.read_bytes(), 8)
    while (free_s := (free_at - start_clock) / rate + start_ns * 1e-9 - time.monotonic()) > -0.001:
        time.sleep(max(0.001, free_s))
    process.seq += 1
    process.write(
        wire_twin.block(process.seq & 15, process.words.encode("queue_step oid=0 interval=9 count=1 add=0"))
    )
    process.process.send_signal(signal.SIGCONT)
    assert process.read_answer("clock")["clock"] - free_at > 0, "it was stopped until then"
    process.seq = (process.seq + 1) & 15
    assert process.send("get_config")[-1]["is_shutdown"] == 0
    process.kill()


def test_reset_makes_it_forget_but_live(process: Process) -> None:
    process.start()
    process.send("allocate_oids count=0", "finalize_config crc=9")
    process.write(wire_twin.block(process.seq, process.words.encode("reset")))
    assert process.read_block() == ((process.seq + 1) & 15, b""), "the last acknowledgement still leaves"
    process.seq = 0
    process.start()
    assert process.send("get_config")[0]["is_config"] == 0
    assert process.end()["resets"] == 1


@pytest.mark.parametrize("flavour", ["mainboard"])
def test_it_ends_cleanly_when_the_bus_closes(process: Process) -> None:
    process.start()
    statistics = process.end(close=True)
    assert statistics["frames_in"] > 10
    assert statistics["lost"] == 0


@pytest.mark.parametrize("flavour", ["uart"])
def test_the_host_of_a_uart_may_come_and_go(process: Process) -> None:
    process.start()
    os.close(process._fd)
    process._fd = os.open(process.ready["uart"], os.O_RDWR | os.O_NOCTTY)
    assert process.send("get_config")[0].name == "config"
    assert process.end()["bytes_in"] > 0
    assert not Path(process.ready["uart"]).is_symlink()


@pytest.mark.parametrize("flavour", ["mainboard", "uart"])
def test_jitter_delays_but_loses_nothing(tmp_path: Path, flavour: str) -> None:
    process = Process(tmp_path, flavour, "--jitter-us", "3000", "--seed", "5")
    try:
        process.start()
        waits = []
        for _ in range(30):
            before = time.monotonic()
            process.send("get_clock")
            waits.append(time.monotonic() - before)
        assert sum(waits) / len(waits) > 0.0005
        assert process.end()["lost"] == 0
    finally:
        process.kill()


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        ([], 2, "is needed"),
        (["--can", "/nowhere/bus"], 1, "cannot join the virtual CAN bus /nowhere/bus"),
        (["--can", "x" * 200], 1, "cannot join the virtual CAN bus"),
        (["--socketcan", "nocan77"], 1, "cannot open the CAN interface nocan77"),
        (["--uart", "/nowhere/tty"], 1, "cannot make the link /nowhere/tty"),
        (["--can", "a", "--uart", "b"], 2, "only one of"),
        (["--uart"], 2, "needs a value"),
        (["--volume", "11"], 2, "there is no option --volume"),
        (["--uuid", "xyz"], 2, "12 hex digits"),
        (["--rate-ppm", "fast"], 2, "parts per million"),
        (["--rate-ppm", "nan"], 2, "parts per million"),
        (["--start-clock", "-5"], 2, "ticks below 2^47"),
        (["--slice-us", "1e3"], 2, "microseconds"),
        (["--jitter-us", ""], 2, "microseconds"),
        (
            ["--edge-log", "/nowhere/edges", "--uart", "{tmp}/tty"],
            1,
            "cannot write the edge log /nowhere/edges",
        ),
    ],
)
def test_bad_options_are_told_in_a_sentence(
    tmp_path: Path, options: list[str], status: int, words: str
) -> None:
    arguments = [option.replace("{tmp}", str(tmp_path)) for option in options]
    result = subprocess.run(
        [BIN / "canductor-node-uart", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (result.returncode, result.stdout) == (status, "")
    assert words in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_it_dies_with_its_parent(tmp_path: Path) -> None:
    script = (
        "import subprocess, sys, os; "
        f"p = subprocess.Popen([{str(BIN / 'canductor-node-uart')!r}, '--uart', {str(tmp_path / 'tty')!r}], "
        "stdout=subprocess.PIPE); p.stdout.readline(); print(p.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    out = subprocess.run(["python3", "-c", script], capture_output=True, text=True, check=False).stdout
    deadline = time.monotonic() + PATIENCE_S
    while (tmp_path / "tty").is_symlink():  # removed by its clean end
        assert time.monotonic() < deadline, f"process {out.strip()} still runs"
    assert int(out) > 0


def test_it_ends_on_ctrl_c(process: Process) -> None:
    process.start()
    process.process.send_signal(signal.SIGINT)
    out, _ = process.process.communicate(timeout=PATIENCE_S)
    assert json.loads(out)["blocks"] > 0
    assert process.process.returncode == 0


CAN_ONLY = pytest.mark.parametrize("flavour", ["toolhead"], indirect=True)


@CAN_ONLY
def test_signals_reach_and_leave_the_process(process: Process) -> None:
    process.start()
    process.send("allocate_oids count=1", "config_trsync oid=0", "finalize_config crc=1")
    process.send("trsync_set_group oid=0 group=7", "set_bus_stop enable=1")
    start = "trsync_start oid=0 report_clock=0 report_ticks=0 expire_reason=2"
    process.send(start)
    process.frame(0x027, bytes([7, 5, 0, 0, 0, 0]))
    assert process.read_answer("trsync_state")["trigger_reason"] == 5
    before = process.send("get_clock")[0]["clock"]
    process.frame(0x3F0, b"\x40\x09")
    (latched,) = process.send("get_sync_pulse")
    after = process.send("get_clock")[0]["clock"]
    assert latched["seq"] == 9
    assert (latched["clock"] - before) % ROLLOVER <= (after - before) % ROLLOVER
    process.frame(0x3F0, b"\x41")
    assert process.read_frame() == (0x3F1, b"\x21" + bytes.fromhex(UUID) + bytes([NODE_ID]))
    process.send(start)
    process.write(wire_twin.block(process.seq, process.words.encode("trsync_trigger oid=0 reason=6")))
    process.seq = (process.seq + 1) & 15
    can_id, data = process.read_frame()
    assert (can_id, data[:2], len(data)) == (0x027, bytes([7, 6]), 6)
    process.frame(0x010, b"\x00\x00")
    assert process.read_answer("shutdown").name == "shutdown"


@CAN_ONLY
def test_a_legacy_process_takes_no_part_in_signals(tmp_path: Path, flavour: str) -> None:
    process = Process(tmp_path, flavour, "--legacy", "1")
    process.start()
    process.frame(0x010, b"\x00\x00")
    process.frame(0x3F0, b"\x41")
    assert process.send("get_config")[0]["is_shutdown"] == 0
    process.kill()
