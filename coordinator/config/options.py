"""Typed options: each states unit, bounds, default and purpose once, for reading and for the reference page.

A section's options are listed in its SectionSpec and read by a SectionReader: ``reader.get(MAX_VELOCITY)``.
What the specification does not know is a mistake of the user; what belongs to a module not built yet is
handed back.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from coordinator.config.errors import ConfigError, NotSupported, Place
from coordinator.config.file import RawOption, RawSection
from coordinator.support.quoting import nearest, nearest_or_all, shown
from nodes.support.numbers import read_decimal, read_int

T = TypeVar("T")
_TRUE = ("1", "yes", "true", "on")
_FALSE = ("0", "no", "false", "off")


class NotBuilt(ValueError):  # noqa: N818 (no mistake)
    """The text is a value of the option that nothing of ours acts on yet."""


class BadValue(ValueError):  # noqa: N818 (the answer of a parser, not a failure of ours)
    """The text is no value of the option; the argument says why where the rule alone does not."""


def parse_decimal(text: str) -> float:
    """Return the number TEXT, white space around it aside, neither infinite nor NaN; raises BadValue."""
    value = read_decimal(text.strip())
    if value is None:
        raise BadValue
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Option(Generic[T]):
    """One option of a section."""

    name: str
    help: str
    """One sentence for the reference page, without a full stop."""
    default: T | None = None
    """None: the option is required, or the section computes the default (said in help)."""
    unit: str = ""

    def parse(self, text: str) -> T:
        """Return the value of a text; raises BadValue."""
        raise NotImplementedError

    def rule(self) -> str:
        """Return the values allowed, to follow "must be"."""
        raise NotImplementedError

    def stand_in(self) -> T:
        """Return any value that is allowed, to go on with after a mistake."""
        raise NotImplementedError

    def setting(self, text: str, value: T) -> object:
        """Return what macros see of VALUE, which TEXT was read as."""
        del text
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bounded(Option[T]):
    """Bounds common to the numeric kinds."""

    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    below: float | None = None

    def _rule(self, noun: str) -> str:
        bounds = [
            f"{word} {bound:.15g}"
            for word, bound in (
                ("above", self.above),
                ("at least", self.minimum),
                ("below", self.below),
                ("at most", self.maximum),
            )
            if bound is not None
        ]
        unit = f" in {self.unit}" if self.unit else ""
        return f"{noun}{unit}" + (f", {' and '.join(bounds)}" if bounds else "")

    def _check(self, value: float) -> None:
        inside = (
            (self.minimum is None or value >= self.minimum)
            and (self.maximum is None or value <= self.maximum)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )
        if not inside:
            raise BadValue

    def _any(self) -> float:
        bounds = [b for b in (self.minimum, self.maximum, self.above, self.below) if b is not None]
        near = [*bounds, *(b + 1 for b in bounds), *(b - 1 for b in bounds), sum(bounds) / (len(bounds) or 1)]
        for value in (1.0, 0.0, *near):
            try:
                self._check(value)
            except BadValue:
                continue
            return value
        raise AssertionError(self.name)


@dataclass(frozen=True, slots=True, kw_only=True)
class FloatOption(_Bounded[float]):
    """A decimal number."""

    def parse(self, text: str) -> float:
        """Return the number; neither infinite nor NaN."""
        value = parse_decimal(text)
        self._check(value)
        return value

    def rule(self) -> str:
        """Return the values allowed."""
        return self._rule("a number")

    def stand_in(self) -> float:
        """Return any number that is allowed."""
        return self._any()


@dataclass(frozen=True, slots=True, kw_only=True)
class IntOption(_Bounded[int]):
    """A whole number."""

    multiple_of: int = 1

    def parse(self, text: str) -> int:
        """Return the number."""
        value = read_int(text)
        if value is None:
            raise BadValue
        self._check(value)
        if value % self.multiple_of:
            raise BadValue
        return value

    def rule(self) -> str:
        """Return the values allowed."""
        return self._rule("a whole number" if self.multiple_of == 1 else f"a multiple of {self.multiple_of}")

    def stand_in(self) -> int:
        """Return any number that is allowed, but for ``multiple_of``."""
        return int(self._any())


@dataclass(frozen=True, slots=True, kw_only=True)
class BoolOption(Option[bool]):
    """A truth value."""

    def parse(self, text: str) -> bool:
        """Return the truth value."""
        if text.lower() not in _TRUE + _FALSE:
            raise BadValue
        return text.lower() in _TRUE

    def rule(self) -> str:
        """Return the values allowed."""
        return "True or False"

    def stand_in(self) -> bool:
        """Return one of both."""
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceOption(Option[str]):
    """One word of several, in capitals or not."""

    choices: tuple[str, ...]
    unsupported: tuple[str, ...] = ()
    """Words known from other hosts that are not supported yet."""

    def parse(self, text: str) -> str:
        """Return the word as it stands among the choices."""
        if text.lower() in (word.lower() for word in self.unsupported):
            raise NotBuilt
        for word in self.choices:
            if word.lower() == text.lower():
                return word
        raise BadValue

    def rule(self) -> str:
        """Return the values allowed."""
        return one_of(self.choices)

    def stand_in(self) -> str:
        """Return the first."""
        return self.choices[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class TextOption(Option[str]):
    """A line of text, by a pattern if one is given."""

    pattern: str = r".+"
    pattern_rule: str = "a line of text"

    def parse(self, text: str) -> str:
        """Return the text."""
        if not re.fullmatch(self.pattern, text):
            raise BadValue
        return text

    def rule(self) -> str:
        """Return the values allowed."""
        return self.pattern_rule

    def stand_in(self) -> str:
        """Return no text."""
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class GCodeOption(Option[str]):
    """Lines of g-code, or a template that makes them; also none."""

    def parse(self, text: str) -> str:
        """Return the text."""
        return text

    def rule(self) -> str:
        """Return the values allowed."""
        return "lines of g-code, indented"

    def stand_in(self) -> str:
        """Return none."""
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ListOption(Option[tuple[str, ...]]):
    """Words separated by commas or line ends."""

    may_be_empty: bool = False
    """Whether an option without any word is an empty list; else it is a mistake."""

    def parse(self, text: str) -> tuple[str, ...]:
        """Return the words without outer white space; a comma at the end is allowed."""
        words = tuple(word.strip() for word in text.replace("\n", ",").split(",") if word.strip())
        if not words and not self.may_be_empty:
            raise BadValue
        return words

    def rule(self) -> str:
        """Return the values allowed."""
        return "a list of words separated by commas" + (", or nothing" if self.may_be_empty else "")

    def stand_in(self) -> tuple[str, ...]:
        """Return none."""
        return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class GearRatioOption(Option[float]):
    """A chain of gears, ``50:10, 2:1``; the value is the motor's turns per turn of the output."""

    def parse(self, text: str) -> float:
        """Return the product of the ratios."""
        ratio = 1.0
        for pair in text.split(","):
            before, colon, behind = (part.strip() for part in pair.partition(":"))
            motor, output = read_decimal(before), read_decimal(behind)
            if not colon or motor is None or output is None:
                raise BadValue
            if not 1e-6 < motor < 1e6 or not 1e-6 < output < 1e6:
                raise BadValue
            ratio *= motor / output
        if not 1e-6 <= ratio <= 1e6:
            raise BadValue
        return ratio

    def rule(self) -> str:
        """Return the values allowed."""
        return "pairs of teeth as in 50:10 or 50:17, 3:1 (motor first)"

    def stand_in(self) -> float:
        """Return no gear."""
        return 1.0

    def setting(self, text: str, value: float) -> object:
        """Return the pairs of teeth."""
        del value
        return [[float(teeth) for teeth in pair.split(":")] for pair in text.split(",") if pair.strip()]


