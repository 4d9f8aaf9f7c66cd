"""The gateway on a service in virtual time: what Moonraker asks for, in its order, and what comes back."""

import asyncio
import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from coordinator.klippy_api import script
from coordinator.klippy_api.client import RUNNING_MAX
from coordinator.klippy_api.gateway import BLOCKED_S, CLIENTS_MAX
from coordinator.klippy_api.step_dump import StepDump
from coordinator.klippy_api.wire import MESSAGE_BYTES_MAX
from coordinator.service.api import motion
from coordinator.service.api.motion import run_script
from coordinator.service.core.work import LINES_MAX, commands_in
from tests.coordinator.klippy_api import schema
from tests.stages.klippy_clients import KlippyApi, KlippyClient
from tests.stages.printer import PRINTING, Printer
from tests.stages.served import Served

SECTIONS = (
    PRINTING
    + """
[gcode_macro SAY]
variable_times: 2
gcode:
    RESPOND TYPE=command MSG="action:prompt_begin Hello"
    RESPOND TYPE=error MSG="no filament"
    RESPOND MSG="plain words"
    { action_respond_info("for people") }
    M105
    M114
    NONSENSE
    GET_POSITION
    { action_call_remote_method("shutdown_machine", delay=3) }
    { action_call_remote_method("nobody_has_it") }
[bed_mesh]
mesh_min: 20, 30
mesh_max: 120, 90
probe_count: 4, 3
[bed_mesh bent]
version: 1
points:
  0, 0.1, 0
  0.05, 0, 0
  0, 0, 0
x_count: 3
y_count: 3
min_x: 20
max_x: 120
min_y: 30
max_y: 90
[gcode_macro QUIET]
gcode:
    M117 quiet
"""
)
STOP = b'{"method":"emergency_stop"}\x03'
JOB = "M83\nM109 S210\n" + "".join(f"G1 X{20 + 20 * (n % 2)} Y{20 + n} E0.01 F6000\n" for n in range(60))


async def as_moonraker(client: KlippyClient) -> list[str]:
    """Ask for what Moonraker does, in its order; return the objects there are."""
    info = await client.ask("info", {"client_info": {"program": "Moonraker", "version": "0.11.0"}})
    for field in ("klipper_path", "python_path", "config_file"):
        assert Path(info[field]).is_absolute(), field
    assert info["software_version"].startswith("canductor-"), "no semantic version, or UIs call it too old"
    endpoints = (await client.ask("list_endpoints"))["endpoints"]
    assert {"info", "objects/list", "pause_resume/cancel", "query_endstops/status"} <= set(endpoints)
    assert info["state"] == "ready"
    assert (await client.watch({"webhooks": None}))["webhooks"]["state"] == "ready"
    await client.listen()
    assert (await client.ask("list_endpoints"))["endpoints"] == endpoints
    shown = await client.watch({"webhooks": None, "print_stats": None})
    assert shown["print_stats"]["state"] == "standby"
    objects: list[str] = (await client.ask("objects/list"))["objects"]
    config = (await client.query("configfile"))["configfile"]["config"]
    assert "virtual_sdcard" in objects
    assert "virtual_sdcard" in config
    for name in ("shutdown_machine", "reboot_machine", "pause_job_queue", "start_job_queue"):
        params = {"remote_method": name, "response_template": {"method": name}}
        assert await client.ask("register_remote_method", params) == {}
    heaters = (await client.query("heaters"))["heaters"]
    assert set(heaters["available_heaters"]) <= set(objects)
    assert set(heaters["available_sensors"]) <= set(objects)
    return objects


def test_what_moonraker_and_a_browser_ask_for(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS + schema.SECTIONS.format(folder=tmp_path))

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            objects = await as_moonraker(client)
            await _check_objects(client, objects)
            await _check_motion(client)
            await _check_mesh(client)
            await _check_outputs(client)
            await _check_print(client, served, printer)
            await _check_dumps(api, client)
            await _check_step_dumps(api, client)
            await _check_stop_and_restart(api, client, served)
            assert api.notices == []

    printer.serve(main)


