"""[pid_profile HEATER NAME]: PID constants for other circumstances; PID_PROFILE loads and saves them."""

from collections.abc import Mapping
from typing import ClassVar, Final

from coordinator.config.errors import ConfigError
from coordinator.config.options import ChoiceOption, FloatOption, SectionSpec
from coordinator.config.sections.heater_options import PID_KD, PID_KI, PID_KP
from coordinator.gcode.commands import Call, Immediate, Reading, Synchronized
from coordinator.gcode.parameters import one, value
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.heat.pid import Pid, PidGains
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.support.quoting import nearest_or_all, shown
from coordinator.support.values import Value

KIND: Final = "pid_profile"
DEFAULT: Final = "default"
"""The profile that is the heater's own section."""
PROFILES_MAX: Final = 100
"""For one heater."""
CONTROL: Final = ChoiceOption(
    name="control", help="what it is for", default="pid", choices=("pid",), unsupported=("pid_v", "mpc")
)
PID_TARGET: Final = FloatOption(
    name="pid_target",
    help="the temperature it was found at; only reported",
    unit="°C",
    minimum=0,
    maximum=1500,
)
ACTIONS: Final = ("LOAD", "SAVE", "SET_VALUES", "GET_VALUES", "REMOVE")
GAINS: Final = ("KP", "KI", "KD")


