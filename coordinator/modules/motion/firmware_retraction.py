"""[firmware_retraction]: G10 retracts the filament, G11 undoes that."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from coordinator.config.options import FloatOption, SectionSpec
from coordinator.gcode.commands import Call, Immediate, Lines, Reading
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError, command_line
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value

LENGTH = FloatOption(
    name="retract_length", help="How far G10 retracts", default=0.0, unit="mm", minimum=0.0, maximum=100.0
)
SPEED = FloatOption(
    name="retract_speed", help="How fast", default=20.0, unit="mm/s", minimum=1.0, maximum=1000.0
)
EXTRA = FloatOption(
    name="unretract_extra_length",
    help="How much more filament G11 pushes forward than G10 retracted",
    default=0.0,
    unit="mm",
    minimum=0.0,
    maximum=100.0,
)
BACK_SPEED = FloatOption(
    name="unretract_speed", help="How fast", default=10.0, unit="mm/s", minimum=1.0, maximum=1000.0
)
HOP = FloatOption(
    name="z_hop_height",
    help="How far the nozzle is lifted while the filament is retracted",
    default=0.0,
    unit="mm",
    minimum=0.0,
    maximum=10.0,
)
_STATE: Final = "_retraction"


@dataclass(frozen=True)
class _Settings:
    retract_length: float
    retract_speed: float
    unretract_extra_length: float
    unretract_speed: float
    z_hop_height: float


class FirmwareRetraction(Module):
    """The commands; G11 undoes what G10 did, also when settings changed meanwhile."""

    SPEC = SectionSpec(
        "Retraction by G10 and G11",
        (LENGTH, SPEED, EXTRA, BACK_SPEED, HOP),
        unsupported=("clear_zhop_on_z_moves",),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        get = build.get
        self._settings = self._configured = _Settings(
            get(LENGTH), get(SPEED), get(EXTRA), get(BACK_SPEED), get(HOP)
        )
        self._retracted: _Settings | None = None
        """The settings that G10 used; None: the filament is not retracted."""
        build.add_command("G10", "Retract the filament", self._retract)
        build.add_command("G11", "Undo the retraction", self._unretract)
        for name, help_, read in (
            ("SET_RETRACTION", "Change the settings of G10 and G11", self._set),
            ("GET_RETRACTION", "Report the settings of G10 and G11", self._get),
            ("RESET_RETRACTION", "Restore the configured settings", self._reset),
            (
                "CLEAR_RETRACTION",
                "Restore the configured settings, and forget that the filament is retracted",
                self._clear,
            ),
        ):
            build.add_command(name, help_, read, while_printing=True)

    def status(self) -> Mapping[str, Value]:
        """Report the settings, and whether the filament is retracted."""
        return {**vars(self._settings), "retracted": self._retracted is not None}

    def _retract(self, _call: Call) -> Reading:
        s = self._settings
        if self._retracted is not None or s.retract_length == 0:
            return Immediate()
        self._retracted = s
        hop = [command_line("SET_GCODE_OFFSET", Z_ADJUST=s.z_hop_height, MOVE=1)] if s.z_hop_height else []
        return self._lines([_extrude(-s.retract_length, s.retract_speed), *hop])

    def _unretract(self, _call: Call) -> Reading:
        s, self._retracted = self._retracted, None
        if s is None:
            return Immediate()
        hop = [command_line("SET_GCODE_OFFSET", Z_ADJUST=-s.z_hop_height, MOVE=1)] if s.z_hop_height else []
        now = self._settings
        length = s.retract_length + now.unretract_extra_length
        return self._lines([*hop, _extrude(length, now.unretract_speed)])

    @staticmethod
    def _lines(lines: list[str]) -> Lines:
        """Return LINES in the modes that they need; the modes of the program stay as they are."""
        moves = [line for line in lines if line.startswith("G1")]
        others = [line for line in lines if not line.startswith("G1")]
        framed = [
            f"SAVE_GCODE_STATE NAME={_STATE}",
            "G21",
            "M83",
            *moves,
            f"RESTORE_GCODE_STATE NAME={_STATE}",
        ]
        first = lines[0] == moves[0]
        return Lines("\n".join([*framed, *others] if first else [*others, *framed]))

    def _set(self, call: Call) -> Reading:
        command = call.command
        options = {option.name.upper(): option for option in (LENGTH, SPEED, EXTRA, BACK_SPEED, HOP)}
        values = call.parameters(*options)
        if not values:
            raise WordError(f"SET_RETRACTION names nothing; it takes {' '.join(options)}")
        changes = {}
        for name, option in options.items():
            low, high = option.minimum or 0.0, option.maximum or 0.0
            value = bounded(command, values, name, None, low=low, high=high)
            if value is not None:
                changes[option.name] = value

        def act() -> None:
            self._settings = replace(self._settings, **changes)

        return Immediate(act=act)

    def _get(self, _call: Call) -> Reading:
        texts = [f"{name.upper()}={value:g}" for name, value in vars(self._settings).items()]
        return Immediate((" ".join(texts),))

    def _reset(self, _call: Call) -> Reading:
        def act() -> None:
            self._settings = self._configured

        return Immediate(act=act)

    def _clear(self, _call: Call) -> Reading:
        def act() -> None:
            self._settings, self._retracted = self._configured, None

        return Immediate(act=act)


def _extrude(length_mm: float, speed_mm_s: float) -> str:
    return f"G1 E{length_mm:.6f} F{speed_mm_s * 60:.3f}"