async def _check_objects(client: KlippyClient, objects: list[str]) -> None:
    status = await client.watch(dict.fromkeys(objects))
    assert schema.problems(status) == []
    asked = await client.ask("objects/query", {"objects": {"extruder": ["can_extrude"]}})
    assert asked["status"] == {"extruder": {"can_extrude": False}}
    nodes = [name for name in objects if name.partition(" ")[0] == "mcu"]
    assert len(nodes) == 2
    for node in nodes:
        assert status[node]["mcu_constants"]["MCU"]
    assert status["gcode_macro SAY"] == {"times": 2}
    assert status["gcode_macro QUIET"] == {}
    assert "gcode_macro say" in status["configfile"]["settings"]
    assert await client.query("nothing") == {"nothing": {}}
    odd = await client.ask("objects/query", {"objects": {"toolhead": ["colour"]}})
    assert odd["status"] == {"toolhead": {"colour": None}}
    assert "must be null or a list" in await client.error("objects/query", {"objects": {"toolhead": 3}})
    static = {"configfile", "gcode", "heaters", "exclude_object"}
    for update in await client.updates(3.0):
        assert not static & update.keys(), "static parts are sent once"
    assert (await client.ask("gcode/help"))["PAUSE"] == "Pause the job"
    assert "there is no endpoint 'none'" in await client.error("none")


async def _check_motion(client: KlippyClient) -> None:
    await client.script("g28", "G90", "SET_VELOCITY_LIMIT ACCEL=1234", "G1 X30 Y40 Z5 F6000", "M400")
    await client.updates(0.3)
    status = await client.query("toolhead", "gcode_move", "motion_report", "query_endstops")
    assert status["toolhead"]["homed_axes"] == "xyz"
    assert status["toolhead"]["max_accel"] == pytest.approx(1234)
    assert status["toolhead"]["position"][:3] == pytest.approx([30, 40, 5])
    assert status["motion_report"]["live_position"][:3] == pytest.approx([30, 40, 5])
    assert status["motion_report"]["live_velocity"] == 0
    assert status["gcode_move"]["speed"] == pytest.approx(6000), "mm/min"
    assert status["gcode_move"]["absolute_coordinates"] is True
    await client.script("G20", "G91", "SET_GCODE_OFFSET Z=0.2")
    await client.updates(0.3)
    status = await client.query("gcode_move")
    assert status["gcode_move"]["gcode_position"][0] == pytest.approx(30), "mm, also after G20"
    assert status["gcode_move"]["absolute_coordinates"] is False
    assert status["gcode_move"]["homing_origin"][2] == pytest.approx(0.2)
    await client.script("G21", "G90", "SET_GCODE_OFFSET Z=0", "G1 X120 F3000")
    moving = await client.updates(1.0)
    speeds = [
        u["motion_report"]["live_velocity"] for u in moving if "live_velocity" in u.get("motion_report", {})
    ]
    assert max(speeds) == pytest.approx(50, rel=0.01)
    await client.script("M400")
    ends = await client.ask("query_endstops/status")
    assert set(ends) == {"x", "y", "z"}
    assert set(ends.values()) <= {"open", "TRIGGERED"}
    assert set((await client.query("query_endstops"))["query_endstops"]["last_query"].values()) <= {0, 1}


async def _check_dumps(api: KlippyApi, client: KlippyClient) -> None:
    """The executed moves, in order and without jumps, from where the head stood to where it stands."""
    watcher = api.connect()
    for name in ("toolhead", "extruder"):
        params = {"name": name, "response_template": {"method": name}}
        header = (await watcher.ask("motion_report/dump_trapq", params))["header"]
        assert header == ["time", "duration", "start_velocity", "acceleration", "start_position", "direction"]
    assert "one of toolhead, extruder" in await client.error("motion_report/dump_trapq", {"name": "x"})
    begin = (await client.query("toolhead"))["toolhead"]["position"]
    await client.script("M83", "G1 X100 Y20 E0.5 F3000", "G1 X110 F6000", "G1 E-0.2 F600", "M400")
    await watcher.updates(0.5)
    rows: dict[str, list[Any]] = {"toolhead": [], "extruder": []}
    for event in watcher.events:
        rows[event["method"]] += event["params"]["data"]
    _check_rows(rows["toolhead"], begin[:3], [110, 20, begin[2]])
    assert max(row[2] for row in rows["toolhead"]) == pytest.approx(100, rel=0.01)
    _check_rows(rows["extruder"], [begin[3], 0, 0], [begin[3] + 0.3, 0, 0])
    assert {row[5][0] for row in rows["extruder"]} == {1, -1}
    watcher.transport.close()


