"""The plant of real node processes: what heats, switches and breaks, against models of the test's own."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from nodes.errors import CanductorError
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.plant import Axis, Beta, Body, Fan, Heater, NodePlant, Sensor, Stepper, Switch, Term
from nodes.virtual.plant_log import plant_log
from nodes.virtual.plant_page import Fault, Kind, PlantPage
from nodes.virtual.processes import NodeProcess
from tests.firmware.test_linux_board import FREQUENCIES, PATIENCE_S, ROLLOVER, Process

PA0, PA1, PA2, PB0, PB1 = 0, 1, 2, 16, 17
STEPS, MM = 600, 0.0125
HOT = NodePlant(
    node="hot",
    ambient=20.0,
    bodies=(Body(name="block", capacity=2.0, loss=0.4),),
    heaters=(Heater(name="block", pin="PA0", body="block", power=90.0),),
    fans=(Fan(name="part", pin="PA1", lag=0.05, tach_pin="PB1"),),
    sensors=(Sensor(name="block", pin="PB0", node="hot", body="block", curve=Beta(beta=3950.0), lag=0.15),),
)
"""A block that warms up within a test's time."""

Start = Callable[..., Process]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start the node of a plant; all are in one folder."""
    with ExitStack() as stack:

        def begin(plant: NodePlant, flavour: str = "toolhead", *options: str) -> Process:
            folder = tmp_path / plant.node
            folder.mkdir()
            process = Process(folder, flavour, "--plant", str(plant.write(tmp_path)), *options)
            stack.callback(process.kill)
            process.start()
            return process

        yield begin


def clock_of(process: Process) -> int:
    uptime = process.send("get_uptime")[0]
    return int(uptime["high"]) * ROLLOVER + int(uptime["clock"])


def wait_until(true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline_s, "it does not happen"
        time.sleep(0.01)


def expected_sums(since_s: np.ndarray[tuple[int], np.dtype[np.float64]], count: int) -> list[float]:
    """Return sums of COUNT samples of HOT, so many seconds after its heater went on: by formula."""
    tau, lag, end = 2.0 / 0.4, 0.15, 90.0 / 0.4
    rise = 1 - (tau * np.exp(-since_s / tau) - lag * np.exp(-since_s / lag)) / (tau - lag)
    kelvin = 20.0 + end * np.where(since_s > 0, rise, 0.0) + 273.15
    ohm = 100_000.0 * np.exp(3950.0 * (1 / kelvin - 1 / 298.15))
    return list(count * 4095 * ohm / (ohm + 4700.0))


def test_a_heater_that_is_on_warms_its_sensor_as_the_formula_says(start: Start) -> None:
    # Also over the 32-bit rollover of the clock, two seconds from the start.
    freq = FREQUENCIES["toolhead"]
    node = start(HOT, "toolhead", "--start-clock", str(ROLLOVER - 2 * freq))
    node.send("allocate_oids count=2")
    node.send("config_digital_out oid=0 pin=0 value=0 default_value=0 max_duration=0")
    node.send("config_analog_in oid=1 pin=16", "finalize_config crc=1")
    begin, rest = clock_of(node) + freq, freq // 20  # a busy computer may take most of that second
    node.send(
        f"query_analog_in oid=1 clock={begin % ROLLOVER} sample_ticks=1000 sample_count=8 "
        f"rest_ticks={rest} bytes_per_report=2 min_value=0 max_value=65535 range_check_count=4"
    )
    node.send(f"queue_digital_out oid=0 clock={(begin + freq // 8) % ROLLOVER} on_ticks=1")
    sums, clocks = [], []
    for _ in range(30):
        answer = node.read_answer("analog_in_state")
        clocks.append((int(answer["next_clock"]) - rest - begin) % ROLLOVER)
        values = answer.args["values"]
        assert isinstance(values, bytes)
        sums.append(int.from_bytes(values, "little"))
    assert clocks[-1] > freq
    since_s = (np.array(clocks) + 3500 - freq // 8) / freq  # the middle of eight samples
    assert sums == pytest.approx(expected_sums(since_s, 8), abs=8)  # each sample is rounded
    assert sums[0] - sums[-1] > 300


def power_of(folder: Path, name: str) -> list[tuple[int, float]]:
    return [(e.at_ns, e.value) for e in plant_log(folder, name) if e.kind == "power"]


def test_without_its_host_a_heater_ends_by_itself_and_its_log_shows_when(
    start: Start, tmp_path: Path
) -> None:
    node, freq = start(HOT), FREQUENCIES["toolhead"]
    node.send("allocate_oids count=1")
    max_duration = freq // 4
    node.send(f"config_digital_out oid=0 pin=0 value=0 default_value=0 max_duration={max_duration}")
    node.send("finalize_config crc=1")
    node.send(f"queue_digital_out oid=0 clock={(clock_of(node) + freq) % ROLLOVER} on_ticks=1")
    # And now nobody says anything any more.
    wait_until(lambda: len(power_of(tmp_path, "hot")) == 2)
    wait_until(lambda: [e.kind for e in plant_log(tmp_path, "hot")][-1] == "body")
    (on_ns, on_w), (off_ns, off_w) = power_of(tmp_path, "hot")
    assert (on_w, off_w) == (90.0, 0.0)
    log = EdgeLog(node.edge_log)
    node.end()
    ((clocks, _, levels),) = log.edges(PA0)
    assert levels.tolist() == [1, 0]
    assert int(clocks[1] - clocks[0]) == max_duration
    assert np.array([on_ns, off_ns]) == pytest.approx(log.ticks_to_monotonic_ns(clocks), abs=2)
    assert PlantPage.at(tmp_path, "hot").item(Kind.HEATER, "block").extra == pytest.approx(22.5, rel=1e-6)


def test_what_breaks_at_run_time(start: Start, tmp_path: Path) -> None:
    node = start(HOT)
    page = PlantPage.at(tmp_path, "hot")
    node.send("allocate_oids count=2")
    node.send("config_digital_out oid=0 pin=0 value=1 default_value=0 max_duration=0")
    node.send("config_analog_in oid=1 pin=16", "finalize_config crc=1")
    wait_until(lambda: page.temperature("block") > 30)
    page.set_fault(Kind.HEATER, "block", Fault.DEAD)
    wait_until(lambda: page.item(Kind.HEATER, "block").value == 0)
    page.set_fault(Kind.HEATER, "block", Fault.STUCK_ON)
    node.send("update_digital_out oid=0 value=0")
    warm = page.temperature("block")
    wait_until(lambda: page.temperature("block") > warm + 10)
    page.set_fault(Kind.SENSOR, "block", Fault.FALLEN)
    wait_until(lambda: page.item(Kind.SENSOR, "block").value < 21)
    assert page.temperature("block") > 40
    # A broken wire is out of the range a host allows: the firmware shuts down.
    clock = (clock_of(node) + FREQUENCIES["toolhead"] // 2) % ROLLOVER
    node.send(
        f"query_analog_in oid=1 clock={clock} sample_ticks=1000 sample_count=8 rest_ticks=1000000 "
        "bytes_per_report=2 min_value=800 max_value=32700 range_check_count=4"
    )
    node.read_answer("analog_in_state")
    page.set_fault(Kind.SENSOR, "block", Fault.OPEN)
    reason = node.words.raw["enumerations"]["static_string_id"]
    assert node.read_answer("shutdown")["static_string_id"] == reason["ADC out of range"]
    assert page.item(Kind.SENSOR, "block").extra == 4095
    assert [int(e.value) for e in plant_log(tmp_path, "hot") if e.kind == "fault"] == [5, 4, 3, 1]
    with pytest.raises(CanductorError, match="a sensor cannot be stuck_on; it can be open, shorted, fallen"):
        page.set_fault(Kind.SENSOR, "block", Fault.STUCK_ON)
    with pytest.raises(CanductorError, match="there is no fan 'fan'; there is part"):
        page.item(Kind.FAN, "fan")


def motor(name: str) -> NodePlant:
    return NodePlant(node=name, steppers=(Stepper(name="m", step_pin="PA0", dir_pin="PA1", both_edges=True),))


def home(node: Process, clock: int, rest: int) -> None:
    node.send("allocate_oids count=2", "config_trsync oid=0", "config_endstop oid=1 pin=16 pull_up=0")
    node.send("finalize_config crc=1")
    node.send(f"trsync_start oid=0 report_clock={clock % ROLLOVER} report_ticks=0 expire_reason=2")
    node.send(
        f"endstop_home oid=1 clock={clock % ROLLOVER} sample_ticks=10 sample_count=1 rest_ticks={rest} "
        "pin_value=1 trsync_oid=0 trigger_reason=1"
    )


def stands_at(process: Process, position: int) -> bool:
    return process.send("stepper_get_position oid=0")[0]["pos"] == position


def steps_of(log: EdgeLog) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.concatenate([log.ticks_to_monotonic_ns(clock) for clock, _ in log.steps(PA0, PA1, True)])


def test_an_endstop_switches_by_the_motors_of_two_other_nodes_to_the_sample(start: Start) -> None:
    # x = 5 mm + (a + b) / 2, as of a corexy, both go down: it switches at 0, with 400 of their steps.
    terms = tuple(Term(name, "m", MM / 2) for name in "ab")
    stop = NodePlant(
        node="stop",
        axes=(Axis(name="x", terms=terms, origin=5.0),),
        switches=(Switch(name="x", pin="PB0", axis="x", at=0.0, direction=-1),),
    )
    node = start(stop, "toolhead", "--rate-ppm", "70")
    motors = [start(motor("a"), "mainboard", "--rate-ppm", "-90"), start(motor("b"), "toolhead")]
    freqs = [FREQUENCIES["mainboard"], FREQUENCIES["toolhead"]]
    for process in motors:
        process.send("allocate_oids count=1")
        process.send("config_stepper oid=0 step_pin=0 dir_pin=1 invert_step=255 step_pulse_ticks=0")
        process.send("finalize_config crc=1")
    freq = FREQUENCIES["toolhead"]
    rest = freq // 20000  # a look each 50 µs
    begin = clock_of(node) + freq
    home(node, begin, rest)
    for process, its_freq in zip(motors, freqs, strict=True):
        at = (clock_of(process) + its_freq * 5 // 4) % ROLLOVER
        process.send(f"reset_step_clock oid=0 clock={at}")
        process.send(f"queue_step oid=0 interval={its_freq // 2000} count={STEPS} add=0")
    state = node.read_answer("trsync_state")
    assert (state["can_trigger"], state["trigger_reason"]) == (0, 1)
    asked = node.send("endstop_query_state oid=1")[0]
    triggered = begin + (int(asked["next_clock"]) - rest - begin) % ROLLOVER
    for process in motors:
        wait_until(partial(stands_at, process, -STEPS))
    statistics = node.end()
    logs = [EdgeLog(process.edge_log) for process in motors]
    for process in motors:
        process.end()
    steps = np.sort(np.concatenate([steps_of(log) for log in logs]))
    closed_ns = steps[round(5.0 / (MM / 2)) - 1]
    own = EdgeLog(node.edge_log)
    looks_ns = own.ticks_to_monotonic_ns(
        np.uint64(begin) + np.uint64(rest) * np.arange(80_000, dtype=np.uint64)
    )
    # The first look behind the step that closed it, however late the kernel woke any of the three.
    assert int(own.ticks_to_monotonic_ns(triggered)) == int(looks_ns[np.searchsorted(looks_ns, closed_ns)])
    assert statistics["plant_misses"] == 0
    assert PlantPage.at(node.edge_log.parent.parent, "stop").item(Kind.SWITCH, "x").value == 1


def test_a_motor_that_is_off_moves_nothing(start: Start, tmp_path: Path) -> None:
    stepper = Stepper(name="m", step_pin="PA0", dir_pin="PA1", enable_pin="PA2", enable_inverted=True)
    axis = Axis(name="x", terms=(Term("n", "m", 1.0),), max=3.0)
    node = start(NodePlant(node="n", steppers=(stepper,), axes=(axis,)))
    page = PlantPage.at(tmp_path, "n")

    def step(times: int) -> None:
        for _ in range(times):
            node.send("set_digital_out pin=0 value=1", "set_digital_out pin=0 value=0")

    node.send("set_digital_out pin=1 value=1")
    step(2)
    node.send("set_digital_out pin=2 value=1")
    step(1)
    assert (page.motors["m"].count, page.motors["m"].lost) == (2, 1)
    node.send("set_digital_out pin=2 value=0")
    step(4)
    assert (page.motors["m"].count, page.motors["m"].lost) == (3, 4)  # against its stop


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


def test_a_process_without_end_keeps_no_log(start: Start, tmp_path: Path) -> None:
    node = start(HOT, "toolhead", "--plant-log", "0")
    page = PlantPage.at(tmp_path, "hot")
    begun_ns = page.updated_ns
    wait_until(lambda: page.updated_ns > begun_ns)
    node.end()
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
    with pytest.raises(CanductorError, match="this is no page of a running plant"):
        PlantPage.at(tmp_path, "n")
    (tmp_path / "n.plantlog").write_text("nonsense\n")
    with pytest.raises(CanductorError, match=r"n\.plantlog:1: this is no line of a plant's log"):
        list(plant_log(tmp_path, "n"))
