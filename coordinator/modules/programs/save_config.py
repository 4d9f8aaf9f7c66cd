"""SAVE_CONFIG, RESTART and FIRMWARE_RESTART."""

import asyncio

from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value
from nodes.support.errors import CanductorError


class SaveConfig(Module):
    """The commands that restart the machine."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "configfile"
        for name, text, read in (
            (
                "SAVE_CONFIG",
                "Write calibrated values into the configuration file, then restart",
                self._read_save,
            ),
            (
                "RESTART",
                "Read the configuration and restart the machine",
                lambda call: self._read_restart(call, firmware=False),
            ),
            (
                "FIRMWARE_RESTART",
                "RESTART with a reset of all nodes, also of those whose configuration is the same",
                lambda call: self._read_restart(call, firmware=True),
            ),
        ):
            build.add_command(name, text, read)

    def status(self) -> dict[str, Value]:
        """Report what SAVE_CONFIG would write."""
        if self._live is None:
            return {}
        pending = self._live.machine.unsaved.pending
        items: dict[str, Value] = {section: dict(options) for section, options in pending.items()}
        return {"save_config_pending": bool(items), "save_config_pending_items": items}

    def _read_save(self, call: Call) -> Reading:
        call.parameters()
        return AtStandstill(self._save)

    def _read_restart(self, call: Call, *, firmware: bool) -> Reading:
        call.parameters()
        return AtStandstill(lambda: self._restart(firmware=firmware))

    async def _save(self) -> Done | None:
        machine = self.live.machine
        if not machine.unsaved.pending:
            return Done(("nothing to save: nothing was calibrated since the machine started",))
        restart = machine.prepare_restart() if machine.prepare_restart is not None else None
        path = await asyncio.to_thread(machine.unsaved.write)
        if restart is None:
            return Done((f"saved into {path}; it counts from the next start on",))
        self.live.say(f"saved into {path}; the machine restarts")
        restart(False)
        return None

    async def _restart(self, *, firmware: bool) -> None:
        prepare = self.live.machine.prepare_restart
        if prepare is None:
            raise CanductorError(
                "a machine that runs a single file cannot restart; start the command again, or serve the"
                " machine with --ipc"
            )
        prepare()(firmware)
