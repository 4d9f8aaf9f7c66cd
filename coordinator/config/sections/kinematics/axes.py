"""Machines with one rail per axis, [stepper_x], [stepper_y] and [stepper_z], or with none at all."""

from coordinator.config.options import SectionReader
from coordinator.config.sections.kinematics.frame import Frame, KinematicsKind, box_of, home_of
from coordinator.config.sections.rails import read_rail
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.axes import AxesKinematics
from coordinator.kinematics.no_motion import NoMotion


def axes_kind(kinematics: type[AxesKinematics]) -> KinematicsKind:
    """Return how a machine of KINEMATICS is read."""

    def read(reading: Reading, _printer: SectionReader) -> Frame:
        x, y, z = (
            read_rail(reading, axis, function)
            for axis, function in zip("xyz", kinematics.functions, strict=True)
        )
        return Frame(kinematics(box_of(x, y, z)), (x, y, z), (home_of(x), home_of(y), home_of(z)))

    return KinematicsKind(kinematics, read)


NO_MOTION = KinematicsKind(NoMotion, lambda _reading, _printer: Frame(NoMotion(), (), (0.0, 0.0, 0.0)))