def _check_rows(rows: list[Any], begin: list[float], end: list[float]) -> None:
    """Make sure that ROWS of a dump lead from BEGIN to END without jumps."""
    at, before_s = begin, 0.0
    for time_s, duration_s, speed, accel, place, direction in rows:
        assert time_s >= before_s - 1e-9
        assert place == pytest.approx(at, abs=1e-6)
        way = (speed + accel * duration_s / 2) * duration_s
        assert way >= 0
        at = [value + way * ratio for value, ratio in zip(place, direction, strict=True)]
        before_s = time_s + duration_s
    assert at == pytest.approx(end, abs=1e-6)


async def _check_step_dumps(api: KlippyApi, client: KlippyClient) -> None:
    """Rows add up to the way, also for who begins to listen in the middle of a move; no clock is missing."""
    early, late = api.connect(), api.connect()
    ask = "motion_report/dump_stepper"
    await early.ask(ask, {"name": "stepper_x"})
    await client.script("G28", "G91", "G1 X0.5 F1200", "G90", "M400")
    await early.updates(0.5)
    said = [event["params"] for event in early.events]
    ends_mm = [_step_rows_end_mm(params) for params in said]
    assert ends_mm[-1] == pytest.approx(said[0]["first_position"] + 0.5, abs=0.02)
    early.transport.close()
    early = api.connect()
    await client.script("G1 X20 Y20 F6000", "M400")
    assert (await early.ask(ask, {"name": "stepper_x"}))["header"] == ["interval", "count", "add"]
    assert "one of stepper_x, " in await client.error(ask, {"name": "toolhead"})
    await client.script("G1 X110 F3000")
    await client.updates(0.6)
    await late.ask(ask, {"name": "stepper_x"})
    await client.script("G4 P10", "G1 X60 F6000", "M400")
    await early.updates(0.5)
    await late.updates(0.1)
    for watcher, begins_mm in ((early, 20 + 20), (late, None)):  # the motor turns for X + Y
        said = [event["params"] for event in watcher.events]
        assert begins_mm is None or said[0]["first_position"] == pytest.approx(begins_mm, abs=0.02)
        ends_mm = [_step_rows_end_mm(params) for params in said]
        assert ends_mm[-1] == pytest.approx(60 + 20, abs=0.02)
        for before, after, end_mm in zip(said, said[1:], ends_mm, strict=False):
            assert after["first_position"] == pytest.approx(end_mm, abs=1e-9)
            assert after["first_clock"] - after["data"][0][0] == before["last_clock"]
        ticks_per_step = [row[0] for params in said for row in params["data"] if abs(row[1]) > 100]
        freq = (said[0]["last_clock"] - said[0]["first_clock"]) / (
            said[0]["last_time"] - said[0]["first_time"]
        )
        assert min(ticks_per_step) == pytest.approx(freq * said[0]["step_distance"] / 100, rel=0.01)
        watcher.transport.close()
    whole = {event["params"]["last_clock"]: event["params"]["data"] for event in early.events}
    for params in (event["params"] for event in late.events):
        rows = params["data"]
        assert whole[params["last_clock"]][-len(rows) :] == rows


def test_a_stepper_is_watched_before_motion_has_begun(tmp_path: Path) -> None:
    printer = Printer(tmp_path)

    async def main(served: Served) -> None:
        motion, machine = served.service.ready_motion(), served.service.up_machine()
        motion.streamer.worker.maps = []  # as before its first clocks are there
        assert await StepDump("stepper_x", {}, motion, machine).take(motion, machine) is None

    printer.serve(main)


