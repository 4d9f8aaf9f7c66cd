"""A job that its service's end cuts off, on a printer that is hot: it goes on where nothing is guessed."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.service.jobs.journal import journal_path
from nodes.link.link import Link
from tests.stages.printer import PRINTING, Printer, gcode
from tests.stages.served import Served

LAYER_MM = 0.3
LAYERS = 3
A_MM, B_MM = 60.0, 180.0
"""Where the two objects are in X."""
SECTIONS = (
    PRINTING
    + """
[fan_generic box]
pin: PB4
[gcode_macro COUNT]
variable_n: 0
gcode:
    SET_GCODE_VARIABLE MACRO=COUNT VARIABLE=n VALUE={n + 1}
"""
)


def outline(name: str, x: float) -> str:
    corners = ((x, 100), (x + 20, 100), (x + 20, 120), (x, 120), (x, 100))
    lines = [f"EXCLUDE_OBJECT_START NAME={name}", f"G1 X{x} Y100 F12000"]
    lines += [f"G1 X{cx} Y{cy} E0.8 F1500" for cx, cy in corners[1:]]
    return "\n".join([*lines, f"EXCLUDE_OBJECT_END NAME={name}"])


def job() -> str:
    lines = ["M140 S60", "M104 S200", "G28", "M190 S60", "M109 S200", "G90", "M82", "G92 E5", "COUNT"]
    lines += ["M83", "M106 S128"]
    lines += ["EXCLUDE_OBJECT_DEFINE NAME=A", "EXCLUDE_OBJECT_DEFINE NAME=B"]
    for n in range(1, LAYERS + 1):
        lines += [f"G1 Z{n * LAYER_MM:.1f} F9000", outline("A", A_MM), outline("B", B_MM)]
    return "\n".join([*lines, "COUNT", "M104 S0", "M140 S0", ""])


def height(printer: Printer) -> float:
    return round(printer.true_mm("z"), 2)


@contextmanager
def watched(printer: Printer) -> Iterator[list[tuple[float, float, float, float]]]:
    """Collect where the head truly is (x y z) and how hot its nozzle truly is."""
    seen: list[tuple[float, float, float, float]] = []

    async def watch() -> None:
        while True:
            place = (printer.true_mm("x"), printer.true_mm("y"), printer.true_mm("z"))
            seen.append((*place, printer.true_c("extruder")))
            await asyncio.sleep(0.05)

    task = asyncio.ensure_future(watch())
    try:
        yield seen
    finally:
        task.cancel()


async def print_until(printer: Printer, stage: Served, at_mm: float, further_s: float) -> None:
    """Print up to some time into the layer at AT_MM, with B left out from the first one on."""
    stage.write_job(job())
    await gcode(stage, "SET_FAN_SPEED FAN=box SPEED=0.4", "SET_GCODE_OFFSET Z=0.05")
    await stage.call("job.start", file="job.gcode")
    await stage.until(lambda: len(str(printer.status("exclude_object")["objects"])) > 20, "objects")
    await gcode(stage, "EXCLUDE_OBJECT NAME=B")
    await stage.until(lambda: height(printer) == at_mm, f"{at_mm} mm")
    await asyncio.sleep(further_s)


def test_new_heights_are_noted_before_what_leads_to_them_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in between, the service would go on from a height at which the head is no more."""
    printer, sent = Printer(tmp_path, SECTIONS), list[tuple[object, object]]()

    async def test(stage: Served) -> None:
        recovery, hand_over = stage.service.recovery, Link.send_batch

        def send_batch(link: Link, batch: bytes) -> None:
            if recovery._job is not None and recovery._job.line:
                sent.append((recovery._heights_noted, recovery._heights()))
            hand_over(link, batch)

        monkeypatch.setattr(Link, "send_batch", send_batch)
        await print_until(printer, stage, 0.65, 1.0)

    printer.serve(test)
    assert len({there for _, there in sent}) > 1
    assert [noted for noted, _ in sent] == [there for _, there in sent]


