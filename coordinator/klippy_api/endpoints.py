"""The endpoints: what each takes, does and gives, on a machine service."""

import os
import platform
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Final

from coordinator.gcode.parser import WordError
from coordinator.gcode.reply_kinds import ReplyKind, line_of
from coordinator.gcode.script_lines import script_lines
from coordinator.klippy_api.client import DUMPS_MAX, REMOTE_METHODS_MAX, Client
from coordinator.klippy_api.move_dump import HEADER as MOVE_HEADER
from coordinator.klippy_api.move_dump import TOOLHEAD, MoveDump
from coordinator.klippy_api.params import RequestError, objects_param, template_param, text_param
from coordinator.klippy_api.script import check_size, run_lines
from coordinator.klippy_api.status import StatusBuilder, state_of
from coordinator.klippy_api.step_dump import HEADER as STEP_HEADER
from coordinator.klippy_api.step_dump import StepDump
from coordinator.klippy_api.subscription import Subscription, select_fields
from coordinator.klippy_api.wire import Request
from coordinator.modules.compensation.bed_mesh import BedMesh
from coordinator.modules.homing.homing import Homing
from coordinator.modules.programs.pause_resume import PauseResume
from coordinator.service.core.machine_service import MachineService
from coordinator.service.core.work import LINES_MAX, has_emergency
from coordinator.support.version import VERSION
from nodes.support.errors import CanductorError

Result = Mapping[str, Any]
Endpoint = Callable[[Client, Request], Result | Awaitable[Result]]

APP: Final = "canductor"
WHO: Final = "a client of the Klippy API"
MESH_ARGUMENTS_MAX: Final = 32
_ROOT: Final = Path(__file__).parent.parent.parent


