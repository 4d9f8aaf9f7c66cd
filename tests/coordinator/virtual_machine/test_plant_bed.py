"""The bed of the plant and what presses the probe, against the formula and a plane by numpy."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.assembly.load import load_machine
from coordinator.virtual_machine.plant import PlantSettings, machine_plants
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.support.errors import CanductorError
from nodes.virtual.plant import Axis, Bed, NodePlant, Probe
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.firmware.host import Host
from tests.stages.probe_stage import bed_height, machine_text
from tests.stages.sim_node import SimNode

MM = st.floats(-150, 150)
OFFSET = (12.0, -7.0, 1.25)


def pressed(bed: Bed, x: float, y: float, z: float, fault: PlantFault = PlantFault.SOUND) -> bool:
    """Return what the firmware sees of a probe whose nozzle is at X, Y, Z."""
    place = [Axis(name=name, terms=(), origin=at) for name, at in zip("xyz", (x, y, z), strict=True)]
    probe = Probe(
        name="probe",
        pin="PC5",
        bed=bed.name,
        x="x",
        y="y",
        z="z",
        offset_x=OFFSET[0],
        offset_y=OFFSET[1],
        offset_z=OFFSET[2],
    )
    host = Host()
    plant = host.node.start_plant(NodePlant(node="n", axes=tuple(place), beds=(bed,), probes=(probe,)))
    plant.page.set_fault(PlantItemKind.SWITCH, "probe", fault)
    host.configure("config_endstop oid=1 pin=37 pull_up=0")
    return host.ask("endstop_query_state oid=1")["pin_value"] == 1


TILT = st.floats(-0.02, 0.02)
BEDS = st.builds(
    Bed, z=st.just(0.5), x0=st.just(60.0), y0=st.just(40.0), tilt_x=TILT, tilt_y=TILT, bow=st.floats(-2, 2)
)


@given(MM, MM, BEDS)
def test_the_probe_is_pressed_where_the_formula_has_the_bed(x: float, y: float, bed: Bed) -> None:
    at = bed_height(bed, x + OFFSET[0], y + OFFSET[1]) + OFFSET[2]
    assert pressed(bed, x, y, at - 1e-6)
    assert not pressed(bed, x, y, at + 1e-6)


@pytest.mark.parametrize(("fault", "seen"), [(PlantFault.NEVER, False), (PlantFault.ALWAYS, True)])
def test_a_probe_may_fail(fault: PlantFault, seen: bool) -> None:
    assert pressed(Bed(), 0, 0, -5.0 if fault is PlantFault.NEVER else 50.0, fault) is seen


def test_a_probe_may_close_late() -> None:
    at = OFFSET[2]
    assert not pressed(Bed(), 0, 0, at - 0.19, PlantFault.LATE)
    assert pressed(Bed(), 0, 0, at - 0.21, PlantFault.LATE)
    assert not pressed(Bed(), 0, 0, at - 5, PlantFault.STUCK), "it was open"


def test_a_bed_that_is_not_there_is_refused() -> None:
    probe = Probe(name="probe", pin="PC5", bed="nothing", x="x", y="x", z="x")
    with pytest.raises(CanductorError, match="bed=nothing: expected a bed described above"):
        SimNode().start_plant(NodePlant(node="n", axes=(Axis(name="x", terms=()),), probes=(probe,)))


SUPPORTS = {"stepper_z": (-20.0, 100.0), "stepper_z1": (220.0, 0.0), "stepper_z2": (220.0, 200.0)}


def test_three_motors_carry_a_plane(tmp_path: Path) -> None:
    path = tmp_path / "machine.cfg"
    path.write_text(machine_text(further_z=2))
    raised = {"stepper_z1": 1.5, "stepper_z2": -0.5}
    bed = BedSettings(supports=SUPPORTS, raised_mm=raised)
    plants = machine_plants(load_machine(str(path)), PlantSettings(start=(0.0, 0.0, 9.0), bed=bed))
    axes = {axis.name: axis for axis in plants["toolhead"].axes}
    z, slope_x, slope_y = (axes[f"probe_{name}"] for name in ("z", "slope_x", "slope_y"))
    for motor, (x, y) in SUPPORTS.items():
        here = z.origin + slope_x.origin * x + slope_y.origin * y
        assert here == pytest.approx(9.0 + raised.get(motor, 0.0))
        shares = [{term.stepper: term.mm_per_step for term in axis.terms} for axis in (z, slope_x, slope_y)]
        for other in SUPPORTS:
            moved = shares[0][other] + shares[1][other] * x + shares[2][other] * y
            assert moved == pytest.approx(8 / 200 / 16 if other == motor else 0.0, abs=1e-12)


def test_four_motors_carry_the_nearest_plane(tmp_path: Path) -> None:
    path = tmp_path / "machine.cfg"
    path.write_text(machine_text(further_z=3))
    corners = {"stepper_z": (0, 0), "stepper_z1": (0, 200), "stepper_z2": (200, 200), "stepper_z3": (200, 0)}
    raised = {"stepper_z": 1.0, "stepper_z2": 2.0, "stepper_z3": -1.5}
    bed = BedSettings(supports=corners, raised_mm=raised)
    plants = machine_plants(load_machine(str(path)), PlantSettings(start=(0.0, 0.0, 9.0), bed=bed))
    axes = {axis.name: axis.origin for axis in plants["toolhead"].axes}
    matrix = np.array([(1, *place) for place in corners.values()])
    heights = 9.0 + np.array([raised.get(name, 0.0) for name in corners])
    exact = np.linalg.solve(matrix.T @ matrix, matrix.T @ heights)
    assert [axes[f"probe_{name}"] for name in ("z", "slope_x", "slope_y")] == pytest.approx(list(exact))
