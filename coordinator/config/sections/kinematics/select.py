"""From [printer] kinematics to the frame of the machine: which sections it needs, how they fit together."""

from collections.abc import Callable

from coordinator.config.options import SectionReader
from coordinator.config.sections.kinematics.delta import read_delta
from coordinator.config.sections.kinematics.deltesian import read_deltesian
from coordinator.config.sections.kinematics.dual_carriage import read_dual_carriage
from coordinator.config.sections.kinematics.frame import Frame, box_of, home_of
from coordinator.config.sections.kinematics.generic_cartesian import read_generic
from coordinator.config.sections.kinematics.polar import read_polar
from coordinator.config.sections.kinematics.rotary_delta import read_rotary_delta
from coordinator.config.sections.kinematics.winch import read_winch
from coordinator.config.sections.rails import read_rail
from coordinator.config.sections.reading import Reading
from coordinator.kinematics.base import Kinematics, WorkSpace
from coordinator.kinematics.cartesian import Cartesian
from coordinator.kinematics.corexy import CoreXY
from coordinator.kinematics.corexz import CoreXZ
from coordinator.kinematics.hybrid_corexy import HybridCoreXY
from coordinator.kinematics.hybrid_corexz import HybridCoreXZ
from coordinator.kinematics.no_motion import NoMotion

_EMPTY = WorkSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def read_frame(reading: Reading, kinematics: str, printer: SectionReader) -> Frame:
    """Return what moves the head; reads what [printer] says about it. Raises ConfigError."""
    frame = _frame_reader(kinematics)(reading, printer)
    if "dual_carriage" not in reading.config.sections:
        return frame
    return read_dual_carriage(reading, frame)


def _frame_reader(kinematics: str) -> Callable[[Reading, SectionReader], Frame]:
    read: Callable[[Reading, SectionReader], Frame]
    match kinematics:
        case "delta":
            read = read_delta
        case "deltesian":
            read = read_deltesian
        case "generic_cartesian":
            read = read_generic
        case "none":

            def read(reading: Reading, printer: SectionReader) -> Frame:
                del reading, printer
                return Frame(NoMotion(), (), (0.0, 0.0, 0.0))
        case "polar":
            read = read_polar
        case "rotary_delta":
            read = read_rotary_delta
        case "winch":
            read = read_winch
        case _:
            build = _axes_kinematics(kinematics)

            def read(reading: Reading, printer: SectionReader) -> Frame:
                del printer
                return _read_axes(reading, build)

    return read


def _axes_kinematics(kinematics: str) -> Callable[[WorkSpace], Kinematics]:
    """Return the kinematics of a machine with one rail per axis."""
    axes: Callable[[WorkSpace], Kinematics]
    match kinematics:
        case "corexy":
            axes = CoreXY
        case "corexz":
            axes = CoreXZ
        case "hybrid_corexy":
            axes = HybridCoreXY
        case "hybrid_corexz":
            axes = HybridCoreXZ
        case _:
            axes = Cartesian
    return axes


def _read_axes(reading: Reading, build: Callable[[WorkSpace], Kinematics]) -> Frame:
    functions = build(_EMPTY).step_functions()
    x, y, z = (read_rail(reading, axis, function) for axis, function in zip("xyz", functions, strict=True))
    return Frame(build(box_of(x, y, z)), (x, y, z), (home_of(x), home_of(y), home_of(z)))
