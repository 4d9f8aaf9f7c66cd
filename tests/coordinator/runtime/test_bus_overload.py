"""When a forecast of lateness is believed, and what is said then."""

import pytest

from coordinator.runtime.bus_overload import PERSISTS_S, URGENT_S, BusOverload, BusOverloadDetector
from nodes.clock.clock import HostTime
from nodes.link import Forecast


def forecast(now_s: float, late_in_s: float | None, ratio: float = 1.3) -> Forecast:
    now_ns = round(now_s * 1e9)
    late_ns = None if late_in_s is None else round((now_s + late_in_s) * 1e9)
    return Forecast(now_ns, ratio, now_ns, late_ns, 350_000.0, 10_000)


def look(
    watch: BusOverloadDetector,
    now_s: float,
    late_in_s: float | None,
    repeated: float = 0.01,
    taken: float = 0.6,
) -> bool:
    now = HostTime(round(now_s * 1e9))
    return watch.look(forecast(now_s, late_in_s), now, lambda: repeated, lambda: taken)


def test_a_passing_doubt_is_no_overload() -> None:
    watch = BusOverloadDetector("can0")
    assert look(watch, 1.0, 1.0)
    assert look(watch, 1.0 + PERSISTS_S / 2, 1.0)
    assert not look(watch, 1.0 + PERSISTS_S * 0.9, None)
    assert look(watch, 1.0 + PERSISTS_S * 1.1, 1.0)
    assert look(watch, 1.0 + PERSISTS_S * 1.9, 1.0)


def test_a_lasting_one_is_said_long_before_the_first_late_step() -> None:
    watch = BusOverloadDetector("can0")
    look(watch, 1.0, 1.0)
    with pytest.raises(BusOverload) as caught:
        look(watch, 1.0 + PERSISTS_S * 1.01, 0.8)
    assert str(caught.value) == (
        "bus can0 cannot carry what is planned: its motion needs 130% of the 350 kbit/s there are for it, "
        "and the first step commands would be late in 0.8 s; lower the speed or the microsteps, take other "
        "traffic off the bus, or raise its bit rate"
    )


def test_losses_are_named_as_what_they_are() -> None:
    with pytest.raises(BusOverload, match="bus can0 loses too much: 23% of the blocks"):
        look(BusOverloadDetector("can0"), 1.0, 0.1, repeated=0.23)


def test_a_bus_that_is_full_of_others_frames_is_blocked() -> None:
    with pytest.raises(BusOverload, match="bus can0 is blocked: received frames take 91% of its time"):
        look(BusOverloadDetector("can0"), 1.0, 0.1, repeated=0.23, taken=0.91)


def test_what_is_near_is_said_at_once() -> None:
    with pytest.raises(BusOverload):
        look(BusOverloadDetector("can0"), 1.0, URGENT_S / 2)
