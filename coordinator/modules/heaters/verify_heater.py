"""[verify_heater NAME]: limits of the check that a heater heats."""

from typing import ClassVar, Final

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.options import FloatOption, SectionSpec
from coordinator.heat.verify import VerifyOptions, default_options
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.support.quoting import nearest_or_all

MAX_ERROR: Final = FloatOption(
    name="max_error",
    help="how much K·s below the range of the target may add up before the machine is stopped",
    default=120.0,
    unit="K·s",
    minimum=0,
    maximum=1e9,
)
CHECK_GAIN_TIME: Final = FloatOption(
    name="check_gain_time",
    help="while heating up, the temperature has to rise by heating_gain in every such time; by default 20 s,"
    " and 60 s for heater_bed",
    unit="s",
    minimum=1,
    maximum=1e9,
)
HYSTERESIS: Final = FloatOption(
    name="hysteresis",
    help="range around the target",
    default=5.0,
    unit="K",
    minimum=0,
    maximum=500,
)
HEATING_GAIN: Final = FloatOption(
    name="heating_gain",
    help="by how much the temperature has to rise in check_gain_time",
    default=2.0,
    unit="K",
    above=0,
    maximum=500,
)


class VerifyHeater(Module):
    """The limits of the heater that the section is named after."""

    NAMED: ClassVar = True
    SPEC: ClassVar = SectionSpec(
        help="Limits of the check that a heater (extruder, heater_bed or the name of a heater_generic) heats;"
        " every heater is checked, the section only changes the limits",
        options=(MAX_ERROR, CHECK_GAIN_TIME, HYSTERESIS, HEATING_GAIN),
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.place = build.place
        self.heater = build.instance
        self.options = VerifyOptions(
            max_error_ks=build.get(MAX_ERROR),
            check_gain_s=build.get_or(CHECK_GAIN_TIME, default_options(self.heater).check_gain_s),
            hysteresis_k=build.get(HYSTERESIS),
            heating_gain_k=build.get(HEATING_GAIN),
        )

    def link(self, modules: Modules) -> None:
        """Hand the options to the heater; raises ConfigError when there is none of that name."""
        heaters = modules.find("heaters", HeaterRegistry)
        known = () if heaters is None else tuple(heaters.units)
        if self.heater not in known:
            if modules.is_left_out(self.heater):
                raise NotSupported(self.place, f"the heater {self.heater} is not supported yet")
            hint = nearest_or_all(self.heater, known)
            raise ConfigError(self.place, f"[{self.name}] refers to an unknown heater{hint}")
        assert heaters is not None
        heaters.units[self.heater].watch(self.options)