def test_it_heats_homes_above_the_part_and_goes_on(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def first(stage: Served) -> None:
        await print_until(printer, stage, 0.65, 1.0)

    async def second(stage: Served) -> None:
        z_mm = printer.true_mm("z")
        assert z_mm == pytest.approx(0.65, abs=0.01)
        line = stage.tree.get("job.interrupted_line")
        assert isinstance(line, int)
        assert any(f"job.gcode was interrupted at line {line}; job.recover" in told for told in stage.lines)
        with pytest.raises(ApiError, match="was interrupted at line"):
            await stage.call("job.recover", line=line + 1)
        written_ns = (stage.jobs / "job.gcode").stat().st_mtime_ns
        os.utime(stage.jobs / "job.gcode", ns=(1, 1))
        with pytest.raises(ApiError, match="the file has changed"):
            await stage.call("job.recover", home=True)
        os.utime(stage.jobs / "job.gcode", ns=(written_ns, written_ns))
        await asyncio.sleep(3)  # it gets cold
        with pytest.raises(ApiError, match="X and Y and Z must be homed before"):
            await stage.call("job.recover")
        with watched(printer) as seen:
            await stage.call("job.recover", home=True)
            await stage.until(lambda: height(printer) == 0.65, "the part")
            assert printer.status("exclude_object")["excluded_objects"] == ["B"]
        cold = [place for *place, _ in takewhile(lambda each: each[3] < 195, seen)]
        assert len(cold) > 10
        assert all(place == cold[0] for place in cold), "it moves before it is hot"
        assert min(z for _, _, z, _ in seen) > z_mm - 0.01
        around = [(x, y, z) for x, y, z, _ in seen if x < 40 or y > 140]
        assert around
        assert min(z for _, _, z in around) > 5.6, "it homes above the part"
        with watched(printer) as seen:
            await stage.until_job("done")
        assert not any(x > B_MM + 1 for x, _, _, _ in seen), "B is left out"
        assert printer.true_mm("z") == pytest.approx(LAYERS * LAYER_MM + 0.05, abs=0.01)
        assert printer.status("fan_generic box")["speed"] == 0.4
        assert printer.status("fan")["speed"] == pytest.approx(128 / 255, abs=1e-3)
        assert printer.status("gcode_macro COUNT") == {"n": 2}
        assert stage.tree.get("job.interrupted_file") is None
        with pytest.raises(ApiError, match="no job was interrupted"):
            await stage.call("job.recover")

    printer.serve(first, second)


def test_a_journal_that_is_removed_while_it_prints_is_written_again(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)
    journals: list[Path] = []

    async def first(stage: Served) -> None:
        await print_until(printer, stage, 0.35, 0.5)
        state = stage.service.settings.state
        assert state is not None
        journals.append(journal_path(state, stage.jobs))
        await stage.until(journals[0].exists, "the journal")
        journals[0].unlink()
        await asyncio.sleep(2.5)

    async def second(stage: Served) -> None:
        assert stage.tree.get("job.interrupted_file") == "job.gcode"
        assert journals[0].exists()

    printer.serve(first, second)


def test_where_z_is_not_known_it_asks(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def first(stage: Served) -> None:
        await print_until(printer, stage, 0.65, 2.4)  # what is planned has the next layer's height in it

    async def second(stage: Served) -> None:
        z_mm = printer.true_mm("z")
        with pytest.raises(ApiError, match="so Z is not known: home X Y Z where the part is not in the way"):
            await stage.call("job.recover", home=True)
        assert printer.true_mm("z") == z_mm
        assert printer.status("extruder")["target"] == 0
        line = job().split("\n").index("G1 X200.0 Y100 E0.8 F1500") + 1
        await gcode(stage, f"RESUME_INTERRUPTED HOME=1 Z={z_mm:.3f} LINE={line}")
        with watched(printer) as seen:
            await stage.until(lambda: stage.job_state == "printing", "the job")
            await stage.until_job("done")
        over_b = [z for x, _, z, _ in seen if x > B_MM + 1]
        assert not over_b, "it begins within B, which is left out"
        assert min(z for _, _, z, _ in seen) > 0.34
        assert printer.true_mm("z") == pytest.approx(LAYERS * LAYER_MM + 0.05, abs=0.01)

    printer.serve(first, second)


def test_one_that_ends_again_on_its_way_is_known_but_not_where_it_stands(tmp_path: Path) -> None:
    """Failed before: it was forgotten, or the height where it had stood at first was taken for granted."""
    printer, lines = Printer(tmp_path, SECTIONS), list[object]()

    async def first(stage: Served) -> None:
        await print_until(printer, stage, 0.65, 1.0)

    async def on_its_way_up(stage: Served) -> None:
        lines.append(stage.tree.get("job.interrupted_line"))
        recovering = asyncio.ensure_future(stage.call("job.recover", home=True))
        await stage.until(lambda: height(printer) > 2, "the head to go up")
        recovering.cancel()

    async def on_its_way_down(stage: Served) -> None:
        lines.append(stage.tree.get("job.interrupted_line"))
        with pytest.raises(ApiError, match="or has since, so Z is not known"):
            await stage.call("job.recover", home=True)
        await stage.call("job.recover", home=True, z=printer.true_mm("z"))

    async def last(stage: Served) -> None:
        lines.append(stage.tree.get("job.interrupted_line"))
        with pytest.raises(ApiError, match="so Z is not known"):
            await stage.call("job.recover", home=True)

    printer.serve(first, on_its_way_up, on_its_way_down, last)
    assert lines[0]
    assert lines == [lines[0]] * 3


def test_a_height_counts_only_until_z_moves(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS + "[force_move]\nenable_force_move: True\n")

    async def first(stage: Served) -> None:
        await print_until(printer, stage, 0.65, 1.0)

    async def second(stage: Served) -> None:
        await gcode(stage, "FORCE_MOVE STEPPER=stepper_z DISTANCE=3 VELOCITY=5")
        with pytest.raises(ApiError, match="or has since, so Z is not known"):
            await stage.call("job.recover", home=True)

    printer.serve(first, second)


BENT = """
[bed_mesh]
mesh_min: 0, 0
mesh_max: 200, 200
[bed_mesh bent]
version: 1
points: 0, 0.05, 0.1
  0, 0.05, 0.1
  0, 0.05, 0.1
x_count: 3
y_count: 3
min_x: 0
max_x: 200
min_y: 0
max_y: 200
"""


def test_the_mesh_is_followed_again(tmp_path: Path) -> None:
    """The head stood higher where it followed the mesh, and goes on following it; nothing is hot."""
    printer = Printer(tmp_path, SECTIONS + BENT)

    def above_bed() -> float:
        return printer.true_mm("z") - 0.0005 * printer.true_mm("x")

    async def first(stage: Served) -> None:
        moves = ["G28", "G90", "G1 Z0.6 F900", "G1 X60 Y100 F12000", "G1 X80 F600", f"G1 X{B_MM:g} F6000", ""]
        stage.write_job("\n".join(moves))
        await gcode(stage, "BED_MESH_PROFILE LOAD=bent")
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: printer.true_mm("x") > 61 and printer.true_mm("y") > 99, "the slow move")
        await asyncio.sleep(0.5)

    async def second(stage: Served) -> None:
        assert printer.true_mm("x") < 75
        assert printer.status("bed_mesh")["profile_name"] == ""
        await stage.call("job.recover", home=True)
        assert printer.status("bed_mesh")["profile_name"] == "bent"
        await stage.until_job("done")
        assert printer.true_mm("x") == pytest.approx(B_MM, abs=0.1)
        assert above_bed() == pytest.approx(0.6, abs=0.01)

    printer.serve(first, second)