class Endpoints:
    """Serves calls from SERVICE.

    SAY shows a line to all who listen to what g-code answers; REGISTERED hears that remote methods changed.
    """

    def __init__(
        self,
        service: "MachineService",
        config: Path,
        say: Callable[[str], None],
        registered: Callable[[], None],
        log_file: Path | None = None,
    ) -> None:
        self.status = StatusBuilder(service)
        self._service = service
        self._say = say
        self._registered = registered
        self._about = {
            "hostname": platform.node(),
            "klipper_path": str(_ROOT),
            "python_path": sys.executable,
            "process_id": os.getpid(),
            "user_id": os.getuid(),
            "group_id": os.getgid(),
            "log_file": "" if log_file is None else str(log_file.absolute()),
            "config_file": str(config.absolute()),
            "software_version": f"{APP}-{VERSION}",
            "cpu_info": f"{os.cpu_count() or 1} core {platform.machine()}",
            "app": APP,
        }
        self._always: dict[str, Endpoint] = {
            "info": self._info,
            "list_endpoints": self._list_endpoints,
            "objects/list": self._objects_list,
            "objects/query": self._objects_query,
            "objects/subscribe": self._objects_subscribe,
            "gcode/help": self._help,
            "gcode/script": self._script,
            "gcode/restart": lambda _client, _request: self._lines("RESTART"),
            "gcode/firmware_restart": lambda _client, _request: self._lines("FIRMWARE_RESTART"),
            "gcode/subscribe_output": self._subscribe_output,
            "register_remote_method": self._register_remote_method,
            "emergency_stop": self._emergency_stop,
        }
        self._pausing: dict[str, Endpoint] = {
            "pause_resume/pause": lambda _client, _request: self._lines("PAUSE"),
            "pause_resume/resume": lambda _client, _request: self._lines("RESUME"),
            "pause_resume/cancel": lambda _client, _request: self._lines("CANCEL_PRINT"),
        }
        self._moving: dict[str, Endpoint] = {
            "motion_report/dump_trapq": self._dump_moves,
            "motion_report/dump_stepper": self._dump_steps,
        }
        self._levelling: dict[str, Endpoint] = {"bed_mesh/dump_mesh": self._dump_mesh}
        self._homing: dict[str, Endpoint] = {"query_endstops/status": self._endstops}

    def available(self) -> Mapping[str, Endpoint]:
        """Return what the machine has now, by name."""
        found = dict(self._always)
        machine = self._service.machine
        if machine is not None:
            found |= self._moving
            if next(machine.modules.of(PauseResume), None) is not None:
                found |= self._pausing
            if next(machine.modules.of(BedMesh), None) is not None:
                found |= self._levelling
            if machine.description.stops:
                found |= self._homing
        return found

    def begin(self, client: Client, request: Request) -> Result | Awaitable[Result]:
        """Begin REQUEST of CLIENT; raises CanductorError, also when its result is awaited."""
        endpoint = self.available().get(request.method)
        if endpoint is None:
            raise RequestError(f"there is no endpoint '{request.method[:80]}'")
        return endpoint(client, request)

    # ------------------------------------------------------------------------------------------ objects

    def _info(self, _client: Client, _request: Request) -> Result:
        state, message = state_of(self._service)
        return {"state": state, "state_message": message, **self._about}

    def _list_endpoints(self, _client: Client, _request: Request) -> Result:
        return {"endpoints": list(self.available())}

    def _objects_list(self, _client: Client, _request: Request) -> Result:
        return {"objects": list(self.status.build())}

    def _objects_query(self, _client: Client, request: Request) -> Result:
        shown = select_fields(objects_param(request), self.status.build())
        return {"eventtime": self._service.now_s, "status": shown}

    def _objects_subscribe(self, client: Client, request: Request) -> Result:
        subscription = Subscription(template_param(request), objects_param(request))
        shown = subscription.begin(self.status.build())
        client.subscription = subscription if subscription.requested else None
        return {"eventtime": self._service.now_s, "status": shown}

    def _dump_mesh(self, _client: Client, request: Request) -> Result:
        arguments = request.params.get("mesh_args", {})
        if not isinstance(arguments, dict) or len(arguments) > MESH_ARGUMENTS_MAX:
            raise RequestError(f"{request.method}: the argument 'mesh_args' must be a small object")
        try:
            return next(self._service.up_machine().modules.of(BedMesh)).dump(arguments)
        except WordError as error:
            raise RequestError(f"{request.method}: {error}") from None

    def _dump_moves(self, client: Client, request: Request) -> Result:
        described, motion = self._service.up_machine().description, self._service.ready_motion()
        known = [TOOLHEAD, *(extruder.name for extruder in described.extruders)]
        name = _dumped(request, known, client.move_dumps)
        client.move_dumps.append(MoveDump(name, template_param(request), motion.now_s))
        return {"header": MOVE_HEADER}

    def _dump_steps(self, client: Client, request: Request) -> Result:
        machine, motion = self._service.up_machine(), self._service.ready_motion()
        known = [stepper.name for stepper in machine.description.steppers]
        name = _dumped(request, known, client.step_dumps)
        client.step_dumps.append(StepDump(name, template_param(request), motion, machine))
        return {"header": STEP_HEADER}

    def _endstops(self, _client: Client, _request: Request) -> Awaitable[Result]:
        job = self._service.active_job
        if job is not None and not job.gives_way:
            raise RequestError("endstops cannot be asked for while a job prints; pause it first")
        return self._asked_endstops()

    async def _asked_endstops(self) -> Result:
        await self._lines("QUERY_ENDSTOPS")
        homing = next(self._service.up_machine().modules.of(Homing))
        found = homing.status()["last_query"]
        assert isinstance(found, dict)
        return {name: "TRIGGERED" if pressed else "open" for name, pressed in found.items()}

    # ------------------------------------------------------------------------------------------- g-code

    def _help(self, _client: Client, _request: Request) -> Result:
        machine = self._service.machine
        command_help = {} if machine is None else machine.modules.command_help
        return {name: text for name, text in command_help.items() if text}

    def _script(self, _client: Client, request: Request) -> Awaitable[Result] | Result:
        script = text_param(request, "script")
        if has_emergency(script):
            self._service.emergency_stop(f"M112 of {WHO}")
            return {}
        check_size(script)
        return self._lines(script)

    async def _lines(self, script: str) -> Result:
        """Run SCRIPT; errors also go to all who listen to g-code."""
        lines = [line for line in script_lines(script) if line.strip()]
        try:
            for first in range(0, len(lines), LINES_MAX):
                await run_lines(self._service, lines[first : first + LINES_MAX], self._say)
        except CanductorError as error:
            self._say(line_of(ReplyKind.ERROR, str(error)))
            raise
        return {}

    # --------------------------------------------------------------------------------------- the others

    def _subscribe_output(self, client: Client, request: Request) -> Result:
        client.output = template_param(request)
        return {}

    def _register_remote_method(self, client: Client, request: Request) -> Result:
        name, template = text_param(request, "remote_method"), template_param(request)
        if not client.register(name, template):
            raise RequestError(f"a client may register {REMOTE_METHODS_MAX} remote methods")
        self._registered()
        return {}

    def stops(self, request: Request) -> str | None:
        """Return who stops the machine with REQUEST; None: it does not. In any thread."""
        if request.method == "emergency_stop":
            return WHO
        script = request.params.get("script")
        if request.method == "gcode/script" and isinstance(script, str) and has_emergency(script):
            return f"M112 of {WHO}"
        return None

    def _emergency_stop(self, _client: Client, _request: Request) -> Result:
        self._service.emergency_stop(WHO)
        return {}


def _dumped(request: Request, known: Sequence[str], dumps: Sized) -> str:
    """Return the name of what REQUEST wants to hear about, one of KNOWN; raises RequestError."""
    name = text_param(request, "name")
    if name not in known:
        raise RequestError(f"{request.method}: 'name' must be one of {', '.join(known)}")
    if len(dumps) >= DUMPS_MAX:
        raise RequestError(f"{request.method}: a client may have {DUMPS_MAX} of them")
    return name
