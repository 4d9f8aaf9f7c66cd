"""From [printer] kinematics to the frame of the machine: which sections it needs, how they fit together."""

from collections.abc import Callable, Mapping

from coordinator.kinematics.base import Kinematics, WorkSpace
from coordinator.kinematics.cartesian import Cartesian
from coordinator.kinematics.corexy import CoreXY
from coordinator.kinematics.corexz import CoreXZ
from coordinator.kinematics.hybrid_corexy import HybridCoreXY
from coordinator.kinematics.hybrid_corexz import HybridCoreXZ
from coordinator.machine.frame import Frame, box_of, home_of
from coordinator.machine.options import SectionReader, SectionSpec
from coordinator.machine.read_delta import DELTA_PRINTER, read_delta
from coordinator.machine.read_deltesian import DELTESIAN_PRINTER, read_deltesian
from coordinator.machine.read_dual import read_dual_carriage
from coordinator.machine.read_generic import read_generic
from coordinator.machine.read_polar import read_polar
from coordinator.machine.read_rails import read_rail
from coordinator.machine.read_rotary_delta import ROTARY_DELTA_PRINTER, read_rotary_delta
from coordinator.machine.read_winch import read_winch
from coordinator.machine.reading import Reading

PRINTER_SPECS: Mapping[str, SectionSpec] = {
    "delta": DELTA_PRINTER,
    "deltesian": DELTESIAN_PRINTER,
    "rotary_delta": ROTARY_DELTA_PRINTER,
}
"""What [printer] may contain besides, by kinematics."""

_AXES: Mapping[str, Callable[[WorkSpace], Kinematics]] = {
    "cartesian": Cartesian,
    "corexy": CoreXY,
    "corexz": CoreXZ,
    "hybrid_corexy": HybridCoreXY,
    "hybrid_corexz": HybridCoreXZ,
}
_OTHERS: Mapping[str, Callable[[Reading, SectionReader], Frame]] = {
    "delta": read_delta,
    "deltesian": read_deltesian,
    "generic_cartesian": read_generic,
    "polar": read_polar,
    "rotary_delta": read_rotary_delta,
    "winch": read_winch,
}
_EMPTY = WorkSpace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def read_frame(reading: Reading, kinematics: str, printer: SectionReader) -> Frame:
    """Return what moves the head; reads what [printer] says about it. Raises ConfigError."""
    other = _OTHERS.get(kinematics)
    return other(reading, printer) if other else _read_axes(reading, _AXES[kinematics])


def _read_axes(reading: Reading, build: Callable[[WorkSpace], Kinematics]) -> Frame:
    """Return a machine with one rail per axis."""
    functions = build(_EMPTY).step_functions()
    x, y, z = (read_rail(reading, axis, function) for axis, function in zip("xyz", functions, strict=True))
    kinematics = build(box_of(x, y, z))
    frame = Frame(kinematics, (x, y, z), (home_of(x), home_of(y), home_of(z)))
    return read_dual_carriage(reading, frame)
