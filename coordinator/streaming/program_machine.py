"""From the configured machine to what a program may change of it."""

from coordinator.config.model import MachineDescription
from coordinator.gcode.commands import NO_WORDS, Vocabulary
from coordinator.gcode.machine_state import Extruder, MachineState, Shaper


def machine_state(description: MachineDescription, vocabulary: Vocabulary = NO_WORDS) -> MachineState:
    """Return the state that a job on this machine begins with; each job needs its own."""
    extruders = {
        extruder.name: Extruder(
            extruder.name, extruder.limits, extruder.pressure_advance, extruder.smooth_time_s
        )
        for extruder in description.extruders
    }
    dual = description.dual_carriage
    return MachineState(
        extruders,
        description.extruder_motion if extruders else None,
        dual.carriages if dual else None,
        dual.carriages.home if dual else None,
        {s.axis.upper(): Shaper(s.kind, s.frequency_hz, s.damping_ratio) for s in description.shapers},
        surface=vocabulary.surface,
    )
