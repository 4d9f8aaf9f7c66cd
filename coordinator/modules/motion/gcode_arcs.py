"""[gcode_arcs]: how finely G2 and G3 are divided into straight moves; they work without it, too."""

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.modules.base import Build, Module
from coordinator.motion.planner.language import ARC_DEVIATION_MM, ARC_PIECE_MM

RESOLUTION = FloatOption(
    name="resolution",
    help="Largest length of a piece of an arc",
    default=ARC_PIECE_MM,
    unit="mm",
    minimum=0.01,
    maximum=1000.0,
)
DEVIATION = FloatOption(
    name="max_deviation",
    help="Largest distance of a piece from the arc",
    default=ARC_DEVIATION_MM,
    unit="mm",
    minimum=0.0001,
    maximum=1.0,
)


class GCodeArcs(Module):
    """The precision, for the planner."""

    SPEC = SectionSpec("The precision of arcs (G2, G3)", (RESOLUTION, DEVIATION))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        piece_mm, deviation_mm = build.get(RESOLUTION), build.get(DEVIATION)
        build.set_up_programs(lambda planner: planner.set_arc_precision(piece_mm, deviation_mm))
