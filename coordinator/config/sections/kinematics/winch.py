"""Cable winches: [stepper_a], [stepper_b], [stepper_c] and further letters, each with its anchor."""

import math
import string

from coordinator.config.model import NO_ENDSTOP
from coordinator.config.options import SectionReader, SectionSpec
from coordinator.config.sections.bounds import position_option
from coordinator.config.sections.kinematics.frame import Frame, KinematicsKind
from coordinator.config.sections.rails import read_tower
from coordinator.config.sections.reading import Reading
from coordinator.config.sections.steppers import MOTOR
from coordinator.config.unsupported import UNSUPPORTED_STEPPER_OPTIONS
from coordinator.kinematics.base import Point
from coordinator.kinematics.geometry import cross, dot, subtract
from coordinator.kinematics.winch import MIN_WINCHES, Winch

ANCHORS = tuple(
    position_option(f"anchor_{axis}", f"{axis.upper()} of the point where the cable comes from")
    for axis in "xyz"
)
SPEC = SectionSpec(
    help="The winch of one cable: stepper_a, stepper_b, stepper_c, up to stepper_z",
    options=(*MOTOR, *ANCHORS),
    unsupported=UNSUPPORTED_STEPPER_OPTIONS,
)
WHY = "a machine on cables has three winches at least, from stepper_a on"
_MIN_SINE = 0.01
RANGE_OPTIONS = (
    "anchor_x of the sections [stepper_a], [stepper_b], …",
    "anchor_y of the sections [stepper_a], [stepper_b], …",
    "anchor_z of the sections [stepper_a], [stepper_b], …",
)


def read_winch(reading: Reading, _printer: SectionReader) -> Frame:
    """Return the frame of a machine on cables; raises ConfigError."""
    readers = []
    for count, letter in enumerate(string.ascii_lowercase):
        section = reading.find(f"stepper_{letter}")
        if section is None and count < MIN_WINCHES:
            section = reading.get(f"stepper_{letter}", WHY)
        if section is None:
            reading.used.discard(f"stepper_{letter}")
            break
        readers.append(SectionReader(section, SPEC))
    anchors = tuple(_read_anchor(reader) for reader in readers)
    _check_anchors(readers, anchors)
    winch = Winch(anchors)
    rails = (
        read_tower(reading, reader, name, function, NO_ENDSTOP)
        for reader, name, function in zip(readers, winch.rails, winch.step_functions(), strict=True)
    )
    return Frame(winch, tuple(rails), (0.0, 0.0, 0.0), range_options=RANGE_OPTIONS)


def _read_anchor(reader: SectionReader) -> Point:
    x, y, z = (reader.get(option) for option in ANCHORS)
    return (x, y, z)


def _check_anchors(readers: list[SectionReader], anchors: tuple[Point, ...]) -> None:
    for i, anchor in enumerate(anchors):
        if anchor in anchors[:i]:
            raise readers[i].bad(
                ANCHORS[0],
                f"the anchor is that of [{readers[anchors.index(anchor)].name}]; correct one of them",
            )
    to_b, to_c = subtract(anchors[1], anchors[0]), subtract(anchors[2], anchors[0])
    normal = cross(to_b, to_c)
    if math.sqrt(dot(normal, normal)) < _MIN_SINE * math.sqrt(dot(to_b, to_b) * dot(to_c, to_c)):
        raise readers[2].bad(
            ANCHORS[0],
            "the anchors of stepper_a, stepper_b and stepper_c are on one line; move one off it",
        )


WINCH = KinematicsKind(
    Winch, read_winch, reference={"[stepper_a], [stepper_b], [stepper_c] … of winches": SPEC}
)
