"""A sensor that says nothing more while its heater is held or calibrated: the heat ends, and it is told why."""

import asyncio
from pathlib import Path

import pytest

from coordinator.modules.heater import LOOK_S, SILENT_LOOKS
from nodes.errors import CanductorError
from tests.coordinator.modules.broken_sensor import Sensor
from tests.coordinator.modules.heat_stage import FAN, HOTEND_PID, HeatMachine

BOX = """
[mcu box]
canbus_uuid: 0123456789ad
canbus_interface: can0
policy: optional

[heater_generic chamber]
heater_pin: PC3
sensor_type: Generic 3950
sensor_pin: box:PA2
min_temp: 0
max_temp: 100
control: watermark
heater_power: 200
"""
def test_x(tmp_path):
    stage = HeatMachine(tmp_path, HOTEND_PID + BOX, hurry=5)
    async def main():
        sensor=Sensor(stage,"chamber")
        t=asyncio.ensure_future(stage.do("PID_CALIBRATE HEATER=chamber TARGET=60"))
        await sensor.good(5)
        board = stage.stage._boards["box"].node
        cut_s = stage.now_s()
        board.controller.cut(1)
        while not t.done() and stage.now_s()<cut_s+15:
            await asyncio.sleep(0.05)
        print(stage.now_s()-cut_s, t, stage.machine.stopped, stage.edges("PC3","mcu")[-3:], cut_s, stage.notices)
    stage.run(main)