def _step_rows_end_mm(params: dict[str, Any]) -> float:
    """Return where the rows of a message lead; their clocks have to lead to its last one."""
    clock = params["first_clock"] - params["data"][0][0]
    steps = 0
    for interval, count, add in params["data"]:
        clock += interval * abs(count) + add * abs(count) * (abs(count) - 1) // 2
        steps += count
    assert clock == params["last_clock"]
    return float(params["first_position"] + steps * params["step_distance"])


async def _check_mesh(client: KlippyClient) -> None:
    found = await client.ask("bed_mesh/dump_mesh")
    assert found["current_mesh"] == {}
    assert found["profiles"]["bent"]["points"] == [[0, 0.1, 0], [0.05, 0, 0], [0, 0, 0]]
    planned = found["calibration"]
    assert planned["points"][1] == [pytest.approx(160 / 3), 30]
    assert planned["probe_path"][3:5] == [[120, 30], [120, 60]]
    assert (planned["config"]["x_count"], planned["config"]["y_count"]) == (4, 3)
    assert len(found["axis_maximum"]) == len(found["axis_minimum"]) == 4
    await client.ask("gcode/script", {"script": "BED_MESH_PROFILE LOAD=bent"})
    other = {"mesh_args": {"probe_count": "3, 3", "MESH_MAX": "100,90"}}
    found = await client.ask("bed_mesh/dump_mesh", other)
    assert found["current_mesh"]["name"] == "bent"
    assert found["current_mesh"]["mesh_params"]["max_x"] == 120
    assert len(found["current_mesh"]["mesh_matrix"]) > 2
    assert found["calibration"]["points"][2] == [100, 30]
    bad = {"mesh_args": {"mesh_max": "1,1"}}
    assert "MESH_MAX is not beyond" in await client.error("bed_mesh/dump_mesh", bad)
    await client.ask("gcode/script", {"script": "BED_MESH_CLEAR"})


async def _check_outputs(client: KlippyClient) -> None:
    client.said()
    await client.script("SAY")
    await asyncio.sleep(0.1)
    said = client.said()
    assert "// action:prompt_begin Hello" in said
    assert "!! no filament" in said
    assert "echo: plain words" in said
    assert "// for people" in said
    assert any(line.startswith("B:") and " T0:" in line for line in said), "filters of UIs know it so"
    assert any(line.startswith("X:120.000 Y:40.000") for line in said)
    assert any(line.startswith("// ") and "NONSENSE" in line for line in said), "unknown, and no error"
    assert any(line.startswith("// toolhead: X:120.000000") for line in said)
    assert "// the remote method nobody_has_it was not called: no client has registered one" in said
    calls = [event["params"] for event in client.events if event["method"] == "shutdown_machine"]
    assert calls == [{"delay": 3}]
    assert "outside" in await client.error("gcode/script", {"script": "G1 X9999\nM117 not done"})
    assert [line for line in client.said() if line.startswith("!! ")]
    assert (await client.query("display_status"))["display_status"]["message"] is None
    assert await client.ask("gcode/script", {"script": "\n"}) == {}


