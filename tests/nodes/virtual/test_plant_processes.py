"""What a plant is to a node that is a process: its files, its log, and other processes' motors, however late.

What a plant does is tested in virtual time: test_sim_plant.py, and in C below tests/firmware/boards.
"""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from nodes.support.errors import CanductorError
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.plant import Axis, NodePlant, Stepper, Switch, Term
from nodes.virtual.plant_log import plant_log
from nodes.virtual.plant_page import PlantFault, PlantItemKind, PlantPage
from nodes.virtual.processes import NodeProcess
from tests.firmware.board_process import EXPIRED, ROLLOVER, BoardProcess
from tests.nodes.virtual.plants import HOT

PA0, PA1 = 0, 1
STEPS, MM = 600, 0.0125
Start = Callable[..., BoardProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start the node of a plant; all are in one folder."""
    with ExitStack() as stack:

        def begin(plant: NodePlant, flavour: str = "toolhead", *options: str) -> BoardProcess:
            folder = tmp_path / plant.node
            folder.mkdir()
            process = BoardProcess(folder, flavour, "--plant", str(plant.write(tmp_path)), *options)
            stack.callback(process.close)
            process.start()
            return process

        yield begin


def test_what_happens_is_in_its_log_at_the_times_of_its_pins(start: Start, tmp_path: Path) -> None:
    node = start(HOT)
    page = PlantPage.at(tmp_path, "hot")
    node.send("allocate_oids count=1")
    node.send(f"config_digital_out oid=0 pin=0 value=0 default_value=0 max_duration={node.freq_hz // 20}")
    node.send("finalize_config crc=1")
    node.send("update_digital_out oid=0 value=1")
    node.read_answer("shutdown")  # its host said nothing more: the heater ended by itself
    page.set_fault(PlantItemKind.SENSOR, "block", PlantFault.FALLEN)
    node.end()
    ((clocks, _, levels),) = EdgeLog(node.edge_log).edges(PA0)
    assert levels.tolist() == [1, 0]
    events = list(plant_log(tmp_path, "hot"))
    power = [event for event in events if event.kind == "power"]
    assert [event.value for event in power] == [90.0, 0.0]
    # It went on when the command came, and off by a timer, which has one time for pin and plant.
    off_ns = int(EdgeLog(node.edge_log).ticks_to_monotonic_ns(int(clocks[1])))
    assert power[0].at_ns < power[1].at_ns == pytest.approx(off_ns, abs=2)
    energy_J = 90.0 * (power[1].at_ns - power[0].at_ns) * 1e-9  # noqa: N806 - the unit's letter
    assert page.item(PlantItemKind.HEATER, "block").extra == pytest.approx(energy_J, rel=1e-6)
    assert [int(event.value) for event in events if event.kind == "fault"] == [int(PlantFault.FALLEN)]
    bodies = [event.value for event in events if event.kind == "body"]
    assert bodies[0] == pytest.approx(20.0, abs=0.1)
    assert bodies[-1] > 20.5, "the last entry is written at the end"


def motor(name: str) -> NodePlant:
    return NodePlant(node=name, steppers=(Stepper(name="m", step_pin="PA0", dir_pin="PA1", both_edges=True),))


def steps_of(log: EdgeLog) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.concatenate([log.ticks_to_monotonic_ns(clock) for clock, _ in log.steps(PA0, PA1, True)])


def prepare_endstop(node: BoardProcess) -> int:
    """Configure a trsync 0 and an endstop 1 on PB0; return the ticks between two of its looks: 50 µs."""
    node.send("allocate_oids count=2", "config_trsync oid=0", "config_endstop oid=1 pin=16 pull_up=0")
    node.send("finalize_config crc=1")
    return node.freq_hz // 20000


def home(node: BoardProcess, begin: int, rest: int) -> None:
    node.send(f"trsync_start oid=0 report_clock=0 report_ticks=0 expire_reason={EXPIRED}")
    node.send(
        f"endstop_home oid=1 clock={begin % ROLLOVER} sample_ticks=10 sample_count=1 rest_ticks={rest} "
        "pin_value=1 trsync_oid=0 trigger_reason=1"
    )


def test_an_endstop_switches_by_the_motors_of_two_other_nodes_however_late_it_runs(
    start: Start, tmp_path: Path
) -> None:
    # x = 5 mm + (a + b) / 2, as of a corexy, both go down: it switches at 0, with 400 of their steps.
    terms = tuple(Term(name, "m", MM / 2) for name in "ab")
    stop = NodePlant(
        node="stop",
        axes=(Axis(name="x", terms=terms, origin=5.0),),
        switches=(Switch(name="x", pin="PB0", axis="x", at=0.0, direction=-1),),
    )
    node = start(stop, "toolhead", "--rate-ppm", "70")
    motors = [start(motor("a"), "mainboard", "--rate-ppm", "-90"), start(motor("b"), "toolhead")]
    for process in motors:
        process.send("allocate_oids count=2", "config_trsync oid=1")
        process.send("config_stepper oid=0 step_pin=0 dir_pin=1 invert_step=255 step_pulse_ticks=0")
        process.send("finalize_config crc=9")
    rest = prepare_endstop(node)
    begin = node.clock() + node.freq_hz
    home(node, begin, rest)
    # The node with the endstop stands still until the motors have done all they do.
    node.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, node.process.pid, os.WSTOPPED)
    for process in motors:
        at = process.clock() + process.freq_hz * 3 // 2
        process.send(f"reset_step_clock oid=0 clock={at % ROLLOVER}")
        process.send(f"queue_step oid=0 interval={process.freq_hz // 2000} count={STEPS} add=0")
        process.arm(1, at + process.freq_hz * STEPS // 2000 + process.freq_hz // 100)
    for process in motors:
        process.wait_expired()
        assert process.send("stepper_get_position oid=0")[0]["pos"] == -STEPS
    node.process.send_signal(signal.SIGCONT)
    state = node.read_answer("trsync_state")
    assert (state["can_trigger"], state["trigger_reason"]) == (0, 1)
    asked = node.send("endstop_query_state oid=1")[0]
    triggered = begin + (asked["next_clock"] - rest - begin) % ROLLOVER
    statistics = node.end()
    logs = [EdgeLog(process.edge_log) for process in motors]
    for process in motors:
        process.end()
    steps = np.sort(np.concatenate([steps_of(log) for log in logs]))
    closed_ns = steps[round(5.0 / (MM / 2)) - 1]
    own = EdgeLog(node.edge_log)
    looks_ns = own.ticks_to_monotonic_ns(
        np.uint64(begin) + np.uint64(rest) * np.arange(200_000, dtype=np.uint64)
    )
    # The first look behind the step that closed it, though all looks came later than all steps.
    assert int(own.ticks_to_monotonic_ns(triggered)) == int(looks_ns[np.searchsorted(looks_ns, closed_ns)])
    assert statistics["plant_misses"] == 0
    assert PlantPage.at(tmp_path, "stop").item(PlantItemKind.SWITCH, "x").value == 1


def test_a_motors_node_that_stands_still_is_waited_for_and_then_given_up(start: Start) -> None:
    plant = NodePlant(
        node="stop",
        axes=(Axis(name="x", terms=(Term("a", "m", MM),), origin=5.0),),
        switches=(Switch(name="x", pin="PB0", axis="x", at=0.0, direction=-1),),
    )
    node, still = start(plant), start(motor("a"))
    rest = prepare_endstop(node)
    still.send("allocate_oids count=1")
    still.send("config_stepper oid=0 step_pin=0 dir_pin=1 invert_step=255 step_pulse_ticks=0")
    still.send("finalize_config crc=9")
    # A step each half second: wherever it is stopped, it has one to make before long.
    still.send(f"reset_step_clock oid=0 clock={still.clock() % ROLLOVER}")
    still.send(f"queue_step oid=0 interval={still.freq_hz // 2} count=1000 add=0")
    still.clock()  # an answer: it has read the steps
    still.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, still.process.pid, os.WSTOPPED)
    begin = node.clock() + node.freq_hz // 10
    home(node, begin, rest)
    node.send(
        f"trsync_set_timeout oid=0 clock={(begin + 3 * node.freq_hz) % ROLLOVER}"
    )  # however late it runs: far behind the other
    state = node.read_answer("trsync_state")
    assert state["trigger_reason"] == EXPIRED, "it goes on without it"
    statistics = node.end()
    assert statistics["plant_waits"] >= statistics["plant_misses"] >= 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"plant node=n\nbody name=b\n", r"n\.plant: line 2: capacity: is missing"),
        (b"plant node=n\nbody \0\n", r"n\.plant: line 2: this line: is too long, or no text"),
        (b"# " + b"x" * 70_000, r"n\.plant: it is too long"),
    ],
)
def test_a_file_that_describes_no_plant(tmp_path: Path, text: bytes, said: str) -> None:
    (tmp_path / "n.plant").write_bytes(text)
    process = NodeProcess(
        "uart", uuid="000000000001", uart=tmp_path / "tty", plant=tmp_path / "n.plant", name="node n"
    )
    with pytest.raises(CanductorError, match=f"node n did not become ready: .*{said}"):
        process.wait_ready()


def test_without_a_log_there_is_a_page_all_the_same(start: Start, tmp_path: Path) -> None:
    node = start(HOT, "toolhead", "--plant-log", "0")
    page = PlantPage.at(tmp_path, "hot")
    begun_ns = page.updated_ns
    node.end()
    assert page.updated_ns > begun_ns
    assert not (tmp_path / "hot.plantlog").exists()


def test_no_file_no_page_no_log(tmp_path: Path) -> None:
    process = NodeProcess("uart", uuid="000000000001", uart=tmp_path / "tty", plant=tmp_path / "n.plant")
    with pytest.raises(CanductorError, match=r"cannot read the plant .*n\.plant: No such file"):
        process.wait_ready()
    with pytest.raises(CanductorError, match=r"n\.page: the plant's page cannot be opened"):
        PlantPage.at(tmp_path, "n")
    with pytest.raises(CanductorError, match=r"n\.plantlog: the plant's log cannot be read"):
        list(plant_log(tmp_path, "n"))
    (tmp_path / "n.page").write_bytes(bytes(2_000_000))
    with pytest.raises(CanductorError, match="not the page of a running plant"):
        PlantPage.at(tmp_path, "n")
    (tmp_path / "n.plantlog").write_text("nonsense\n")
    with pytest.raises(CanductorError, match=r"n\.plantlog:1: not a line of a plant's log"):
        list(plant_log(tmp_path, "n"))
