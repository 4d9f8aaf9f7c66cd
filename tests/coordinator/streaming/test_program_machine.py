"""What a program may change of the example machines."""

from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.gcode.machine_state import Shaper
from coordinator.streaming.program_machine import machine_state

CONFIG = Path(__file__).parents[3] / "config"


def test_every_example_machine_has_a_state_of_its_own_extruders() -> None:
    for path in sorted(CONFIG.glob("*.cfg")):
        description = load_machine(str(path))
        state = machine_state(description)
        assert list(state.extruders) == [extruder.name for extruder in description.extruders]
        for number, described in enumerate(description.extruders):
            tool = state.tool(number)
            assert tool is not None
            assert (tool.limits, tool.pressure_advance_s) == (described.limits, described.pressure_advance)
            assert tool.smooth_s == described.smooth_time_s
        assert (state.active is None) == (not description.extruders)
        for shaper in description.shapers:
            expected = Shaper(shaper.kind, shaper.frequency_hz, shaper.damping_ratio)
            assert state.shapers[shaper.axis.upper()] == expected
        known = {stepper.name for stepper in description.steppers}
        weights = dict(state.filament.weights()) if state.filament else {}
        if state.carriages and state.carriage_state:
            weights |= state.carriages.weights(state.carriage_state)
        for stepper in description.steppers:
            if stepper.name in weights:
                assert weights[stepper.name] == stepper.weights, f"{stepper.name} of {path.name} at start"
        assert weights.keys() <= known


def test_a_second_carriage_is_found() -> None:
    state = machine_state(load_machine(str(CONFIG / "idex.cfg")))
    assert state.carriages is not None
    assert state.carriage_state == state.carriages.home