async def _check_print(client: KlippyClient, served: Served, printer: Printer) -> None:
    folder = served.jobs / "sub"
    folder.mkdir()
    (folder / "part.gcode").write_text(JOB)
    await client.script('SDCARD_PRINT_FILE FILENAME="sub/part.gcode"')
    states: list[str] = []

    async def look(*until: str) -> dict[str, Any]:
        while not states or states[-1] not in until:
            assert states[-1:] != ["error"], await client.query("print_stats")
            for update in await client.updates(0.26):
                told = update.get("print_stats", {})
                states.extend(told[field] for field in ("state",) if field in told)
        return await client.query("print_stats", "virtual_sdcard", "pause_resume", "display_status")

    status = await look("printing")
    assert status["print_stats"]["filename"] == "sub/part.gcode"
    assert status["virtual_sdcard"]["file_path"] == str(served.jobs / "sub" / "part.gcode")
    assert "pause it first" in await client.error("query_endstops/status")
    async with asyncio.timeout(120):
        while (told := (await client.query("print_stats"))["print_stats"])["filament_used"] == 0:
            assert told["state"] == "printing", told
            assert told["print_duration"] == 0, "heating is no printing"
            await client.updates(0.26)
    assert 0 < told["print_duration"] < told["total_duration"] - 1.0
    reports = [update.get("motion_report", {}) for update in await client.updates(1.1)]
    flows = [report["live_extruder_velocity"] for report in reports if "live_extruder_velocity" in report]
    assert 0 < max(flows) < 0.1, "mm/s of filament: 0.01 mm in each 20 mm at 100 mm/s"
    client.said()
    await client.script("M105")  # beside the job: told once
    assert len([line for line in client.said() if line.startswith("B:")]) == 1
    assert await client.ask("pause_resume/pause") == {}
    assert (await look("paused"))["pause_resume"]["is_paused"] is True
    assert await client.ask("pause_resume/resume") == {}
    status = await look("printing")
    assert status["display_status"]["progress"] == status["virtual_sdcard"]["progress"]
    assert await client.ask("pause_resume/pause") == {}
    await look("paused")
    assert await client.ask("pause_resume/cancel") == {}
    await look("cancelled")
    assert states == ["printing", "paused", "printing", "paused", "cancelled"], "a cancel is no resume"
    await _check_jobs_in_a_row(client)
    assert [path.name for path in served.jobs.iterdir()] == ["sub"], "front ends list what is in there"
    assert len(list((served.jobs.parent / "state").glob("journal-*"))) == 1


async def _check_jobs_in_a_row(client: KlippyClient) -> None:
    """A job follows another within less than the time between two updates; each state is seen."""

    async def is_in(state: str) -> None:
        async with asyncio.timeout(60):
            while (await client.query("print_stats"))["print_stats"]["state"] != state:  # noqa: ASYNC110
                await asyncio.sleep(0.01)  # faster than updates come

    await client.updates(1.0)
    for _ in range(2):
        await client.script('SDCARD_PRINT_FILE FILENAME="sub/part.gcode"')
        await is_in("printing")
        assert await client.ask("pause_resume/cancel") == {}
        await is_in("cancelled")
    updates = await client.updates(0.3)
    states = [
        update["print_stats"]["state"] for update in updates if "state" in update.get("print_stats", {})
    ]
    assert states == ["printing", "paused", "cancelled"] * 2, "Moonraker's history has both"


async def _check_stop_and_restart(api: KlippyApi, client: KlippyClient, served: Served) -> None:
    waiting = client.send("gcode/script", {"script": "G4 P60000\nM400"})
    await asyncio.sleep(0.5)
    # In one piece behind a hundred others: the machine is stopped before the first of them is answered.
    calls = b"".join(b'{"method":"info","id":"n%d"}\x03' % n for n in range(100))
    client.send_bytes(calls + b'{"method":"emergency_stop","id":"stop"}\x03')
    assert str(served.service.state) == "shutdown"
    answers = [json.loads(body) for body in bytes(client.transport.written).split(b"\x03") if body]
    ids = [answer["id"] for answer in answers if "id" in answer]
    assert ids.index("stop") == 0
    assert all(a["result"]["state"] == "shutdown" for a in answers if a.get("id") == "n0")
    assert "error" in await client.answer(waiting)
    updates = await client.updates(0.3)
    assert any(update.get("webhooks", {}).get("state") == "shutdown" for update in updates)
    info = await client.ask("info")
    assert "emergency stop" in info["state_message"]
    assert await client.error("gcode/script", {"script": "G1 X1"}) == info["state_message"]
    client.said()
    await client.script("M105")
    await client.script("M115")
    await asyncio.sleep(0)
    said = client.said()
    assert said[0].startswith("B:")
    assert said[1].startswith("FIRMWARE_NAME:")
    await _check_restarts_that_a_stop_overtakes(client, served)
    client.send_bytes(STOP + b'{"method":"gcode/firmware_restart"}\x03')
    await asyncio.sleep(1.0)
    assert client.transport.ended, "so that clients read everything again"
    again = api.connect()
    assert (await again.ask("info"))["state"] == "startup"
    seen = set()
    while (state := (await again.ask("info"))["state"]) != "ready":
        assert state == "startup"
        objects = (await again.ask("objects/list"))["objects"]
        status = await again.query(*objects)
        assert status["webhooks"]["state"] == "startup"
        if "mcu" in status and status["mcu"]["mcu_version"]:
            assert schema.problems(status) == [], "all fields, as clients may watch them from now on"
        seen.add(len(objects))
        await asyncio.sleep(0.05)
    assert seen
    stats = (await again.query("print_stats"))["print_stats"]
    assert (stats["state"], stats["filename"]) == ("standby", "")


