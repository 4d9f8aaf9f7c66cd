"""Tasks and shutdown hooks look through all objects of a kind: those with the first and the last oid, too."""

import pytest

from tests.firmware.host import Host

COUNT = 6
REPORTS = {
    "counter_state": (
        "config_counter oid={oid} pin=70 pull_up=1",
        "query_counter oid={oid} clock={clock} poll_ticks=100 sample_ticks=1000",
    ),
    "analog_in_state": (
        "config_analog_in oid={oid} pin=50",
        (
            "query_analog_in oid={oid} clock={clock} sample_ticks=10 sample_count=1 rest_ticks=1000"
            " bytes_per_report=2 min_value=0 max_value=4095 range_check_count=0"
        ),
    ),
    "tmcuart_response": (
        "config_tmcuart oid={oid} rx_pin=71 pull_up=1 tx_pin=72 bit_time=400",
        "tmcuart_send oid={oid} write=05c3 read=0",
    ),
    "trsync_state": (
        "config_trsync oid={oid}",
        "trsync_start oid={oid} report_clock={clock} report_ticks=1000 expire_reason=1",
    ),
}


def configured(config: str, oids: tuple[int, ...]) -> Host:
    host = Host()
    host.configure(*(config.format(oid=oid) for oid in oids), oids=COUNT)
    return host


@pytest.mark.parametrize("response", REPORTS)
def test_every_object_reports_and_none_after_a_shutdown(response: str) -> None:
    config, query = REPORTS[response]
    oids = (0, 2, COUNT - 1)
    host = configured(config, oids)
    for oid in oids:
        assert host.send(query.format(oid=oid, clock=host.now + 5000)) == []
    said = host.run(20_000)
    assert {answer.name for answer in said} == {response}
    assert sorted({answer["oid"] for answer in said}) == list(oids)
    for oid in oids:
        host.send(query.format(oid=oid, clock=host.now + 5000))
    host.dies("emergency_stop")
    host.send("clear_shutdown")
    assert host.run(20_000) == []
    for oid in oids:
        assert host.send(query.format(oid=oid, clock=host.now + 5000)) == []
    assert sorted({answer["oid"] for answer in host.run(20_000)}) == list(oids), "each may begin again"


@pytest.mark.parametrize("oid", [0, COUNT - 1])
def test_buttons_report_and_end_with_a_shutdown(oid: int) -> None:
    host = Host()
    host.configure(
        f"config_buttons oid={oid} button_count=1",
        f"buttons_add oid={oid} pos=0 pin=60 pull_up=1",
        oids=COUNT,
    )
    query = f"buttons_query oid={oid} clock={{}} rest_ticks=1000 retransmit_count=10 invert=0"
    host.send(query.format(host.now + 1000))
    host.node.set_input(60, 1)
    assert {answer["oid"] for answer in host.run(20_000)} == {oid}
    host.dies("emergency_stop")
    host.send("clear_shutdown")
    assert host.run(50_000) == []


@pytest.mark.parametrize("oid", [0, COUNT - 1])
@pytest.mark.parametrize("kind", ["stepper", "digital_out", "pwm_out"])
def test_what_moves_or_heats_ends_with_a_shutdown(kind: str, oid: int) -> None:
    host = Host()
    host.configure(
        {
            "stepper": f"config_stepper oid={oid} step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0",
            "digital_out": f"config_digital_out oid={oid} pin=40 value=0 default_value=0 max_duration=0",
            "pwm_out": f"config_pwm_out oid={oid} pin=41 cycle_ticks=9 value=0 default_value=0"
            " max_duration=0",
        }[kind],
        oids=COUNT,
    )
    if kind == "stepper":
        host.send(
            f"reset_step_clock oid={oid} clock={host.now}",
            f"queue_step oid={oid} interval=1000 count=99 add=0",
        )
    elif kind == "digital_out":
        host.send(f"queue_digital_out oid={oid} clock={host.now + 1000} on_ticks=1")
    else:
        host.send(f"queue_pwm_out oid={oid} clock={host.now + 1000} value=9")
    host.run(5500)
    assert len(host.steps(3)) == (5 if kind == "stepper" else 0)
    assert (host.node.level(40), host.node.pwm(41)) == (int(kind == "digital_out"), 9 * (kind == "pwm_out"))
    host.dies("emergency_stop")
    assert (host.node.level(40), host.node.pwm(41)) == (0, 0)
    host.send("clear_shutdown")
    host.run(20_000)
    assert len(host.steps(3)) == (5 if kind == "stepper" else 0)
