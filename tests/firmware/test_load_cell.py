"""Load cells in the real firmware: HX71x, filters and triggers, with a chip of the plant at two pins."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from nodes.virtual.plant import Axis, Bed, LoadCell, NodePlant
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.firmware.host import Host
from tests.firmware.twin import Answer

HX, FILTER, TRIGGER, TRSYNC = 1, 2, 3, 4
DOUT, SCLK = 37, 38
RATE = 80.0
ZERO, PER_GRAM, DEPTH_MM, STIFFNESS = -1234, 100.0, 0.05, 4000.0
COUNTS = round(ZERO + PER_GRAM * DEPTH_MM * STIFFNESS)
REASON, ERROR_REASON = 1, 4
RAW_RANGE, OVERFLOW, MONITOR, LOST_COUNT = range(4)
LOST = -(2**31)
ABS_GE, GT, DIFF_PEAK_GT = range(3)
SCALE_BITS, COEFF_BITS = 10, 28
LARGER = 64
"""What filters get, by counts of the chip: they round."""
HOME = f"trigger_analog_home oid={TRIGGER} trsync_oid={TRSYNC} trigger_reason=1 error_reason=1 clock=0"


class CellHost(Host):
    """A host whose node has the plant: the nozzle is pressed into the bed, DEPTH_MM deep."""

    def __init__(self, *, gain: int = 1, **cell: float) -> None:
        super().__init__()
        values: dict[str, Any] = {
            "rate": RATE,
            "zero": ZERO,
            "counts_per_gram": PER_GRAM,
            "stiffness": STIFFNESS,
        }
        part = LoadCell(
            name="cell", dout_pin="PC5", sclk_pin="PC6", bed="bed", x="x", y="y", z="z", **values | cell
        )
        axes = tuple(Axis(name=name, terms=(), origin=-DEPTH_MM if name == "z" else 0.0) for name in "xyz")
        self.plant = self.node.start_plant(
            NodePlant(node="mcu", beds=(Bed(),), axes=axes, load_cells=(part,))
        )
        self.configure(
            f"config_hx71x oid={HX} gain_channel={gain} dout_pin={DOUT} sclk_pin={SCLK}",
            f"config_sos_filter oid={FILTER} max_sections=2",
            f"config_trigger_analog oid={TRIGGER} sos_filter_oid={FILTER}",
            f"hx71x_attach_trigger_analog oid={HX} trigger_analog_oid={TRIGGER}",
            f"config_trsync oid={TRSYNC}",
        )

    def ms(self, count: float) -> int:
        return round(count * 1e-3 * self.node.clock_freq)

    def query(self, rest_ms: float = 1) -> None:
        assert self.send(f"query_hx71x oid={HX} rest_ticks={self.ms(rest_ms)}") == []

    def fault(self, what: PlantFault) -> None:
        self.plant.page.set_fault(PlantItemKind.LOAD_CELL, "cell", what)

    def offset_scale(self, offset: int, scale: float, *, auto: bool = False) -> None:
        self.send(
            f"sos_filter_set_offset_scale oid={FILTER} offset={offset} scale={round(scale * 2**SCALE_BITS)}"
            f" scale_frac_bits={SCALE_BITS} auto_offset={int(auto)}"
        )

    def sections(self, sections: Sequence[Sequence[float]]) -> None:
        active = f"n_sections={len(sections)} coeff_frac_bits={COEFF_BITS}"
        self.send(f"sos_filter_set_active oid={FILTER} {active}")
        for index, section in enumerate(sections):
            words = " ".join(f"sos{i}={round(value * 2**COEFF_BITS)}" for i, value in enumerate(section))
            self.send(
                f"sos_filter_set_section oid={FILTER} section_idx={index} {words}",
                f"sos_filter_set_state oid={FILTER} section_idx={index} state0=0 state1=0",
            )

    def home(self, kind: int, value: int, *, in_ms: float = 0, monitor_max: int = 3) -> None:
        """Arm the trigger; readings are watched every 50 ms."""
        self.send(
            f"trsync_start oid={TRSYNC} report_clock=0 report_ticks=0 expire_reason=3",
            f"trigger_analog_set_trigger oid={TRIGGER} trigger_analog_type={kind} trigger_value={value}",
            f"trigger_analog_home oid={TRIGGER} trsync_oid={TRSYNC} trigger_reason={REASON}"
            f" error_reason={ERROR_REASON} clock={(self.now + self.ms(in_ms)) % 2**32}"
            f" monitor_ticks={self.ms(50)} monitor_max={monitor_max}",
        )

    def triggers(self, ms: float) -> list[int]:
        """Return the reasons of all triggers within so many MS."""
        return [one["trigger_reason"] for one in self.run(self.ms(ms)) if one.name == "trsync_state"]


def readings(said: Sequence[Answer]) -> list[int]:
    data = b"".join(one.args["data"] for one in said if one.name == "sensor_bulk_data")  # type: ignore[misc]
    return [int.from_bytes(data[at : at + 4], "big", signed=True) for at in range(0, len(data), 4)]


# ----------------------------------------------------------------------------------------------- the chip


@pytest.mark.parametrize(("gain", "share"), [(1, 1), (2, 0), (3, 0.5), (4, 0)])
def test_readings_come_in_bulk_each_once_and_the_status_counts_them(gain: int, share: float) -> None:
    """Of the channels only A is connected, at its gain of 128, or at 64."""
    host = CellHost(gain=gain)
    host.query()
    said = host.run(host.ms(2000))
    assert [one["sequence"] for one in said] == list(range(len(said)))
    found = readings(said)
    assert set(found) == {round(COUNTS * share)}
    status = host.ask(f"query_hx71x_status oid={HX}")
    assert status["next_sequence"] == len(said)
    assert len(found) + status["buffered"] / 4 == pytest.approx(2 * RATE - 4, abs=2)
    assert status["buffered"] % 4 == 0
    assert status["possible_overflows"] == 0
    host.send(f"query_hx71x oid={HX} rest_ticks=0")
    assert host.run(host.ms(500)) == []


@pytest.mark.parametrize(("zero", "exact"), [(-(2**22), -(2**22)), (2**22 + 5, 2**22 + 5), (-1, -1), (0, 0)])
def test_all_bits_and_the_sign_of_a_reading_arrive(zero: int, exact: int) -> None:
    host = CellHost(zero=zero, stiffness=1, counts_per_gram=0)
    host.query()
    assert set(readings(host.run(host.ms(500)))) == {exact}


def test_a_reading_from_before_the_query_is_not_told() -> None:
    """The chip has one from long ago; the nozzle has come to the bed since, as the drift says here."""
    host = CellHost(drift=10)
    host.query()
    host.run(host.ms(300))
    host.send(f"query_hx71x oid={HX} rest_ticks=0")
    host.run(host.ms(5000))
    host.query()
    first, *_ = readings(host.run(host.ms(400)))
    assert first > COUNTS + 10 * 5.2 * PER_GRAM


def test_a_chip_that_has_lost_count_is_told_and_goes_on_when_it_has_slept() -> None:
    """It shows a bit, which is 0, where it should have none. Then SCLK is high until the next look."""
    host = CellHost()
    host.query()
    assert set(readings(host.run(host.ms(500)))) == {COUNTS}
    host.fault(PlantFault.GARBLED)
    lost = readings(host.run(host.ms(1500)))
    assert set(lost) <= {COUNTS, LOST}
    assert 10 <= lost.count(LOST) <= 24, "each time it settles for four conversions"
    host.fault(PlantFault.SOUND)
    host.run(host.ms(1000))
    assert set(readings(host.run(host.ms(1000)))) == {COUNTS}


def test_waiting_readings_count_in_the_status() -> None:
    host = CellHost()
    host.query()
    host.run(host.ms(200))
    before = host.ask(f"query_hx71x_status oid={HX}")["buffered"]
    host.query(rest_ms=1000)
    assert host.ask(f"query_hx71x_status oid={HX}")["buffered"] == 0, "it is one from before"
    assert before % 4 == 0


def test_what_the_host_does_not_take_is_counted_as_lost() -> None:
    host = CellHost(rate=900)
    host.query()
    host.node.run_until(host.now + host.ms(60_000))
    host.receive()
    assert host.ask(f"query_hx71x_status oid={HX}")["possible_overflows"] > 100


# --------------------------------------------------------------------------------------------- triggers


@pytest.mark.parametrize(
    ("kind", "value", "triggers"),
    [
        (ABS_GE, 20_000, True),
        (ABS_GE, 20_001, False),
        (GT, 19_999, True),
        (GT, 20_000, False),
        (DIFF_PEAK_GT, 1, False),
    ],
)
def test_a_force_is_compared_exactly(kind: int, value: int, triggers: bool) -> None:
    """The force is 200 g, here in hundredths."""
    host = CellHost()
    host.query()
    host.run(host.ms(100))
    host.offset_scale(ZERO, 1)
    host.home(kind, value)
    assert host.triggers(200) == ([REASON] if triggers else [])


def test_a_force_upwards_counts_by_its_size_and_a_peak_by_how_far_it_falls() -> None:
    host = CellHost(counts_per_gram=-PER_GRAM)
    host.query()
    host.offset_scale(ZERO, 1)
    host.home(ABS_GE, 20_000)
    assert host.triggers(200) == [REASON]
    host = CellHost(drift=-10)
    host.query()
    host.offset_scale(ZERO, 1)
    host.home(DIFF_PEAK_GT, 500)  # 5 g, which are lost in half a second
    assert host.triggers(450) == []
    assert host.triggers(150) == [REASON]


def test_it_triggers_not_before_its_time_and_tells_when() -> None:
    host = CellHost()
    host.query()
    host.run(host.ms(100))
    begin = host.now
    host.home(GT, 100, in_ms=130)
    assert host.ask(f"trigger_analog_query_state oid={TRIGGER}")["homing"] == 1
    assert host.triggers(129) == []
    assert host.triggers(20) == [REASON]
    state = host.ask(f"trigger_analog_query_state oid={TRIGGER}")
    assert state["homing"] == 0
    assert 0 <= (state["homing_clock"] - begin) % 2**32 - host.ms(130) < host.ms(14)


def test_it_is_ended_without_a_trigger() -> None:
    host = CellHost()
    host.query()
    host.home(GT, 100, in_ms=100)
    host.send(
        f"trigger_analog_home oid={TRIGGER} trsync_oid={TRSYNC} trigger_reason=0 error_reason=0 clock=0"
        " monitor_ticks=0 monitor_max=0"
    )
    assert host.triggers(400) == []
    assert host.ask(f"trigger_analog_query_state oid={TRIGGER}")["homing"] == 0


def test_the_first_reading_may_be_the_offset() -> None:
    host = CellHost(drift=10)
    host.query()
    host.run(host.ms(100))
    host.offset_scale(99, 1, auto=True)
    host.home(ABS_GE, 1000)  # 10 g more than that
    assert host.triggers(950) == []
    assert host.triggers(150) == [REASON]


def test_a_chip_that_has_lost_count_ends_homing() -> None:
    host = CellHost()
    host.query()
    host.run(host.ms(100))
    host.offset_scale(ZERO, 1)
    host.home(GT, 50_000)
    host.fault(PlantFault.GARBLED)
    assert host.triggers(20) == [ERROR_REASON + LOST_COUNT]


@pytest.mark.parametrize("what", [PlantFault.OPEN, PlantFault.DEAD])
def test_a_silent_sensor_ends_homing_after_some_checks(what: PlantFault) -> None:
    host = CellHost()
    host.query()
    host.run(host.ms(100))
    host.offset_scale(ZERO, 1)
    host.home(GT, 50_000)
    assert host.triggers(330) == []
    host.fault(what)
    assert host.triggers(120) == [], "two checks are no silence yet, with one that began before"
    assert host.triggers(100) == [ERROR_REASON + MONITOR]
    state = host.ask(f"trigger_analog_query_state oid={TRIGGER}")
    assert state["homing"] == 0
    assert (host.now - state["homing_clock"]) % 2**32 < host.ms(100)


@pytest.mark.parametrize(
    ("low", "high", "triggers"),
    [
        (COUNTS, COUNTS, False),
        (COUNTS + 1, COUNTS + 2, True),
        (-(2**23), COUNTS - 1, True),
    ],
)
def test_a_reading_out_of_its_range_ends_homing(low: int, high: int, triggers: bool) -> None:
    host = CellHost()
    host.query()
    host.send(f"trigger_analog_set_raw_range oid={TRIGGER} raw_min={low} raw_max={high}")
    host.offset_scale(ZERO, 1)
    host.home(GT, 50_000, in_ms=10_000)
    assert host.triggers(200) == ([ERROR_REASON + RAW_RANGE] if triggers else [])


@pytest.mark.parametrize(
    ("scale", "overflows"), [(2**29 // 20_000, False), (2**29 // 20_000 + 1, True), (-(2**18), True)]
)
def test_a_reading_too_large_for_the_filter_ends_homing(scale: int, overflows: bool) -> None:
    host = CellHost()
    host.query()
    host.offset_scale(ZERO, scale)
    host.home(GT, 2**30)
    assert host.triggers(200) == ([ERROR_REASON + OVERFLOW] if overflows else [])


def test_an_offset_that_no_reading_can_have_ends_homing() -> None:
    host = CellHost()
    host.query()
    host.send(
        f"sos_filter_set_offset_scale oid={FILTER} offset={-(2**31)} scale=1 scale_frac_bits=31 auto_offset=0"
    )
    host.home(GT, 2**30)
    assert host.triggers(200) == [ERROR_REASON + OVERFLOW]


def test_a_shutdown_disarms_it() -> None:
    host = CellHost()
    host.query()
    host.home(GT, 2**30)
    host.run(host.ms(100))
    host.send("emergency_stop")
    assert {one.name for one in host.run(host.ms(1000))} <= {"stats"}


# ---------------------------------------------------------------------------------------------- filters


def high_pass(cutoff_hz: float) -> tuple[float, ...]:
    """Return b0, b1, b2, a1, a2 of a Butterworth filter of the second order, by the bilinear transform."""
    k = math.tan(math.pi * cutoff_hz / RATE)
    norm = 1 / (1 + math.sqrt(2) * k + k * k)
    return norm, -2 * norm, norm, 2 * (k * k - 1) * norm, (1 - math.sqrt(2) * k + k * k) * norm


def filtered(values: np.ndarray, sections: Sequence[Sequence[float]]) -> np.ndarray:
    """Return VALUES filtered by the difference equation, in floating point."""
    for b0, b1, b2, a1, a2 in sections:
        out = np.zeros(len(values) + 2)
        x = np.concatenate([[0.0, 0.0], values])
        for n in range(2, len(x)):
            out[n] = b0 * x[n] + b1 * x[n - 1] + b2 * x[n - 2] - a1 * out[n - 1] - a2 * out[n - 2]
        values = out[2:]
    return values


def first_trigger(sections: Sequence[Sequence[float]], value: int) -> tuple[float, np.ndarray]:
    """Return when, in s, a force that rises by 30 g/s is above VALUE, and all readings."""
    host = CellHost(drift=30, rate=79.3)
    host.query()
    host.sections(sections)
    host.offset_scale(COUNTS, LARGER)
    host.home(GT, value)
    said = host.run(host.ms(1500))
    assert [one["trigger_reason"] for one in said if one.name == "trsync_state"] == [REASON]
    clock = host.ask(f"trigger_analog_query_state oid={TRIGGER}")["homing_clock"]
    return clock / host.node.clock_freq, np.array(readings(said), dtype=np.float64)


@pytest.mark.parametrize("sections", [(), (high_pass(0.8),), (high_pass(0.8), high_pass(0.3))])
def test_filters_do_what_their_difference_equation_says(sections: Sequence[Sequence[float]]) -> None:
    """Which reading is the first above a value is compared with what floating point says."""
    begin, raw = first_trigger(sections, -(2**20))
    exact = LARGER * filtered(raw - COUNTS, sections)
    top = int(np.argmax(exact))
    assert top >= 6
    for number in (1, 2, 4, top - 2):
        between = (exact[number - 1] + exact[number]) / 2
        assert exact[number] - exact[number - 1] > LARGER, "else rounding decides"
        at, _ = first_trigger(sections, math.floor(between))
        assert round((at - begin) * 79.3) == number


def test_states_begin_as_the_host_says() -> None:
    """y = s0 of the first reading, of the second one s1: in whole numbers."""
    for value, triggers in ((776, [REASON]), (777, [])):
        host = CellHost()
        host.query()
        host.run(host.ms(100))
        host.sections([(0, 0, 0, 0, 0)])
        host.offset_scale(0, 0)
        host.send(f"sos_filter_set_state oid={FILTER} section_idx=0 state0=-5 state1=777")
        host.home(GT, value)
        assert host.triggers(300) == triggers


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (f"sos_filter_set_section oid={FILTER} section_idx=2 sos0=0 sos1=0 sos2=0 sos3=0 sos4=0", "section"),
        (f"sos_filter_set_state oid={FILTER} section_idx=2 state0=0 state1=0", "section"),
        (f"sos_filter_set_active oid={FILTER} n_sections=3 coeff_frac_bits=0", "section"),
        (f"sos_filter_set_active oid={FILTER} n_sections=2 coeff_frac_bits=32", "fraction bits"),
        (
            f"sos_filter_set_offset_scale oid={FILTER} offset=0 scale=0 scale_frac_bits=32 auto_offset=0",
            "fraction bits",
        ),
        (f"trigger_analog_set_trigger oid={TRIGGER} trigger_analog_type=3 trigger_value=0", "type"),
        (f"query_hx71x oid={HX} rest_ticks={2**31}", "rest_ticks"),
        (
            f"{HOME} monitor_ticks=0 monitor_max=1",
            "monitor_ticks",
        ),
        (
            f"{HOME} monitor_ticks={2**31} monitor_max=1",
            "monitor_ticks",
        ),
    ],
)
def test_what_cannot_be_is_refused(command: str, text: str) -> None:
    host = CellHost()
    (died,) = [one for one in host.send(command) if one.name == "shutdown"]
    assert text in host.text(died)
