"""Processes of virtual hardware: coming up, reporting, and never outliving this one."""

import os
import select
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.virtual.processes import ChildProcess, NodeProcess
from tests.stages.bus_process import BusProcess

WAIT_S = 20.0
READY = "import json, signal, sys; print(json.dumps({'ready': True, 'argv': sys.argv[1:]}), flush=True)\n"
IGNORING = "import signal; signal.signal(15, signal.SIG_IGN)\n"
# A process as it should be: ready, then on SIGTERM its counters. (A handler might interrupt print.)
GOOD = (
    "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [15])\n"
    f"{READY}signal.sigwait([15])\n"
    "print('{\"steps\": 7}')\n"
)


def python(code: str) -> list[str | Path]:
    return [sys.executable, "-c", code]


def ends(pidfd: int) -> bool:
    poller = select.poll()
    poller.register(pidfd, select.POLLIN)
    return bool(poller.poll(WAIT_S * 1000))


def test_bus_process_comes_up_and_reports(tmp_path: Path) -> None:
    with BusProcess(tmp_path / "bus", loss=0.5) as bus:
        assert bus.wait_ready()["address"] == f"virtual:{tmp_path / 'bus'}"
        assert bus.running
        statistics = bus.stop()
        assert statistics["frames"] == 0
        assert bus.stop() is statistics
        assert not bus.running


def test_what_a_process_says_when_it_fails_is_passed_on(tmp_path: Path) -> None:
    (tmp_path / "bus").touch()
    bus = BusProcess(tmp_path / "bus")
    with pytest.raises(CanductorError, match=r"did not become ready: ended with status 1: .* than a socket"):
        bus.wait_ready()


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import signal; signal.pause()", r"no answer in 0\.5 s; it was killed"),
        ("import os; os.kill(os.getpid(), 11)", "ended by signal 11"),
        ("print('[1]')", "ended with status 0"),
        ("print('{')", "ended with status 0"),
        ("print('x' * 200000)", "did not become ready"),
    ],
)
def test_a_process_that_does_not_become_ready(code: str, said: str) -> None:
    process = ChildProcess("thing", python(code))
    with pytest.raises(CanductorError, match=said):
        process.wait_ready(0.5 if "pause" in code else WAIT_S)
    assert not process.running


def test_a_process_that_ignores_sigterm_is_killed() -> None:
    process = ChildProcess("thing", python(f"{IGNORING}{READY}signal.pause()"))
    process.wait_ready()
    with pytest.raises(CanductorError, match=r"did not end correctly: no answer in 0\.1 s; it was killed"):
        process.stop(0.1)
    assert not process.running


def test_a_process_that_died_is_told_at_stop_and_kill_may_be_repeated() -> None:
    process = ChildProcess("thing", python(GOOD))
    process.wait_ready()
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(CanductorError, match="ended by signal 9"):
        process.stop()
    process.kill()
    with pytest.raises(CanductorError, match="was killed before"):
        process.stop()


def test_stop_without_anybody_having_waited() -> None:
    process = ChildProcess("thing", python(GOOD))
    assert process._process.stdout is not None
    select.select([process._process.stdout], [], [], WAIT_S)
    assert process.stop() == {"steps": 7}


def test_processes_outlive_the_thread_that_started_them() -> None:
    """The kernel's parent-death signal is tied to a thread; here that thread is never the caller's."""
    started: list[ChildProcess] = []
    thread = threading.Thread(target=lambda: started.append(ChildProcess("thing", python(GOOD))))
    thread.start()
    thread.join(WAIT_S)
    started[0].wait_ready()
    assert started[0].stop() == {"steps": 7}


def test_processes_die_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    parent_code = (
        "import signal, sys\n"
        "from tests.stages.bus_process import BusProcess\n"
        "bus = BusProcess(sys.argv[1]); bus.wait_ready()\n"
        "print(bus.pid, flush=True); signal.pause()\n"
    )
    command = [sys.executable, "-c", parent_code, str(tmp_path / "bus")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pidfd = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        assert ends(pidfd)
        os.close(pidfd)


def test_ctrl_c_does_not_reach_the_process() -> None:
    process = ChildProcess("thing", python(READY + "signal.pause()"))
    process.wait_ready()
    assert os.getsid(process.pid) != os.getsid(0)
    process.kill()


def test_node_is_started_with_its_options(tmp_path: Path) -> None:
    """A stand-in prints its arguments: the firmware itself is tested where it is built."""
    executable = tmp_path / "canductor-node-toolhead"
    executable.write_text(f"#!{sys.executable}\n{GOOD}")
    executable.chmod(0o755)
    node = NodeProcess(
        "toolhead",
        uuid="90a4ae022dfc",
        can=tmp_path / "bus",
        rate_ppm=-200.5,
        start_clock=2**32 - 7,
        seed=0,
        bin_dir=tmp_path,
    )
    words = node.wait_ready()["argv"]
    assert dict(zip(words[::2], words[1::2], strict=True)) == {
        "--can": str(tmp_path / "bus"),
        "--uuid": "90a4ae022dfc",
        "--rate-ppm": "-200.5",
        "--start-clock": "4294967289",
        "--seed": "0",
    }
    assert node.stop() == {"steps": 7}


def test_node_without_firmware_or_with_two_links_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match="build it with 'make setup'"):
        NodeProcess("uart", uuid="90a4ae022dfc", uart=tmp_path / "tty", bin_dir=tmp_path)
    with pytest.raises(CanductorError, match="exactly one of can, socketcan and uart"):
        NodeProcess("uart", uuid="90a4ae022dfc", uart=tmp_path / "tty", socketcan="can0")
    with pytest.raises(CanductorError, match="exactly one of"):
        NodeProcess("mainboard", uuid="90a4ae022dfc")
