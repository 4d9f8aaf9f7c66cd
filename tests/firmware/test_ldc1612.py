"""The LDC1612 and bulk readings in the real firmware, with a chip of the plant on the board's I2C bus."""

import math

import pytest

from nodes.virtual.plant import Axis, Bed, Coil, NodePlant
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.firmware.host import Host
from tests.firmware.twin import Answer

I2C, LDC, TRSYNC = 1, 2, 3
INTB_PIN = 38
HEIGHT_MM = 2.0
REASON, ERROR_REASON = 1, 4
COUNT = 12e6 * 2 / 2**28
"""Hz of a step of a reading, with the coil's frequency divided by 2."""
FREQUENCY = 3e6 * (1 + 0.1 * math.exp(-HEIGHT_MM / 3))
SET_UP = ("080bb8", "100400", "142001", "19f801", "1b020f", "1e7800", "1a1601")
"""250 readings a second, by registers and values."""


def plant() -> NodePlant:
    coil = Coil(name="probe", bus=1, address=43, bed="bed", x="x", y="y", z="z", intb_pin="PC6")
    axes = tuple(Axis(name=name, terms=(), origin=HEIGHT_MM if name == "z" else 0.0) for name in "xyz")
    return NodePlant(node="mcu", beds=(Bed(),), axes=axes, coils=(coil,))


class ReadingHost(Host):
    """A host whose node has the plant."""

    def __init__(self) -> None:
        super().__init__()
        self.plant = self.node.start_plant(plant())


def reading_host(*, intb: bool = False, wake: bool = True) -> ReadingHost:
    host = ReadingHost()
    host.configure(
        *(f"config_i2c oid={I2C}", f"i2c_set_bus oid={I2C} i2c_bus=1 rate=400000 address=43"),
        f"config_ldc1612_with_intb oid={LDC} i2c_oid={I2C} intb_pin={INTB_PIN}"
        if intb
        else f"config_ldc1612 oid={LDC} i2c_oid={I2C}",
        f"config_trsync oid={TRSYNC}",
    )
    for write in SET_UP if wake else ():
        assert host.ask(f"i2c_transfer oid={I2C} write={write} read_len=0")["i2c_bus_status"] == 0
    return host


def ms(host: Host, count: float) -> int:
    return round(count * 1e-3 * host.node.clock_freq)


def query(host: Host) -> None:
    assert host.send(f"query_ldc1612 oid={LDC} rest_ticks={ms(host, 2)}") == []


def home(host: Host, threshold_hz: float) -> None:
    host.send(
        f"trsync_start oid={TRSYNC} report_clock=0 report_ticks=0 expire_reason=3",
        f"ldc1612_setup_home oid={LDC} clock={host.now + ms(host, 50)} trsync_oid={TRSYNC}"
        f" threshold={round(threshold_hz / COUNT)} trigger_reason={REASON} error_reason={ERROR_REASON}",
    )


def fault(host: ReadingHost, what: PlantFault) -> None:
    host.plant.page.set_fault(PlantItemKind.COIL, "probe", what)


def bytes_of(answer: Answer) -> bytes:
    data = answer.args["data"]
    assert isinstance(data, bytes)
    return data


def triggers(said: list[Answer]) -> list[int]:
    return [answer["trigger_reason"] for answer in said if answer.name == "trsync_state"]


@pytest.mark.parametrize("intb", [False, True])
def test_readings_come_in_bulk_each_once_and_the_status_counts_them(intb: bool) -> None:
    host = reading_host(intb=intb)
    query(host)
    said = host.run(ms(host, 1000))
    assert [answer["sequence"] for answer in said] == list(range(len(said)))
    data = b"".join(bytes_of(answer) for answer in said)
    values = [int.from_bytes(data[at : at + 4], "big") for at in range(0, len(data), 4)]
    assert 230 <= len(values) <= 250
    assert [value * COUNT for value in values] == pytest.approx([FREQUENCY] * len(values), abs=COUNT)
    status = host.ask(f"query_status_ldc1612 oid={LDC}")
    assert status["next_sequence"] == len(said)
    assert 0 <= status["buffered"] <= 48
    assert len(values) + status["buffered"] / 4 == pytest.approx(249, abs=2)
    assert status["possible_overflows"] == 0
    host.send(f"query_ldc1612 oid={LDC} rest_ticks=0")
    assert host.run(ms(host, 500)) == []


