"""All kinematics, by their names in [printer]. CONTRIBUTING.md has the recipe for another one."""

from coordinator.config.options import SectionReader
from coordinator.config.sections.kinematics.axes import NO_MOTION, axes_kind
from coordinator.config.sections.kinematics.delta import DELTA
from coordinator.config.sections.kinematics.deltesian import DELTESIAN
from coordinator.config.sections.kinematics.dual_carriage import read_dual_carriage
from coordinator.config.sections.kinematics.frame import Frame
from coordinator.config.sections.kinematics.generic_cartesian import GENERIC_CARTESIAN
from coordinator.config.sections.kinematics.polar import POLAR
from coordinator.config.sections.kinematics.rotary_delta import ROTARY_DELTA
from coordinator.config.sections.kinematics.winch import WINCH
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.cartesian import Cartesian
from coordinator.kinematics.corexy import CoreXY
from coordinator.kinematics.corexz import CoreXZ
from coordinator.kinematics.hybrid_corexy import HybridCoreXY
from coordinator.kinematics.hybrid_corexz import HybridCoreXZ

KINDS = {
    kind.kinematics.name: kind
    for kind in (
        axes_kind(Cartesian),
        axes_kind(CoreXY),
        axes_kind(CoreXZ),
        DELTA,
        DELTESIAN,
        GENERIC_CARTESIAN,
        axes_kind(HybridCoreXY),
        axes_kind(HybridCoreXZ),
        NO_MOTION,
        POLAR,
        ROTARY_DELTA,
        WINCH,
    )
}
PRINTER_SPECS = {name: kind.printer for name, kind in KINDS.items() if kind.printer is not None}
"""Further options of [printer], by kinematics."""


def read_frame(reading: Reading, kinematics: str, printer: SectionReader) -> Frame:
    """Return what moves the head; reads what [printer] says about it. Raises ConfigError."""
    kind = KINDS[kinematics]
    frame = kind.read(reading, printer)
    if "dual_carriage" not in reading.config.sections:
        return frame
    possible = [name for name, other in KINDS.items() if other.kinematics.second_carriages]
    return read_dual_carriage(reading, frame, possible)
