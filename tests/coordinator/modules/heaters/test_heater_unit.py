"""One heater by itself, to the number: what it tells, what it sends and when, what it counts."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.parser import WordError
from coordinator.heat.holding import Held
from coordinator.heat.mpc import Mpc
from coordinator.heat.verify import VerifyOptions
from coordinator.heat.watermark import Watermark
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError
from tests.coordinator.modules.scripted_live import Driven, heater
from tests.stages.heat_machine import BED, FAN, HOTEND_PID

CHAMBER = (
    "\n[heater_generic chamber]\nheater_pin: PC3\nsensor_type: Generic 3950\nsensor_pin: PA12\nmin_temp: 5\n"
    "max_temp: 100\ncontrol: watermark\nmax_power: 0.123456\n"
)
MODEL = (
    "control: mpc\nheater_power: 40\nblock_heat_capacity: 13\nambient_transfer: 0.075\n"
    "sensor_responsiveness: 0.5\n"
)
NOT_HELD = {"held_s": None, "held_low": None, "held_high": None}


async def turns() -> None:
    """Let all who can go on do so."""
    for _ in range(8):
        await asyncio.sleep(0)


@pytest.fixture
def chamber(tmp_path: Path) -> Driven:
    return Driven(heater(tmp_path, HOTEND_PID + CHAMBER, "chamber"))


# ---------------------------------------------------------------------------------------------------- status


def test_before_its_first_measurement_a_heater_is_off_and_knows_nothing(tmp_path: Path) -> None:
    unit = heater(tmp_path, MODEL)
    assert unit.status() == {
        "temperature": None,
        "target": 0.0,
        "power": 0.0,
        **NOT_HELD,
        "control_stats": {
            "temp_block": None,
            "temp_sensor": None,
            "temp_ambient": None,
            "filament_mm_per_s": 0.0,
        },
    }
    driven = Driven(unit)
    assert driven.live.filament.wanted == ["extruder"]
    driven.look()
    assert driven.sent == []


def test_what_it_tells_is_rounded(chamber: Driven) -> None:
    unit = chamber.unit
    unit.set_target(60.0)
    chamber.measured(50.12345)
    assert unit.status() == {"temperature": 50.12, "target": 60.0, "power": 0.1235, **NOT_HELD}
    for at_s, celsius in ((200.0, 60.0), (211.0, 59.98765), (223.46, 61.23456)):
        chamber.measured(celsius, at_s)
    told = unit.status()
    assert (told["held_s"], told["held_low"], told["held_high"]) == (12.5, 59.99, 61.23)


def test_of_filament_hundredths_are_told(tmp_path: Path) -> None:
    driven = Driven(heater(tmp_path, MODEL))
    driven.live.filament.mm_per_s_now = 1.23456
    driven.unit.set_target(200.0)
    driven.measured(20.0)
    told = driven.unit.status()["control_stats"]
    assert isinstance(told, dict)
    assert told["filament_mm_per_s"] == 1.23


# --------------------------------------------------------------------------------------------------- targets


@pytest.mark.parametrize("celsius", [5.0, 100.0, 0.0])
def test_targets_at_the_limits_and_off_are_allowed(chamber: Driven, celsius: float) -> None:
    chamber.unit.check_target(celsius)


@pytest.mark.parametrize("celsius", [4.9, 100.1, -1.0])
def test_targets_outside_the_limits_are_not(chamber: Driven, celsius: float) -> None:
    with pytest.raises(WordError, match=r"is outside what \[heater_generic chamber\] allows, 5 to 100 °C"):
        chamber.unit.check_target(celsius)


def test_one_that_was_never_calibrated_may_be_switched_off(tmp_path: Path) -> None:
    unit = heater(tmp_path, "control: mpc\nheater_power: 40\n")
    unit.check_target(0.0)
    with pytest.raises(WordError, match="has to be calibrated before it heats"):
        unit.check_target(200.0)


def test_off_counts_at_once_and_a_target_with_the_next_measurement(chamber: Driven) -> None:
    unit, live = chamber.unit, chamber.live
    chamber.measured(20.0)
    assert chamber.sent == [], "it is off as it is"
    unit.set_target(60.0)
    assert chamber.sent == []
    chamber.measured(20.0)
    on = (110.4, 0.123456)
    assert chamber.sent == [on]
    unit.set_target(1.0)
    assert chamber.sent == [on], "a degree is a target"
    live.host_s = 11.0
    unit.set_target(0.0)
    assert chamber.sent == [on, (111.4, 0.0)]
    for celsius in (20.0, 0.0):
        chamber.measured(celsius)
    unit.set_target(0.0)
    chamber.look()
    assert chamber.sent == [on, (111.4, 0.0)], "off is sent once"


def test_who_waits_may_go_on_when_there_is_nothing_to_wait_for(tmp_path: Path) -> None:
    unit = heater(tmp_path, HOTEND_PID)
    unit.target_c = 200.0
    assert unit.settled, "nothing has been measured"
    driven = Driven(unit)
    driven.measured(20.0)
    assert not unit.settled
    for target_c, settled in ((0.0, True), (1.0, False)):
        unit.set_target(target_c)
        assert unit.settled is settled
    raw = heater(tmp_path, "control: mpc\nheater_power: 40\n")
    Driven(raw).measured(20.0)
    raw.target_c = 200.0
    assert raw.settled, "it cannot heat"


def test_a_target_that_is_reached_already_takes_one_measurement(chamber: Driven) -> None:
    async def main() -> None:
        chamber.unit.set_target(20.0)
        chamber.measured(20.0)
        reaching = asyncio.ensure_future(chamber.unit.reach())
        for done in (False, True):
            await turns()
            assert reaching.done() is done
            chamber.measured(20.0)
        chamber.unit.set_target(60.0)
        reaching = asyncio.ensure_future(chamber.unit.reach())
        for celsius, done in ((20.0, False), (57.9, False), (58.0, True)):
            await turns()
            chamber.measured(celsius)
            await turns()
            assert reaching.done() is done

    asyncio.run(main())


# ------------------------------------------------------------------------------------------------------- net


def test_bad_measurements_are_counted_from_the_first(chamber: Driven) -> None:
    for count in range(1, 8):
        chamber.measured(500.0)
        assert len(chamber.live.stops) == (count > 6)
    assert chamber.sent == []


def test_the_section_verify_heater_is_what_counts(tmp_path: Path) -> None:
    section = (
        "\n[verify_heater chamber]\nmax_error: 7\ncheck_gain_time: 3\nhysteresis: 4\nheating_gain: 1.5\n"
    )
    driven = Driven(heater(tmp_path, HOTEND_PID + CHAMBER + section, "chamber"))
    assert driven.unit._check.options == VerifyOptions(7.0, 3.0, 4.0, 1.5)
    driven.unit.set_target(60.0)
    driven.measured(20.0, 100.0)
    driven.measured(20.0, 102.9)
    assert driven.live.stops == []
    driven.measured(20.0, 103.0)
    (cause,) = driven.live.stops
    assert cause.startswith("heater chamber is at 20.0 °C and did not get 1.5 K nearer to 60 °C in 3 s")


@pytest.mark.parametrize(
    ("section", "key", "gain_s"), [(CHAMBER, "chamber", 20.0), (BED, "heater_bed", 60.0)]
)
def test_without_that_section_the_usual_counts(tmp_path: Path, section: str, key: str, gain_s: float) -> None:
    unit = heater(tmp_path, HOTEND_PID + section, key)
    assert unit._check.options == VerifyOptions(check_gain_s=gain_s)


def test_power_goes_stale_after_its_time_and_not_at_it(chamber: Driven) -> None:
    """1.5 s of max_duration, less 0.4 s that values are sent ahead and 0.15 s to spare."""
    unit, live = chamber.unit, chamber.live
    assert [seconds for seconds, _ in live.timers] == [1.0]
    unit._stale_s = 0.875  # exact in binary; 1.5 - 0.4 - 0.15 is not
    unit.set_target(60.0)
    chamber.measured(20.0)
    live.host_s += 0.875
    unit._end_stale_heat()
    assert unit.power > 0
    live.host_s += 1 / 1024
    unit._end_stale_heat()
    assert unit.power == 0.0
    assert [share for _, share in chamber.sent] == [0.123456, 0.0]
    waiting = len(live.later)
    for later_s in (0.0, 10.0):  # off it stays, and nothing looks at it any more
        live.host_s += later_s
        unit._end_stale_heat()
    assert len(chamber.sent) == 2
    assert len(live.later) == waiting


def test_one_timer_watches_the_power_however_often_it_is_renewed(chamber: Driven) -> None:
    unit, live = chamber.unit, chamber.live
    chamber.measured(20.0)
    assert live.later == [], "it is off"
    unit.set_target(60.0)
    for _ in range(5):
        chamber.measured(20.0)
    assert [seconds for seconds, _ in live.later] == [unit._stale_s]


def test_how_long_power_lasts_follows_from_max_duration(tmp_path: Path) -> None:
    unit = heater(tmp_path, HOTEND_PID + CHAMBER + "max_duration: 3\n", "chamber")
    assert unit._stale_s == pytest.approx(2.45)


def test_three_silent_looks_are_allowed_and_the_fourth_stops(chamber: Driven) -> None:
    unit, live = chamber.unit, chamber.live
    unit.set_target(60.0)
    chamber.measured(20.0)
    for _ in range(3):
        unit._look()
    assert live.stops == []
    unit._look()
    assert live.stops == [
        "heater chamber: its sensor has been silent for about 3 s; check node mcu and its wires"
    ]


def test_a_degree_is_a_target_to_look_after(chamber: Driven) -> None:
    chamber.unit.set_target(1.0)
    for _ in range(4):
        chamber.unit._look()
    assert len(chamber.live.stops) == 1


def test_a_look_that_finds_a_node_away_forgets_the_target_and_ends_the_wait(tmp_path: Path) -> None:
    """That of its sensor is named first; its own is away too here."""
    text = HOTEND_PID + CHAMBER.replace("PA12", "toolhead:PA12")
    driven = Driven(heater(tmp_path, text, "chamber"))
    unit = driven.unit

    async def main() -> None:
        unit.set_target(60.0)
        assert driven.measured(20.0) > 0
        waiting = asyncio.ensure_future(unit.reach())
        await turns()
        for board in driven.live.nodes.values():
            board.state = NodeState.LOST
        for _ in range(5):
            unit._look()
        await turns()
        assert waiting.done()
        with pytest.raises(CanductorError, match="heater chamber was turned off: node toolhead is lost"):
            await waiting
        assert (unit.target_c, unit.power, driven.live.stops) == (0.0, 0.0, [])
        assert len(driven.sent) == 1
        (told,) = driven.live.said
        assert told == "heater chamber was turned off; its target (60 °C) was cleared: node toolhead is lost"

    asyncio.run(main())


def test_an_output_that_takes_nothing_ends_the_target(chamber: Driven) -> None:
    unit = chamber.unit
    unit.set_target(60.0)
    chamber.board.broken = "node mcu is away"
    assert chamber.measured(20.0) == 0.0
    assert (unit.target_c, unit._on, chamber.sent) == (0.0, False, [])
    assert chamber.live.said == [
        "heater chamber was turned off; its target (60 °C) was cleared: node mcu is away"
    ]
    chamber.board.broken = None
    chamber.measured(20.0)
    chamber.look()
    assert chamber.sent == []


# ------------------------------------------------------------------------------------------------- the model


def test_a_model_is_told_of_filament_between_measurements_and_of_the_second_to_come(tmp_path: Path) -> None:
    driven = Driven(heater(tmp_path, MODEL))
    for at_s in (0.5, 110.5):
        driven.measured(20.0, at_s)
    filament = driven.live.filament
    assert [name for name, _, _ in filament.asked] == ["extruder"] * 4
    spans = [span for _, *span in filament.asked]
    expected = [(0.0, 0.5), (0.9, 1.9), (0.5, 110.5), (110.9, 111.9)]
    assert [list(span) for span in expected] == [pytest.approx(span) for span in spans]


def test_a_model_that_no_filament_passes_is_told_of_none(tmp_path: Path) -> None:
    bed = BED.replace("control: watermark", MODEL)
    driven = Driven(heater(tmp_path, HOTEND_PID + bed, "heater_bed"))
    driven.live.filament.mm_per_s_now = 3.0
    driven.measured(20.0)
    assert isinstance(driven.unit.controller, Mpc)
    assert driven.unit.controller.filament_mm_per_s == 0.0
    assert driven.live.filament.asked == []


def test_a_model_is_told_how_fast_its_fan_runs(tmp_path: Path) -> None:
    driven = Driven(heater(tmp_path, MODEL + "cooling_fan: fan\n" + FAN))
    assert driven.unit.fan is not None
    driven.unit.fan.unit.speed = 0.25
    driven.measured(20.0)
    assert isinstance(driven.unit.controller, Mpc)
    assert driven.unit.controller._fan_speed == 0.25


# ------------------------------------------------------------------------------------------------------- end


def test_the_end_is_the_end_of_power_target_and_steady_state(chamber: Driven) -> None:
    unit, states = chamber.unit, list[Held]()
    unit.set_target(60.0)
    for at_s in (100.0, 120.0):
        chamber.measured(60.0, at_s)
    unit.end("over")
    assert (unit.target_c, unit.power) == (0.0, 0.0)
    unit.on_held = states.append
    unit.end("over")
    assert states == []
    unit.keep({"pid_kp": "1"})
    assert chamber.live.saved == [], "who would write it?"
    assert unit.calibrated == {"pid_kp": "1"}
    sent = len(chamber.sent)
    chamber.live.host_s += 10.0
    chamber.look()
    chamber.measured(20.0)
    assert len(chamber.sent) == sent


def test_each_steady_state_is_told_once(chamber: Driven) -> None:
    unit, states = chamber.unit, list[Held]()
    unit.on_held = states.append
    unit.set_target(60.0)
    for at_s in (100.0, 110.0, 125.0):
        chamber.measured(60.0, at_s)
    unit.set_target(62.0)
    for at_s in (130.0, 140.0, 151.0):
        chamber.measured(62.0, at_s)
    assert [(state.since_s, state.until_s) for state in states] == [(110.0, 125.0)]
    unit.end("over")
    assert [(state.since_s, state.until_s) for state in states] == [(110.0, 125.0), (140.0, 151.0)]


def test_what_calibration_found_is_kept_for_save_config(chamber: Driven) -> None:
    chamber.unit.keep({"pid_kp": "1", "pid_ki": "2"})
    section = "heater_generic chamber"
    assert chamber.live.saved == [(section, "pid_kp", "1"), (section, "pid_ki", "2")]


# ----------------------------------------------------------------------------------------------- calibration


class Relay:
    """A calibration at power 0.1, whose target is 60 °C."""

    watched_c = 60.0

    def __init__(self) -> None:
        self.is_done = False
        self.seen = 0

    def power(self, now_s: float, measured_c: float, target_c: float = 0.0) -> float:
        del now_s, measured_c, target_c
        return 0.1


def test_a_calibration_has_the_heater_until_it_is_done(chamber: Driven) -> None:
    unit, relay = chamber.unit, Relay()

    def each() -> None:
        relay.seen += 1

    async def main() -> None:
        unit.set_target(20.0)  # its own controller would not heat at 60 °C
        for _ in range(2):
            relay.is_done, relay.seen = False, 0
            tuning = asyncio.ensure_future(unit.tune(relay, each))
            await turns()
            for count in range(1, 4):
                assert chamber.measured(60.0) == 0.1
                await turns()
                assert relay.seen == count
            with pytest.raises(CanductorError, match="is being calibrated already; wait for its end"):
                await unit.tune(relay)
            relay.is_done = True
            chamber.measured(60.0)
            await tuning
            assert (unit.target_c, unit.power) == (0.0, 0.0)
            unit.set_target(70.0)
            assert chamber.measured(60.0) == 0.123456, "its controller has it again"

    asyncio.run(main())


def test_a_calibration_that_is_switched_off_fails_at_once(chamber: Driven) -> None:
    unit = chamber.unit

    async def main() -> None:
        tuning = asyncio.ensure_future(unit.tune(Relay()))
        await turns()
        chamber.measured(20.0)
        await turns()
        unit.set_target(0.0)
        assert unit.power == 0.0
        await turns()
        assert tuning.done()
        with pytest.raises(
            CanductorError, match=r"the calibration of \[heater_generic chamber\] ended: it was switched off"
        ):
            await tuning
        unit.set_target(0.0)
        unit.set_target(60.0)
        assert chamber.measured(20.0) > 0, "what ended it is forgotten"

    asyncio.run(main())


def test_another_controller_is_used_from_the_next_measurement_on(chamber: Driven) -> None:
    chamber.unit.use(Watermark(max_power=0.5))
    chamber.unit.set_target(60.0)
    assert chamber.measured(20.0) == 0.5
