"""What the demo says when its proof fails."""

from typing import Any

from coordinator.demo.report import DemoReport
from coordinator.verification.proof import StepperProof
from coordinator.verification.true_position import PlaceProof


def failed(**other: Any) -> DemoReport:
    stepper = StepperProof("stepper_x", "mcu", 10, 12, 0, 0, 0, 0, 0.0, 0.0)
    place = PlaceProof("x", 10.0, 12.0, 0.0125)
    known: dict[str, Any] = {"steppers": (stepper,), "places": (place,), "heat": (), "clocks": ()}
    none: dict[str, Any] = {
        "outcome": None,
        "dispatch_late_s": {},
        "frames": 0,
        "frames_lost": 0,
        "notices": (),
    }
    return DemoReport(**(known | none | {"stray_edges": 3} | other))


def test_every_failure_is_named() -> None:
    assert failed().failures() == [
        "stepper_x did not do what was planned",
        "x is not at the position that the machine believes",
        "3 level changes of pins that the configuration does not use",
    ]
    assert not failed().ok
    assert failed(steppers=(), places=()).failures() == [
        "3 level changes of pins that the configuration does not use"
    ]


def test_the_users_likely_cause_comes_before_a_report() -> None:
    with_switch, without = failed().verdict(), failed(sensorless=frozenset("x")).verdict()
    assert with_switch.endswith("; please report this with the output above")
    assert "let one axis leave its end first (docs/tmc.md" not in with_switch
    cause = without.index("let one axis leave its end first (docs/tmc.md")
    assert cause < without.index("please report this")
    assert "stepper_x did not do what was planned" in without
    assert "x is homed without a switch" in without
