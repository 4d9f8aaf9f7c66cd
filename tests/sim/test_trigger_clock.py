"""When an endstop is said to have switched: at the first look that found it so, not at the next one."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from coordinator.modules.module_set import build_modules
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.homing import LOOK_S, HomingMove, HomingResult
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage
from tests.stages.motor_switches import MotorSwitch, place_switches

MACHINE = """
[mcu]
canbus_uuid: 90a4ae022dfc
canbus_interface: can0

[mcu toolhead]
canbus_uuid: 5e1ec7ab1e02
canbus_interface: can0

[printer]
kinematics: cartesian
max_velocity: 250
max_accel: 3000

[stepper_x]
step_pin: PB0
dir_pin: PB1
microsteps: 16
rotation_distance: 40
endstop_pin: ^{endstop}
position_endstop: 0
position_max: 250
homing_speed: 50

[stepper_y]
step_pin: PB8
dir_pin: PB9
microsteps: 16
rotation_distance: 40
position_max: 250

[stepper_z]
step_pin: PB6
dir_pin: PB7
microsteps: 16
rotation_distance: 8
position_max: 250
"""
SECOND_SIDE = """
[stepper_x1]
step_pin: PB3
dir_pin: PB4
microsteps: 16
rotation_distance: 40
endstop_pin: ^{endstop}
"""
STEP_PINS = {"stepper_x": "PB0", "stepper_x1": "PB3"}
RELAY_S = 0.02
"""The host is told and tells the other node within this."""
HALF_A_ROLLOVER_S = (1 << 31) / 168e6
CLOCKS_S = 10e-6
"""What the host may have a secondary node's clock wrong by, on a quiet bus."""
STEP_S = 2e-6
"""From a step to what the node's pins show of it, and the rounding to ticks."""


class Switches:
    """A homing of X, with a second side where that has a switch; each closes with a step that is known."""

    def __init__(
        self,
        folder: Path,
        endstop: str,
        at: int,
        second_at: int | None = None,
        second_switch: str = "PC6",
    ) -> None:
        second = "" if second_at is None else SECOND_SIDE.format(endstop=second_switch)
        (folder / "home.cfg").write_text(MACHINE.format(endstop=endstop) + second)
        legacy = "[nodes.toolhead]\nlegacy = true\n" if "toolhead" in second_switch else ""
        (folder / "home.toml").write_text(f'about = "Homing."\nmachine = "home.cfg"\n{legacy}')
        self.at = {"stepper_x": at} if second_at is None else {"stepper_x": at, "stepper_x1": second_at}
        self.stage = Stage(scenarios.find(str(folder / "home.toml")), 0)
        node = "toolhead" if "toolhead" in endstop else "mcu"
        switches = [MotorSwitch("PB0", "PB1", node, "PC5", at=-at, direction=-1)]
        if second_at is not None:
            node = "toolhead" if "toolhead" in second_switch else "mcu"
            switches.append(MotorSwitch("PB3", "PB4", node, "PC6", at=-second_at, direction=-1))
        place_switches(self.stage, switches)

    def run(self, speed: float) -> tuple[HomingResult, ...]:
        """Home at SPEED, mm/s."""

        async def main() -> tuple[HomingResult, ...]:
            machine = Machine(
                self.stage.description,
                self.stage.host,
                build_modules(self.stage.description),
                on_notice=lambda _: None,
            )
            await machine.start()
            try:
                rails, ways = self.stage.description.stops, dict.fromkeys(self.at, -1.0)
                return await HomingMove(
                    machine, rails, ways=ways, way_mm=45.0, speed=speed, accel=3000.0
                ).run()
            finally:
                await machine.close()

        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(main())

    def closed_at_s(self, stepper: str = "stepper_x") -> float:
        """Return the print time at which a switch closed in truth."""
        truth, pin = self.stage.board("mcu"), self.stage.pins("mcu")[STEP_PINS[stepper]]
        steps = truth.at_ns[(truth.pin == pin) & (truth.level == 1)]
        return float(self.stage.print_time(np.array([steps[self.at[stepper] - 1]]))[0])


@pytest.mark.parametrize("at", [1600, 1607])
@pytest.mark.parametrize(("endstop", "allowed_s"), [("PC5", STEP_S), ("toolhead:PC5", CLOCKS_S)])
def test_the_trigger_is_the_first_look_that_found_it_closed(
    tmp_path: Path, endstop: str, allowed_s: float, at: int
) -> None:
    switch = Switches(tmp_path, endstop, at)
    (result,) = switch.run(47.0)
    after_s = result.triggered_at_s - switch.closed_at_s()
    assert -allowed_s <= after_s <= LOOK_S + allowed_s


def test_a_trigger_long_before_that_of_the_last_rail_is_not_taken_for_one_to_come(tmp_path: Path) -> None:
    """A node's clock has 32 bits, half of which pass between the two switches."""
    switches = Switches(tmp_path, "PC5", 160, second_at=3200)
    found = switches.run(2.6)
    first_s, second_s = map(switches.closed_at_s, STEP_PINS)
    assert second_s - first_s > HALF_A_ROLLOVER_S
    for result, (stepper, at) in zip(found, switches.at.items(), strict=True):
        assert -STEP_S <= result.triggered_at_s - switches.closed_at_s(stepper) <= LOOK_S + STEP_S
        assert result.way_to_trigger_mm == pytest.approx(at / 80, abs=0.02)


def test_a_side_whose_switch_is_on_another_node_stops_while_the_other_side_goes_on(tmp_path: Path) -> None:
    """Its nodes have no trigger groups: the host relays at once, and not at the end of the move."""
    switches = Switches(tmp_path, "PC5", 3200, second_at=160, second_switch="toolhead:PC6")
    first, second = switches.run(20.0)
    assert not second.through_group
    assert 0 <= second.beyond_trigger_mm < 20.0 * RELAY_S
    assert first.way_to_trigger_mm == pytest.approx(40.0, abs=0.02)
