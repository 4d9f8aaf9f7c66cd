import pytest

from coordinator.kinematics.extruder import ExtruderMotion

MOVES, STANDS = (0, 0, 0, 1), (0, 0, 0, 0)
START = ExtruderMotion(
    ("extruder", "extruder1"),
    "extruder",
    {"extruder": "extruder", "extruder1": "extruder1", "feeder": "extruder"},
)


def moving(motion: ExtruderMotion) -> set[str]:
    weights = motion.weights()
    assert set(weights.values()) <= {MOVES, STANDS}
    return {name for name, weight in weights.items() if weight == MOVES}


def test_the_active_extruder_moves_with_what_follows_it() -> None:
    assert moving(START) == {"extruder", "feeder"}
    assert moving(START.activate("extruder1")) == {"extruder1"}


def test_steppers_follow_other_extruders_or_none() -> None:
    assert moving(START.sync("feeder", "extruder1")) == {"extruder"}
    assert moving(START.sync("feeder", "extruder1").activate("extruder1")) == {"extruder1", "feeder"}
    assert moving(START.sync("extruder1", "extruder")) == {"extruder", "extruder1", "feeder"}
    assert moving(START.sync("extruder", "")) == {"feeder"}


def test_the_state_before_is_unchanged() -> None:
    START.sync("feeder", "")
    assert moving(START) == {"extruder", "feeder"}


def test_names_that_do_not_exist() -> None:
    with pytest.raises(ValueError, match="there is no extruder 'extruder2'; there is extruder, extruder1"):
        START.activate("extruder2")
    with pytest.raises(
        ValueError, match="there is no extruder stepper 'x'; there is extruder, extruder1, feeder"
    ):
        START.sync("x", "extruder")
    with pytest.raises(ValueError, match="there is no extruder 'x'"):
        START.sync("feeder", "x")
    with pytest.raises(ValueError, match="there is none"):
        ExtruderMotion((), "", {}).activate("extruder")
