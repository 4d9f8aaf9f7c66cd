"""[input_shaper]: which resonance each axis is shaped against."""

from dataclasses import dataclass

from coordinator.config.model import ShaperDescription
from coordinator.config.options import BadValue, FloatOption, Option, SectionReader, SectionSpec, one_of
from coordinator.config.sections.reading import Reading
from coordinator.motion.steps.shapers import SHAPER_KINDS, check_reach, split_kind

MAX_FREQUENCY_HZ = 1000.0
AXES = "xyz"


@dataclass(frozen=True, slots=True, kw_only=True)
class ShaperOption(Option[str]):
    """A kind of shaper, those with ei perhaps with their tolerance."""

    def parse(self, text: str) -> str:
        """Return it in lower case."""
        try:
            split_kind(text.lower())
        except ValueError:
            raise BadValue from None
        return text.lower()

    def rule(self) -> str:
        """Return the values allowed."""
        return f"{one_of(SHAPER_KINDS)}, those with ei also as in ei(v_tol=0.05)"

    def stand_in(self) -> str:
        """Return the usual one."""
        return "mzv"


SHAPER_TYPE = ShaperOption(name="shaper_type", help="shaper of every axis", default="mzv")
AXIS_TYPES = tuple(
    ShaperOption(name=f"shaper_type_{axis}", help=f"shaper of {axis.upper()}; by default shaper_type")
    for axis in AXES
)
FREQUENCIES = tuple(
    FloatOption(
        name=f"shaper_freq_{axis}",
        help=f"resonance of {axis.upper()}; 0: not shaped",
        default=0.0,
        unit="Hz",
        minimum=0,
        maximum=MAX_FREQUENCY_HZ,
    )
    for axis in AXES
)
DAMPING_RATIOS = tuple(
    FloatOption(
        name=f"damping_ratio_{axis}",
        help=f"damping of {axis.upper()}'s resonance, as a share of the critical one",
        default=0.1,
        minimum=0,
        below=1,
    )
    for axis in AXES
)
INPUT_SHAPER = SectionSpec(
    help="How moves are shaped so that they do not excite the machine's resonances",
    options=(SHAPER_TYPE, *AXIS_TYPES, *FREQUENCIES, *DAMPING_RATIOS),
)
MIN_FREQUENCY_HZ = 1.0
"""A shaper is up to two periods long, and all motion is held back by half of that."""


def read_shapers(reading: Reading) -> tuple[ShaperDescription, ...]:
    """Return the shaped axes; raises ConfigError."""
    section = reading.find("input_shaper")
    if section is None:
        return ()
    reader = SectionReader(section, INPUT_SHAPER)
    every = reader.get(SHAPER_TYPE)
    shapers = []
    for axis, kind, frequency, damping in zip(AXES, AXIS_TYPES, FREQUENCIES, DAMPING_RATIOS, strict=True):
        own, hz, ratio = reader.get_or(kind, every), reader.get(frequency), reader.get(damping)
        if 0 < hz < MIN_FREQUENCY_HZ:
            raise reader.bad(frequency, f"must be 0 (not shaped) or at least {MIN_FREQUENCY_HZ:g} Hz")
        if hz:
            try:
                check_reach(own, hz, ratio)
            except ValueError as problem:
                raise reader.bad(frequency, f"is too low: {problem}") from None
            shapers.append(ShaperDescription(axis, own, hz, ratio, reader.place_of(frequency)))
    reading.finish(reader)
    return tuple(shapers)