async def _check_restarts_that_a_stop_overtakes(client: KlippyClient, served: Served) -> None:
    """What was sent first does not undo the stop behind it; failed before."""
    starts = served.service.starts
    for call in (
        {"method": "gcode/restart", "id": 900},
        {"method": "gcode/firmware_restart", "id": 900},
        {"method": "gcode/script", "params": {"script": "FIRMWARE_RESTART"}, "id": 900},
    ):
        client.send_bytes(json.dumps(call).encode() + b"\x03" + STOP)
        refused = await client.answer(900)
        assert "an emergency stop that was sent behind it came first" in refused["error"]["message"]
    await asyncio.sleep(1.0)
    assert (served.service.starts, str(served.service.state)) == (starts, "shutdown")


def test_a_configuration_that_does_not_load(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING)
    good = printer.config.read_text()
    printer.config.write_text(good + "[heater_generic\n")

    async def whole() -> None:
        served = Served(tmp_path, printer.load, printer.host)
        life = asyncio.ensure_future(served.service.run())
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            await served.until_state("error")
            info = await client.ask("info")
            assert info["state"] == "error"
            assert "heater_generic" in info["state_message"]
            await client.listen()
            objects = (await client.ask("objects/list"))["objects"]
            status = await client.watch(dict.fromkeys(objects))
            assert status["webhooks"]["state"] == "error"
            assert status["configfile"]["config"] == {}
            assert status["print_stats"]["state"] == "standby"
            assert await client.error("gcode/script", {"script": "G28"}) == info["state_message"]
            assert await client.ask("gcode/help") == {}
            assert await client.ask("emergency_stop") == {}
            printer.config.write_text(good)
            client.send("gcode/script", {"script": "RESTART"})
            await asyncio.sleep(0.1)
            await served.until_state("ready")
            assert client.transport.ended
            assert (await api.connect().ask("info"))["state"] == "ready"
        life.cancel()
        await asyncio.gather(life, return_exceptions=True)

    printer.run(whole)