class PidProfiles(Module):
    """The profiles of all heaters, and PID_PROFILE."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "pid_profile"
        self._heaters = build.shared(HeaterRegistry)
        self._of: dict[str, dict[str, PidGains]] = {}
        self._loaded: dict[str, str] = {}
        build.add_command(
            "PID_PROFILE",
            "LOAD=, SAVE=, REMOVE= or SET_VALUES= a profile of HEATER=, or GET_VALUES=1",
            self._read,
        )
        build.add_command(
            "SET_HEATER_PID", "Use other PID constants until a restart: HEATER= KP= KI= KD=", self._set_pid
        )

    def add(self, heater: str, name: str, gains: PidGains) -> None:
        """Add a profile; HEATER is its name in programs."""
        self._of.setdefault(heater, {})[name] = gains

    def heater(self, name: str) -> Heater | None:
        """Return the heater that programs or sections call NAME."""
        units = self._heaters.units.values()
        return next((unit for unit in units if name in (unit.key, unit.name)), None)

    def status(self) -> Mapping[str, Value]:
        """Report which profile each heater has; those that have none are left out."""
        return {"loaded": dict(self._loaded)}

    def _read(self, call: Call) -> Reading:
        command = call.command
        known = (*ACTIONS, *GAINS, "HEATER", "KEEP_TARGET", "VERBOSE", "DEFAULT", "TARGET", "TOLERANCE")
        given = call.parameters(*known)
        actions = [action for action in ACTIONS if action in given]
        if len(actions) != 1:
            raise WordError(f"PID_PROFILE needs one of {', '.join(ACTIONS)}")
        unit = self._heaters.units[one(command, given, "HEATER", self._heaters.units)]
        (action,) = actions
        name = given[action]
        if action == "GET_VALUES":
            return Immediate((self._report(unit),))
        if action == "REMOVE":
            return self._remove(unit, one(command, given, action, self._of.get(unit.key, {})))
        if unit.settings.kind != "pid":
            raise WordError(f"[{unit.name}] has no PID: its control is {unit.settings.kind}")
        if action == "LOAD":
            return self._load(call, given, unit, name)
        if action == "SET_VALUES":
            return self._use(call, given, unit, name, _gains(command, given))
        return self._save(unit, name)

    def _set_pid(self, call: Call) -> Reading:
        command = call.command
        given = call.parameters("HEATER", *GAINS)
        unit = self._heaters.units[one(command, given, "HEATER", self._heaters.units)]
        if unit.settings.kind != "pid":
            raise WordError(f"[{unit.name}] has no PID: its control is {unit.settings.kind}")
        gains = _gains(command, given)
        return Synchronized(lambda _: _control(unit, gains))

    def _remove(self, unit: Heater, name: str) -> Synchronized:
        def act(_: float) -> None:
            if (live := self._live) is None:
                return
            self._of[unit.key].pop(name, None)
            if live.drop_saved(f"{KIND} {unit.key} {name}"):
                live.say(f"profile {name} of {unit.key} was removed; SAVE_CONFIG removes it from the file")

        return Synchronized(act)

    def _load(self, call: Call, given: Mapping[str, str], unit: Heater, name: str) -> Reading:
        gains = self._find(unit, name)
        if gains is None and "DEFAULT" in given:
            name = given["DEFAULT"]
            gains = self._find(unit, name)
        if gains is None:
            names = [DEFAULT, *self._of.get(unit.key, {})]
            hint = nearest_or_all(name, names)
            raise WordError(f"PID_PROFILE: {unit.key} has no profile {quoted(name)}{hint}")
        return self._use(call, given, unit, name, gains)

    def _find(self, unit: Heater, name: str) -> PidGains | None:
        return unit.settings.gains if name == DEFAULT else self._of.get(unit.key, {}).get(name)

    def _use(
        self, call: Call, given: Mapping[str, str], unit: Heater, name: str, gains: PidGains
    ) -> Synchronized:
        keep = value(call.command, given, "KEEP_TARGET", 0.0) > 0
        self._check_room(unit, name)

        def act(_: float) -> None:
            if not keep:
                unit.set_target(0.0)
            _control(unit, gains)
            if name != DEFAULT:
                self.add(unit.key, name, gains)
            self._loaded[unit.key] = name

        return Synchronized(act)

    def _save(self, unit: Heater, name: str) -> Synchronized:
        if name == DEFAULT:
            raise WordError(f"'{DEFAULT}' is the section [{unit.name}] itself; choose another name")
        if " ".join(name.split()) != name or not name:
            raise WordError("SAVE= of PID_PROFILE needs a name without white space at its ends")
        self._check_room(unit, name)

        def act(_: float) -> None:
            controller, live = unit.controller, self._live
            if not isinstance(controller, Pid) or live is None:
                return
            self.add(unit.key, name, controller.gains)
            texts = {"control": "pid", **_texts(controller.gains)}
            for option, text in texts.items():
                live.save(f"{KIND} {unit.key} {name}", option, text)
            live.say(f"profile {name} of {unit.key} was saved; SAVE_CONFIG writes it")

        return Synchronized(act)

    def _check_room(self, unit: Heater, name: str) -> None:
        own = self._of.get(unit.key, {})
        if name not in own and len(own) >= PROFILES_MAX:
            raise WordError(f"{unit.key} has {PROFILES_MAX} profiles already; load one of them")

    def _report(self, unit: Heater) -> str:
        if not isinstance(unit.controller, Pid):
            return f"{unit.key} is not controlled by PID"
        values = " ".join(f"{option}: {text}" for option, text in _texts(unit.controller.gains).items())
        return f"{unit.key} has profile {self._loaded.get(unit.key, DEFAULT)}: {values}"


def _gains(command: Command, given: Mapping[str, str]) -> PidGains:
    gains = PidGains(*(value(command, given, letter) for letter in GAINS))
    if min(gains.kp, gains.ki, gains.kd) < 0:
        raise WordError(f"KP, KI and KD of {command.name} must not be below 0")
    return gains


def _control(unit: Heater, gains: PidGains) -> None:
    """Control UNIT by other constants, without a jump of its power."""
    controller = unit.settings.by_pid(gains)
    if isinstance(unit.controller, Pid):
        controller.go_on_from(unit.controller)
    unit.use(controller)


def _texts(gains: PidGains) -> dict[str, str]:
    values = (("pid_kp", gains.kp), ("pid_ki", gains.ki), ("pid_kd", gains.kd))
    return {option: f"{number:.6g}" for option, number in values}


class PidProfile(Module):
    """One profile of one heater."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="PID constants of a heater for other circumstances: [pid_profile HEATER NAME], and PID_PROFILE"
        " LOAD=NAME HEATER=HEATER",
        options=(CONTROL, PID_KP, PID_KI, PID_KD, PID_TARGET),
        unsupported=("pid_version", "pid_tolerance", "smooth_time"),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.get(CONTROL)
        build.find(PID_TARGET)
        self._gains = PidGains(*(build.get(option) for option in (PID_KP, PID_KI, PID_KD)))
        self._place = build.place
        self._heater, _, self._profile = build.instance.partition(" ")
        self._profiles = build.shared(PidProfiles)

    def link(self, modules: Modules) -> None:
        """Find its heater."""
        del modules
        name = self._profile.strip()
        unit = self._profiles.heater(self._heater)
        if unit is None or not name or name == DEFAULT:
            raise ConfigError(
                self._place,
                f"[{self.name}] must be named after a heater and itself, as in [pid_profile extruder fast];"
                f" {shown(self._heater)} and {shown(name)} are not that",
            )
        self._profiles.add(unit.key, name, self._gains)