def one_of(words: Sequence[str]) -> str:
    """Join words as in "a, b or c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


@dataclass(frozen=True, slots=True)
class SectionSpec:
    """All a section may contain; the reference page is made from it."""

    help: str
    options: tuple[Option[Any], ...]
    unsupported: tuple[str, ...] = ()
    """Options of modules that are not supported yet: recognised, recorded, not acting."""
    elsewhere: tuple[str, ...] = ()
    """Options that another specification of the same section has."""
    family: Option[Any] | None = None
    """Stands for all options whose names begin with its own, which ends in ``_``."""


@dataclass(slots=True)
class SectionReader:
    """Reads one section by its specification and remembers what was read.

    Construction raises ConfigError for an option that the specification does not know.
    """

    section: RawSection
    spec: SectionSpec
    whole: bool = field(default=True, kw_only=True)
    """Whether the specification covers the section; else other options are another reader's."""
    _read: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if not self.whole:
            return
        spec = self.spec
        valid = (*(option.name for option in spec.options), *spec.unsupported, *spec.elsewhere)
        for raw in self.section.options.values():
            if raw.name not in valid and not self._of_family(raw.name):
                hint = nearest(raw.name, valid, pattern="'{}'")
                self.section.misspelt |= bool(hint)
                hint = hint or "; remove it or correct its name"
                error = ConfigError(raw.place, f"[{self.name}] has no option {shown(raw.name)}{hint}")
                self.section.report(error)
                self._read.add(raw.name)

    @property
    def name(self) -> str:
        """The section's full name."""
        return self.section.name

    @property
    def place(self) -> Place:
        """The line of the section's header."""
        return self.section.place

    def _of_family(self, name: str) -> bool:
        family = self.spec.family
        return family is not None and name.startswith(family.name) and name != family.name

    def family(self) -> dict[str, RawOption]:
        """Return the options of the specification's family, by what follows its name."""
        family = self.spec.family
        assert family is not None
        found = {name: raw for name, raw in self.section.options.items() if self._of_family(name)}
        self._read.update(found)
        return {name.removeprefix(family.name): raw for name, raw in found.items()}

    def has(self, option: Option[T]) -> bool:
        """Return whether the user gave the option; does not count as reading it."""
        return option.name in self.section.options

    def place_of(self, option: Option[T]) -> Place:
        """Return the line of an option, or of the section when the option is absent."""
        return self.section.options[option.name].place if self.has(option) else self.place

    def find(self, option: Option[T]) -> T | None:
        """Return the value, or None when the option is absent; raises ConfigError for a bad value."""
        own = self.spec.options
        assert any(known is option for known in own) or option in own, option.name
        self._read.add(option.name)
        raw = self.section.options.get(option.name)
        if raw is None:
            return None
        try:
            value = option.parse(raw.value)
            self.section.used[option.name] = option.setting(raw.value, value)
        except NotBuilt:
            raise NotSupported(
                raw.place,
                f"option '{option.name}' of [{self.name}] is {shown(raw.value)}, which is recognised but not"
                " built yet",
            ) from None
        except BadValue as error:
            problem = self.bad(option, str(error) if error.args else f"must be {option.rule()}")
        else:
            return value
        self.section.report(problem)
        self.section.stands_in = True
        return option.default if option.default is not None else option.stand_in()

    def get(self, option: Option[T]) -> T:
        """Return the value or the default; raises ConfigError when a required option is absent."""
        value = self.find(option)
        if value is None and option.default is not None:
            value = option.default
            self.section.used[option.name] = option.setting("", value)
        if value is not None:
            return value
        if not (self.section.is_set_aside or option.name in self.section.set_aside):
            lack = f"[{self.name}] lacks option '{option.name}', {option.rule()}: {option.help}"
            self.section.report(ConfigError(self.place, lack))
        self.section.stands_in = True
        return option.stand_in()

    def get_or(self, option: Option[T], default: T) -> T:
        """Return the value, or the DEFAULT that the section computes; raises ConfigError for a bad value."""
        value = self.find(option)
        if value is not None:
            return value
        self.show_default(option, default)
        return default

    def show_default(self, option: Option[T], default: T) -> None:
        """Have macros see DEFAULT as the value of an option that is absent."""
        if not self.has(option):
            self.section.used[option.name] = option.setting("", default)

    def bad(self, option: Option[T], sentence: str) -> ConfigError:
        """Return the error for a value; the sentence continues after "option 'x' of [y] is 'z', "."""
        raw = self.section.options.get(option.name)
        given = f" is {shown(raw.value)}," if raw else ""
        return ConfigError(
            self.place_of(option), f"option '{option.name}' of [{self.name}]{given} {sentence}"
        )

    def unknown(
        self, option: Option[Any], name: str, known: Iterable[str], pattern: str = "{}"
    ) -> ConfigError:
        """Return the error for an option that names NAME, which is none of KNOWN."""
        hint = nearest_or_all(name, known, pattern=pattern)
        sentence = f"'{option.name}' of [{self.name}] names {shown(name)}, which does not exist{hint}"
        return ConfigError(self.place_of(option), sentence)

    def finish(self) -> tuple[RawOption, ...]:
        """Return the options that wait for their module; raises ConfigError for one of no use here."""
        own = {option.name for option in self.spec.options}
        unread = [
            option
            for name, option in self.section.options.items()
            if name not in self._read and name not in self.spec.elsewhere and (self.whole or name in own)
        ]
        for option in unread:
            if option.name not in self.spec.unsupported and not self.section.misspelt:
                self.section.report(
                    ConfigError(
                        option.place,
                        f"option '{option.name}' of [{self.name}] has no effect with the others; remove it",
                    )
                )
        return tuple(unread)
