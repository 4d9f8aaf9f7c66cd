"""What the demo's witness does not know is said before anything starts."""

from pathlib import Path

import pytest

from coordinator.demo.run import check_provable
from coordinator.machine.description import load_machine
from nodes.errors import CanductorError

CONFIG = Path(__file__).resolve().parents[3] / "config"


@pytest.mark.parametrize("name", ["demo/machine", "hybrid_corexz", "generic_cartesian"])
def test_linear_machines_are_proved(name: str) -> None:
    check_provable(load_machine(str(CONFIG / f"{name}.cfg")))


def test_a_delta_is_not() -> None:
    with pytest.raises(CanductorError, match=r"delta.cfg: the demo cannot prove the motion of \[stepper_a\]"):
        check_provable(load_machine(str(CONFIG / "delta.cfg")))


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        ("[input_shaper]\nshaper_freq_x: 50\n", "the input shaper of axis x"),
        ("pressure_advance: 0.05\n", r"the pressure advance of \[extruder\]"),
    ],
)
def test_what_shapes_the_motion_is_named(tmp_path: Path, extra: str, named: str) -> None:
    text = (CONFIG / "demo" / "machine.cfg").read_text(encoding="utf-8")
    path = tmp_path / "machine.cfg"
    path.write_text(
        text.replace("[extruder]\n", "[extruder]\n" + extra) if "[" not in extra else text + extra
    )
    with pytest.raises(CanductorError, match=f"cannot prove {named} yet"):
        check_provable(load_machine(str(path)))