def test_clients_that_ask_too_much(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            good = api.connect()
            await good.watch({"toolhead": None})
            await _check_garbage(api)
            await _check_blocked(api)
            await _check_crowd(api)
            assert len(await good.updates(1.1)) >= 4, "nobody else has lost anything"

    printer.serve(main)


async def _check_garbage(api: KlippyApi) -> None:
    garbage = api.connect()
    garbage.send_bytes(b"\x00\xff\x03{}\x03[1]\x03" * 1000)
    assert (await garbage.ask("info"))["state"] == "ready", "what is no call is dropped, the connection stays"
    assert len(api.notices) == 1, "one line of the log"
    garbage.send_bytes(b'{"method": "gcode/script", "params": {"script": "' + b"x" * 20_000_000)
    assert garbage.transport.ended
    assert f"{MESSAGE_BYTES_MAX:,} bytes" in api.notices.pop()
    assert len(api.notices) == 1
    api.notices.clear()
    half = api.connect()
    half.send_bytes(b'{"method": "in')
    await asyncio.sleep(10.0)
    half.send_bytes(b'fo", "id": 0}\x03')
    assert (await half.answer(0))["result"]["state"] == "ready"


async def _check_blocked(api: KlippyApi) -> None:
    blocked, greedy = api.connect(), api.connect()
    await blocked.watch({"configfile": None})
    blocked.transport.blocked = greedy.transport.blocked = True
    blocked.send_bytes(b'{"method":"gcode/help","id":1}\x03' * 20)
    greedy.send_bytes(b'{"method":"gcode/help","id":1}\x03' * 2_000)
    await asyncio.sleep(1.0)
    assert greedy.transport.ended
    assert not blocked.transport.ended
    await asyncio.sleep(BLOCKED_S)
    assert blocked.transport.ended
    assert len(api.notices) == 2
    api.notices.clear()


async def _check_crowd(api: KlippyApi) -> None:
    crowd = [api.connect() for _ in range(CLIENTS_MAX)]
    left = [client for client in crowd if not client.transport.ended]
    assert len(left) < CLIENTS_MAX
    assert len(api.notices) == CLIENTS_MAX - len(left)
    assert (await left[-1].ask("info"))["state"] == "ready"
    for client in left:
        client.transport.close()
    await asyncio.sleep(0)
    assert not api.connect().transport.ended


@pytest.mark.parametrize("mark", ["\x0b", "\x0c", "\x1c", "\x85", "\u2028"])
def test_a_text_does_not_become_a_second_command(tmp_path: Path, mark: str) -> None:
    """Failed before: whatever Python takes for the end of a line was one, here and in ``gcode.run``."""
    printer = Printer(tmp_path, PRINTING)
    text = f"M117 hello{mark}M118 injected"

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            await client.listen()
            await client.script(text)
            await client.updates(0.3)
            assert client.said() == []
            assert (await client.query("display_status"))["display_status"]["message"] == (
                "hello?M118 injected"
            )
        assert (await run_script(served.service, text, wait=True)).output == []

    printer.serve(main)


def test_a_stopped_machine_answers_one_line_in_a_turn_of_the_loop(tmp_path: Path) -> None:
    """Failed before: all lines of all scripts in one turn, and any number of them."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client, other = api.connect(), api.connect()
            await client.listen()
            await client.ask("emergency_stop")
            client.events.clear()
            calls = [who.send("gcode/script", {"script": "M115\n" * 30}) for who in (client, other)]
            assert (await other.answer(calls[1]))["result"] == {}
            assert (await client.answer(calls[0]))["result"] == {}
            await asyncio.sleep(0)
            await client.ask("info")
            said = [event["params"]["response"] for event in client.events if event["method"] == "said"]
            assert len(said) == 60, "what is said in one turn comes in one message"

    printer.serve(main)


def test_a_stopped_machine_answers_without_its_macros(tmp_path: Path) -> None:
    """Failed before: a macro named as what is answered was rendered on the control loop, and did nothing."""
    macro = "\n[gcode_macro M115]\nrename_existing: M115.1\ngcode:\n    {action_respond_info('rendered')}\n"
    printer = Printer(tmp_path, PRINTING + macro)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            await client.listen()
            await client.ask("emergency_stop")
            client.said()
            await client.script("M115")
            await asyncio.sleep(0)
            (said,) = client.said()
            assert said.startswith("FIRMWARE_NAME:")

    printer.serve(main)


def test_scripts_are_read_one_in_a_turn_of_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed before: of all clients together in one turn, 2 ms each; also those of ``gcode.run``."""
    printer = Printer(tmp_path, PRINTING)
    turn, read_in = 0, list[int]()

    def read(lines: list[str]) -> list[str]:
        assert len(lines) <= LINES_MAX
        read_in.append(turn)
        return commands_in(lines)

    async def main(served: Served) -> None:
        nonlocal turn
        async with KlippyApi.of(served, printer.config) as api:
            clients = [api.connect() for _ in range(4)]
            calls = [who.send("gcode/script", {"script": ";\n" * 400 + "M118 a"}) for who in clients * 3]
            more = [asyncio.create_task(run_script(served.service, "M118 b", wait=False)) for _ in calls]
            while len(read_in) < 2 * len(calls):
                turn += 1
                await asyncio.sleep(0)
            await asyncio.gather(*more)
        assert len(set(read_in)) == len(read_in)

    monkeypatch.setattr(motion, "commands_in", read)
    printer.serve(main)


def test_a_stop_while_a_script_waits_for_its_turn_is_not_undone_by_it(tmp_path: Path) -> None:
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client, other = api.connect(), api.connect()
            restart = client.send("gcode/script", {"script": "RESTART"})
            await asyncio.sleep(0)
            other.send("emergency_stop")
            assert "emergency stop" in (await client.answer(restart))["error"]["message"]
            await client.updates(1.0)
            assert str(served.service.state) == "shutdown"

    printer.serve(main)


def test_a_stop_in_a_script_does_not_count_among_what_runs(tmp_path: Path) -> None:
    """Failed before: it was one request too many, of this client or of all."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            for _ in range(RUNNING_MAX + 1):
                last = client.send("gcode/script", {"script": "G4 P9000"})
            assert "too many requests" in (await client.answer(last))["error"]["message"]
            await client.script("M112")
            assert str(served.service.state) == "shutdown"

    printer.serve(main)


def test_a_stop_that_waits_for_its_turn_outlives_its_client(tmp_path: Path) -> None:
    """Failed before: it was forgotten with the connection."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            client.connection.client.receive(b'{"method":"M112"}\x03{"method":\x03"M112"\x03' + STOP)
            client.connection.connection_lost(BrokenPipeError())
            assert str(served.service.state) == "shutdown"

    printer.serve(main)


def test_long_scripts_are_refused_unless_they_stop_the_machine(tmp_path: Path) -> None:
    """Failed before: a message's 256 KiB may be 130,000 lines."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            for long in ("\n" * (script.LINES_MAX + 1), ";" * (script.BYTES_MAX + 1)):
                assert "print a file instead" in await client.error("gcode/script", {"script": long})
            longest = ";" * (script.BYTES_MAX - script.LINES_MAX) + "\n" * (script.LINES_MAX - 5) + "M400"
            assert "longer than 4096" in await client.error("gcode/script", {"script": longest})
            await client.script(*[";"] * script.LINES_MAX)
            await client.script("\n" * 100_000 + "M112")
            assert str(served.service.state) == "shutdown"

    printer.serve(main)


def test_a_result_that_cannot_be_written_is_an_error_of_its_call(tmp_path: Path) -> None:
    """Failed before: an exception in the loop, which ended the connection."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            api.gateway.endpoints._always["info"] = lambda _client, _request: {"a": {(1, 2): 3}}
            assert "cannot be written as JSON" in await client.error("info")
            assert "PAUSE" in await client.ask("gcode/help")

    printer.serve(main)


def test_clients_are_updated_one_in_a_turn_of_the_loop(tmp_path: Path) -> None:
    """Failed before: all of them in one, with all that they watch."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            clients = [api.connect() for _ in range(6)]
            for client in clients:
                await client.watch({"webhooks": None})
            await clients[0].updates(1.0)
            for client in clients:
                client.transport.written.clear()
            served.service.emergency_stop("a test")
            api.gateway.note({"kind": "job", "text": ""})
            written = [0]
            while written[-1] < len(clients):
                await asyncio.sleep(0)
                written.append(sum(bool(client.transport.written) for client in clients))
            steps = [after - before for before, after in itertools.pairwise(written)]
            assert max(steps) == 1

    printer.serve(main)


def test_replies_are_shown_few_in_a_turn_of_the_loop(tmp_path: Path) -> None:
    """Failed before: 200, of 4,096 characters each."""
    printer = Printer(tmp_path, PRINTING)

    async def main(served: Served) -> None:
        async with KlippyApi.of(served, printer.config) as api:
            client = api.connect()
            await client.listen()
            await client.script(*["M118 a"] * 500)
            await client.script(*["M118 " + "b" * 3_900] * 30)
            await client.ask("info")
            said = [event["params"]["response"] for event in client.events if event["method"] == "said"]
            lines = [response.split("\n") for response in said]
            assert sum(map(len, lines)) == 530
            assert max(map(len, lines)) == 50
            assert max(map(len, said)) < 17 * 2_100

    printer.serve(main)