def test_what_the_host_does_not_take_is_counted_as_lost() -> None:
    host = reading_host()
    query(host)
    host.node.run_until(host.now + ms(host, 60_000))  # 64 KiB wait in the board
    host.receive()
    assert host.ask(f"query_status_ldc1612 oid={LDC}")["possible_overflows"] > 100


def test_a_silent_sensor_is_an_error_in_every_tenth_look() -> None:
    host = reading_host()
    fault(host, PlantFault.DEAD)
    query(host)
    host.run(ms(host, 1000))
    said = host.ask(f"query_status_ldc1612 oid={LDC}")
    readings = said["next_sequence"] * 12 + said["buffered"] // 4
    assert readings == 500 // 10
    assert said["buffered"] % 4 == 0, "whole readings, and none waits in the chip"


def test_each_query_begins_to_count_silent_looks() -> None:
    host = reading_host()
    fault(host, PlantFault.DEAD)
    for looks in (5, 9):
        query(host)
        host.run(ms(host, 2 * looks + 1))
    status = f"query_status_ldc1612 oid={LDC}"
    assert host.ask(status)["buffered"] == 0
    host.run(ms(host, 2))
    assert host.ask(status)["buffered"] == 4


def test_homing_is_ended_without_a_stop_group() -> None:
    host = reading_host()
    query(host)
    home(host, FREQUENCY - 100)
    names = ("clock", "trsync_oid", "threshold", "trigger_reason", "error_reason")
    assert host.send(f"ldc1612_setup_home oid={LDC} {' '.join(f'{name}=0' for name in names)}") == []
    assert triggers(host.run(ms(host, 100))) == []


def test_a_reading_above_the_threshold_triggers_the_stop_group_not_before_its_time() -> None:
    host = reading_host()
    query(host)
    home(host, FREQUENCY + 100)
    assert triggers(host.run(ms(host, 300))) == []
    home(host, FREQUENCY - 100)
    begin = host.now
    assert triggers(host.run(ms(host, 49))) == []
    assert triggers(host.run(ms(host, 10))) == [REASON]
    state = host.ask(f"query_ldc1612_home_state oid={LDC}")
    assert state["homing"] == 0
    assert ms(host, 50) <= state["trigger_clock"] - begin <= ms(host, 56)


@pytest.mark.parametrize(
    ("what", "number"), [(PlantFault.SHORTED, 0), (PlantFault.OPEN, 1), (PlantFault.DEAD, 3)]
)
def test_a_sensor_that_fails_ends_homing_with_a_reason_of_its_own(what: PlantFault, number: int) -> None:
    host = reading_host()
    query(host)
    host.run(ms(host, 100))
    home(host, FREQUENCY + 100)
    host.run(ms(host, 60))
    fault(host, what)
    assert triggers(host.run(ms(host, 30))) == [ERROR_REASON + number]


def test_a_bus_that_does_not_exist_and_transfers_too_large_are_refused() -> None:
    host = reading_host(wake=False)
    assert host.ask(f"i2c_transfer oid={I2C} write=7e read_len=2").args["response"] == b"\x54\x49"
    fault(host, PlantFault.OPEN)
    answer = host.ask(f"i2c_transfer oid={I2C} write=7e read_len=2")
    assert (answer["i2c_bus_status"], answer.args["response"]) == (3, b"")
    (died,) = [
        one for one in host.send(f"i2c_transfer oid={I2C} write=7e read_len=49") if one.name == "shutdown"
    ]
    assert host.text(died) == "i2c transfer too large"
