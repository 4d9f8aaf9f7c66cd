"""What the Linux board adds to the firmware: processes, a real clock, late timers, the edge log, links."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tests.firmware.board_process import (
    BIN,
    FREQUENCIES_HZ,
    PATIENCE_S,
    ROLLOVER,
    UUID,
    BoardProcess,
)
from tests.firmware.host import NODE_ID
from tests.stages.sim_node import edge_clocks

TO_ROLLOVER_S = 4
"""From the start of a node on: a busy computer takes a part of it to set the nodes up."""
RATE = 1 - 200e-6
Start = Callable[..., BoardProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a node of a flavour and take up contact; all end with the test."""
    with ExitStack() as stack:

        def begin(flavour: str, *options: str, preload: Path | None = None) -> BoardProcess:
            folder = tmp_path / f"{flavour}{len(list(tmp_path.iterdir()))}"
            folder.mkdir()
            process = BoardProcess(folder, flavour, *options, preload=preload)
            stack.callback(process.close)
            process.start()
            return process

        yield begin


def test_steps_over_a_rollover_are_in_the_edge_log_at_their_ticks(start: Start) -> None:
    nodes = {}
    for flavour, freq in FREQUENCIES_HZ.items():
        start_clock = 3 * ROLLOVER - TO_ROLLOVER_S * freq
        nodes[flavour] = start(flavour, "--rate-ppm", "-200", "--start-clock", str(start_clock))
    for flavour, node in nodes.items():
        freq = node.freq_hz
        config: dict[str, object] = dict(node.words.raw["config"])
        assert (config["CLOCK_FREQ"], config["MCU"]) == (freq, f"virtual-{flavour}")
        assert json.loads((BIN / f"canductor-node-{flavour}.json").read_text()) == node.words.raw
        node.send("allocate_oids count=3", "config_trsync oid=2")
        node.send("config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0")
        node.send("config_stepper oid=1 step_pin=5 dir_pin=6 invert_step=0 step_pulse_ticks=10")
        node.send("finalize_config crc=9")
        first = 3 * ROLLOVER - freq // 40  # the steps go on behind the rollover
        for oid in (0, 1):
            node.send(f"reset_step_clock oid={oid} clock={first % ROLLOVER}")
            node.send(f"queue_step oid={oid} interval={freq // 10000} count=500 add=-1")
        node.send("set_next_step_dir oid=1 dir=1", f"queue_step oid=1 interval={freq // 10000} count=3 add=0")
        node.arm(2, first + freq // 10)
    for node in nodes.values():
        check_steps(node)


def check_steps(node: BoardProcess) -> None:
    freq, first = node.freq_hz, 3 * ROLLOVER - node.freq_hz // 40
    node.wait_expired()
    positions = [node.send(f"stepper_get_position oid={oid}")[0]["pos"] for oid in (0, 1)]
    assert positions == [-500, -497]
    statistics = node.end()
    log = node.edge_log.read_bytes()
    assert (log[:8], log[40:64]) == (b"CNDEDGE1", bytes(24))
    nominal, rate, start_ns, start_clock = node.edge_header()
    assert nominal == freq
    assert rate == pytest.approx(freq * RATE, rel=1e-12)
    assert start_clock == 3 * ROLLOVER - TO_ROLLOVER_S * freq
    assert 0 < start_ns < time.monotonic_ns()
    edges = np.frombuffer(log[64:], np.uint64)
    assert statistics["edges"] == len(edges)
    assert np.all(np.diff(edges >> np.uint64(16)).astype(np.int64) >= 0), "in the order of time"
    steps = first + np.cumsum(freq // 10000 - np.arange(500))
    assert steps[-1] > 3 * ROLLOVER
    assert edge_clocks(edges, 3).tolist() == steps.tolist()
    steps = np.append(steps, steps[-1] + (freq // 10000) * np.arange(1, 4))
    assert edge_clocks(edges, 5).tolist() == np.stack([steps, steps + 10], axis=1).ravel().tolist()
    assert statistics["late_us_max"] >= statistics["late_us_mean"] > 0


@pytest.mark.parametrize("flavour", ["mainboard", "uart"])
def test_its_clock_is_the_monotonic_clock_at_its_rate_and_offset(start: Start, flavour: str) -> None:
    offset = 3 * ROLLOVER - FREQUENCIES_HZ[flavour] // 50  # the first answers come before the rollover
    node = start(flavour, "--rate-ppm", "-200", "--start-clock", str(offset))
    assert node.edge_header()[3] == offset
    for _ in range(20):
        before_ns = time.monotonic_ns()
        clock = node.clock()
        assert before_ns - 1000 <= node.monotonic_ns_at(clock) <= time.monotonic_ns() + 1000


def test_a_late_command_is_late(start: Start) -> None:
    node = start("mainboard")
    node.send(
        "allocate_oids count=1",
        "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0",
    )
    node.send("finalize_config crc=9")
    now = node.send("get_clock")[0]["clock"]
    node.send(f"reset_step_clock oid=0 clock={(now - 100_000) % ROLLOVER}")
    node.send("queue_step oid=0 interval=100 count=1 add=0")
    assert node.send("get_config")[-1]["is_shutdown"] == 1
    assert node.end()["edges"] == 0


def test_input_finds_the_slots_that_are_free_by_then(start: Start, tmp_path: Path) -> None:
    """As on a chip, whose timers go on while input comes in: here the process is stopped meanwhile."""
    held_read, hold = tmp_path / "held_read.so", tmp_path / "hold"
    source = Path(__file__).with_name("held_read.c")
    subprocess.run(["gcc", f'-DHOLD="{hold}"', "-shared", "-fPIC", source, "-o", held_read], check=True)
    alarm = start("mainboard")
    alarm.send("allocate_oids count=1", "config_trsync oid=0", "finalize_config crc=9")
    node = start("uart", preload=held_read)
    node.send(
        "allocate_oids count=1",
        "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0",
    )
    node.send("finalize_config crc=9")
    freq, slots = node.freq_hz, node.send("get_config")[0]["move_count"]
    free_at = node.clock() + 3 * freq // 2
    node.send(f"reset_step_clock oid=0 clock={(free_at - freq) % ROLLOVER}")
    node.send(f"queue_step oid=0 interval={freq} count=1 add=0")
    for _ in range((slots - 1) // 4):
        node.send(*[f"queue_step oid=0 interval={20 * freq} count=1 add=0"] * 4)
    for _ in range((slots - 1) % 4):
        node.send(f"queue_step oid=0 interval={20 * freq} count=1 add=0")
    hold.touch()
    node.post("get_clock")
    stopped = os.waitid(os.P_PID, node.process.pid, os.WSTOPPED)
    assert stopped is not None
    assert stopped.si_status == signal.SIGSTOP
    hold.unlink()
    # Another node's clock says when the first slot has to be free; this one does not run.
    alarm.arm(0, alarm.clock_at(int(node.monotonic_ns_at(free_at))) + alarm.freq_hz // 1000)
    alarm.wait_expired()
    node.post("queue_step oid=0 interval=9 count=1 add=0")
    node.process.send_signal(signal.SIGCONT)
    assert node.read_answer("clock")["clock"] - free_at % ROLLOVER > 0, "it was stopped until then"
    node.read_acknowledged()
    assert node.send("get_config")[-1]["is_shutdown"] == 0


@pytest.mark.parametrize("flavour", ["toolhead", "uart"])
def test_reset_makes_it_forget_but_live(start: Start, flavour: str) -> None:
    node = start(flavour)
    node.send("allocate_oids count=0", "finalize_config crc=9")
    assert node.send("reset") == [], "the last acknowledgement still leaves"
    node.seq = 0
    node.start()
    assert node.send("get_config")[0]["is_config"] == 0
    assert node.end()["resets"] == 1


def test_it_ends_cleanly_when_the_bus_closes(start: Start) -> None:
    statistics = start("mainboard").end(close=True)
    assert statistics["frames_in"] > 10
    assert statistics["lost"] == 0


def test_the_host_of_a_uart_may_come_and_go(start: Start) -> None:
    node = start("uart")
    node.reopen()
    assert node.send("get_config")[0].name == "config"
    assert node.end()["bytes_in"] > 0
    assert not Path(node.ready["uart"]).is_symlink()


@pytest.mark.parametrize("flavour", ["mainboard", "uart"])
def test_jitter_delays_but_loses_nothing(start: Start, flavour: str) -> None:
    node = start(flavour, "--jitter-us", "3000", "--seed", "5")
    began_ns, rounds = time.monotonic_ns(), 30
    for _ in range(rounds):
        node.send("get_clock")
    assert time.monotonic_ns() - began_ns > rounds * 500_000, "1.5 ms on average, and what the seed draws"
    assert node.end()["lost"] == 0


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
        "stdout=subprocess.PIPE); p.stdout.readline(); print(p.pid, flush=True); sys.stdin.read(); "
        "os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdin
        assert parent.stdout
        node = os.pidfd_open(int(parent.stdout.readline()))
        assert (tmp_path / "tty").is_symlink()
        parent.stdin.close()
        assert select.select([node], [], [], PATIENCE_S)[0], "the node still runs"
        os.close(node)
    assert not (tmp_path / "tty").is_symlink(), "it ended in order"


def test_it_ends_on_ctrl_c(start: Start) -> None:
    node = start("uart")
    node.process.send_signal(signal.SIGINT)
    out, _ = node.process.communicate(timeout=PATIENCE_S)
    assert json.loads(out)["blocks"] > 0
    assert node.process.returncode == 0


def test_signals_reach_and_leave_the_process(start: Start) -> None:
    node = start("toolhead")
    node.send("allocate_oids count=1", "config_trsync oid=0", "finalize_config crc=1")
    node.send("trsync_set_group oid=0 group=7", "set_bus_stop enable=1")
    begin = "trsync_start oid=0 report_clock=0 report_ticks=0 expire_reason=2"
    node.send(begin)
    node.frame(0x027, bytes([7, 5, 0, 0, 0, 0]))
    assert node.read_answer("trsync_state")["trigger_reason"] == 5
    before = node.send("get_clock")[0]["clock"]
    node.frame(0x3F0, b"\x40\x09")
    (latched,) = node.send("get_sync_pulse")
    after = node.send("get_clock")[0]["clock"]
    assert latched["seq"] == 9
    assert (latched["clock"] - before) % ROLLOVER <= (after - before) % ROLLOVER
    node.frame(0x3F0, b"\x41")
    assert node.read_signal() == (0x3F1, b"\x21" + bytes.fromhex(UUID) + bytes([NODE_ID]))
    node.send(begin)
    node.send("trsync_trigger oid=0 reason=6")
    can_id, data = node.read_signal()
    assert (can_id, data[:2], len(data)) == (0x027, bytes([7, 6]), 6)
    node.frame(0x010, b"\x00\x00")
    assert node.read_answer("shutdown").name == "shutdown"


def test_a_legacy_process_takes_no_part_in_signals(start: Start) -> None:
    node = start("toolhead", "--legacy", "1")
    node.frame(0x010, b"\x00\x00")
    node.frame(0x3F0, b"\x41")
    assert node.send("get_config")[0]["is_shutdown"] == 0
    assert node.signals == []
