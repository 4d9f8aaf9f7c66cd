"""Objects of motion before there is any."""

from coordinator.assembly.load import load_machine
from coordinator.klippy_api.motion_objects import idle_objects


def test_a_machine_that_starts_has_its_carriages_and_extruders() -> None:
    objects = idle_objects(load_machine("config/idex.cfg"))
    assert objects["dual_carriage"] == {"carriage_0": "PRIMARY", "carriage_1": "INACTIVE"}
    for name in ("extruder", "extruder1"):
        assert objects[name].keys() == {"motion_queue", "pressure_advance", "smooth_time"}
