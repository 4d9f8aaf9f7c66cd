"""Profiles of PID constants are loaded, saved and told of."""

import asyncio
import re
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.parser import WordError
from coordinator.modules.heaters.heaters import HeaterRegistry
from tests.stages.heat_machine import BASE, BED, HOTEND_PID, HeatMachine

FAST = "\n[pid_profile extruder fast]\ncontrol: pid\npid_kp: 30\npid_ki: 2\npid_kd: 120\npid_target: 240\n"


def told(profile: str, gains: str) -> str:
    kp, ki, kd = gains.split()
    return f"extruder has profile {profile}: pid_kp: {kp} pid_ki: {ki} pid_kd: {kd}"


def test_a_profile_is_loaded_and_left_again(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + BED + FAST)

    async def values() -> str:
        return (await stage.do("PID_PROFILE GET_VALUES=1 HEATER=extruder"))[0]

    async def main() -> None:
        assert await values() == told("default", "22.2 1.08 114")
        await stage.do("M104 S200")
        await stage.do("PID_PROFILE LOAD=fast HEATER=extruder")
        assert await values() == told("fast", "30 2 120")
        assert stage.status("extruder")["target"] == 0
        await stage.do("PID_PROFILE LOAD=none HEATER=extruder DEFAULT=default")
        assert await values() == told("default", "22.2 1.08 114")
        for line, why in (
            ("PID_PROFILE LOAD=fats HEATER=extruder", "has no profile 'fats'; did you mean fast"),
            ("PID_PROFILE LOAD=fast HEATER=heater_bed", "has no PID: its control is watermark"),
            ("PID_PROFILE HEATER=extruder", "needs one of LOAD, SAVE"),
            ("PID_PROFILE REMOVE=fats HEATER=extruder", "there is no 'fats'"),
            ("SET_HEATER_PID HEATER=extruder KP=1 KI=-1 KD=0", "SET_HEATER_PID must not be below 0"),
            ("SET_HEATER_PID HEATER=heater_bed KP=1 KI=1 KD=0", "has no PID"),
            ("PID_PROFILE SET_VALUES=x HEATER=extruder KP=1 KI=1", "needs KD="),
            ("PID_PROFILE SAVE=default HEATER=extruder", "choose another name"),
        ):
            with pytest.raises(WordError, match=re.escape(why)):
                stage.read(line)

    stage.connected(main)


def test_a_target_is_kept_without_a_jump_where_that_is_wanted(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + FAST)

    async def main() -> None:
        await stage.do("M109 S120")
        await asyncio.sleep(60)
        before = stage.status("extruder")["power"]
        await stage.do("SET_HEATER_PID HEATER=extruder KP=30 KI=2 KD=120")
        assert (await stage.do("PID_PROFILE GET_VALUES=1 HEATER=extruder"))[0] == told("default", "30 2 120")
        await stage.do("PID_PROFILE LOAD=fast HEATER=extruder KEEP_TARGET=1")
        low, high = await stage.true_range(20)
        assert 119 < low <= high < 121
        power = stage.status("extruder")["power"]
        assert isinstance(power, float)
        assert power == pytest.approx(before, abs=0.1)

    stage.connected(main)


def test_a_profile_is_saved_and_there_at_the_next_start(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID)

    async def main() -> None:
        await stage.do("PID_PROFILE SET_VALUES=mine HEATER=extruder KP=25 KI=1.5 KD=99")
        await stage.do("PID_PROFILE SAVE=mine HEATER=extruder")
        assert any("profile mine of extruder was saved" in notice for notice in stage.notices)
        await stage.do("PID_PROFILE SET_VALUES=gone HEATER=extruder KP=1 KI=1 KD=1")
        await stage.do("PID_PROFILE SAVE=gone HEATER=extruder")
        await stage.do("PID_PROFILE REMOVE=gone HEATER=extruder")
        assert stage.notices[-1].startswith("profile gone of extruder was removed")
        await stage.do("SAVE_CONFIG")

    stage.connected(main)
    path = tmp_path / "printer.cfg"
    assert "\n#*# [pid_profile extruder mine]\n#*# control = pid\n#*# pid_kp = 25\n" in path.read_text()
    assert "gone" not in path.read_text()
    (tmp_path / "again").mkdir()
    again = HeatMachine(tmp_path / "again", path.read_text().removeprefix(BASE))

    async def then() -> None:
        await again.do("PID_PROFILE LOAD=mine HEATER=extruder")
        (heaters,) = again.machine.modules.of(HeaterRegistry)
        assert heaters.units["extruder"].controller is not None
        assert (await again.do("PID_PROFILE GET_VALUES=1 HEATER=extruder"))[0] == told("mine", "25 1.5 99")

    again.connected(then)


@pytest.mark.parametrize("name", ["extruder", "hotend fast", "extruder default"])
def test_a_section_that_is_named_wrongly(tmp_path: Path, name: str) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(BASE + HOTEND_PID + FAST.replace("extruder fast", name))
    (found,) = check_config(str(path))
    assert f"[pid_profile {name}] must be named after a heater and itself" in str(found)
