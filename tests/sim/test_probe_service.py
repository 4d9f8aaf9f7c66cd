"""A probe in a service: lines of clients, what is saved, a job that is cancelled on the way down."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.virtual_machine.plant_bed import BedSettings
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage
from tests.stages.served import Served, running


async def run(served: Served, script: str) -> list[str]:
    """Run SCRIPT as a client; return the replies."""
    told = await served.call("gcode.run", script=script)
    return list(told["replies"])


def test_what_was_calibrated_is_written_and_holds_after_the_restart(tmp_path: Path) -> None:
    """The probe truly triggers 0.4 mm higher than configured."""
    stage = ProbeStage(tmp_path, bed=BedSettings(z_offset_mm=OFFSET[2] + 0.4))
    served = Served(tmp_path, lambda: load_machine(str(stage.config)), stage.host)

    async def main() -> None:
        async with running(served):
            await run(served, "G28\nG1 X50 Y60 Z6 F6000\nPROBE_CALIBRATE")
            await run(served, "TESTZ Z=-6.9")
            (told,) = await run(served, "ACCEPT")
            assert told.startswith(("probe: z_offset: 1.90", "probe: z_offset: 1.89"))
            await run(served, "SAVE_CONFIG")
            await served.until(lambda: served.service.starts == 2, "the next start")
            await served.until_state("ready")
            assert "#*# z_offset = 1." in stage.config.read_text()
            await run(served, "G28")
            machine = served.service.machine
            assert machine is not None
            assert machine.description.probe is not None
            assert machine.description.probe.offset[2] == pytest.approx(1.9, abs=2 * MICROSTEP_MM)
            assert served.planned[2] == pytest.approx(stage.true_mm("z"), abs=3 * MICROSTEP_MM)

    stage.run(main)


def test_a_job_that_is_cancelled_on_the_way_down_stops_there(tmp_path: Path) -> None:
    stage = ProbeStage(tmp_path)
    served = Served(tmp_path, lambda: stage.description, stage.host)

    async def main() -> None:
        async with running(served):
            served.write_job("G28\nG1 Z20 F1200\nPROBE PROBE_SPEED=2\nG1 X50 F6000\n")
            await served.call("job.start", file="job.gcode")
            await served.until(lambda: stage.true_mm("z") > 19.9, "the way up")
            await served.until(lambda: stage.true_mm("z") < 15, "the way down")
            await served.call("job.cancel")
            await served.until_job("cancelled")
            stopped_mm = stage.true_mm("z")
            assert stopped_mm > 14
            await run(served, "G4 P500")
            assert stage.true_mm("z") == stopped_mm
            with pytest.raises(Exception, match="PROBE comes before Z is homed"):
                await run(served, "PROBE")
            await run(served, "G28\nG1 Z5 F600\nPROBE")
            assert served.planned[2] == pytest.approx(stage.true_mm("z"), abs=3 * MICROSTEP_MM)

    stage.run(main)
