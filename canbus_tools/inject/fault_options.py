"""Faults as users write them: ``--loss 1%,id=0x109``, ``--bus-off 2s,at=5,sender=toolhead``.

The first word is a share of frames or a duration; KEY=VALUE pairs after it select frames, clients and times.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from nodes.support.errors import CanductorError
from nodes.support.option_values import Help, UsageError, parse_float, parse_hex, parse_int, parse_ratio
from nodes.virtual.faults import CLIENTS, ID_MAX, TIME_S_MAX, BusFault, BusFaultKind

_KINDS: Final = {
    "loss": (
        BusFaultKind.LOSE,
        "SHARE",
        "frames do not arrive, or not at the receiver, although the sender sees them acknowledged",
    ),
    "corrupt": (BusFaultKind.CORRUPT, "SHARE", "receivers get frames with one bit of the data changed"),
    "duplicate": (BusFaultKind.DUPLICATE, "SHARE", "frames arrive twice, as when an acknowledgement is lost"),
    "error": (BusFaultKind.ERROR, "SHARE", "frames are destroyed by an error frame and sent again"),
    "delay": (BusFaultKind.DELAY, "TIME", "frames arrive later, in the order of each sender"),
    "bus-off": (BusFaultKind.BUS_OFF, "TIME", "a client goes bus-off for this long, at a time or by share"),
}
UNITS_S: Final = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0}
EXPLAINED: Final = """faults:
  Each may be given several times, up to 32 in all. SHARE is a ratio or percentage of the frames that the
  fault selects (0.01, 1%), TIME a number with a unit (300us, 5ms, 2s; without one: seconds). These may
  follow, separated by commas:
    id=ID[/MASK]   selects frames with this id; a mask says which bits count (id=0x101/0x701: all from nodes)
    sender=CLIENT  selects frames of one client: the name of a node started here, or a number: clients count
                   from 0 in the order in which they connect, nodes started here first
    receiver=CLIENT  affects only this client (loss, corrupt)
    frame=N        instead of a share: affects the N-th selected frame of each sender
    from=S until=S   selects frames in this time, in seconds since the bus was ready
    share=SHARE    delay, bus-off: of the selected frames (a delay affects all by default)
    jitter=TIME    delay: up to this much more, evenly distributed
    at=S           bus-off: at this time; sender= says which client (default: all)
  The same --seed affects the same frames of every sender."""


class _RawHelp(Help, argparse.RawDescriptionHelpFormatter):
    """Keeps the line breaks of the explanation."""


def declare_faults(command: argparse.ArgumentParser) -> None:
    """Add an option for every kind of fault."""
    group = command.add_argument_group("faults (explained below)")
    for name, (_, metavar, meaning) in _KINDS.items():
        group.add_argument(f"--{name}", action="append", default=[], metavar=f"{metavar},…", help=meaning)
    command.formatter_class = _RawHelp
    command.epilog = EXPLAINED


def read_faults(given: argparse.Namespace, names: Mapping[str, int]) -> list[tuple[str, BusFault]]:
    """Return the faults with their options as text; NAMES: places of clients. Raises UsageError."""
    return [
        (f"{name} {text}", read_fault(name, text, names))
        for name in _KINDS
        for text in getattr(given, name.replace("-", "_"))
    ]


def read_fault(name: str, text: str, names: Mapping[str, int]) -> BusFault:
    """Return the fault of ``--NAME TEXT``; raises UsageError."""
    option = f"--{name}"
    first, *rest = text.split(",")
    if "=" in first:
        first, rest = "", [first, *rest]
    reader = _Reader(option, names)
    for pair in rest:
        key, equals, value = pair.partition("=")
        if not equals or key not in _KEYS:
            raise UsageError(f"{option} has '{pair}', must be one of {', '.join(f'{k}=' for k in _KEYS)}")
        if key in reader.fields:
            raise UsageError(f"{option} has {key}= twice")
        reader.fields[key] = _KEYS[key](reader, value)
    return reader.fault(_KINDS[name][0], first)


class _Reader:
    """Collects the parts of one fault."""

    def __init__(self, option: str, names: Mapping[str, int]) -> None:
        self.option = option
        self.fields: dict[str, Any] = {}
        self._names = names

    def fault(self, kind: BusFaultKind, first: str) -> BusFault:
        """Put the fault together."""
        timed = kind in (BusFaultKind.DELAY, BusFaultKind.BUS_OFF)
        self._check_keys(kind)
        if not first and (timed or "frame" not in self.fields):
            raise UsageError(
                f"{self.option} needs {'a time' if timed else 'a share'} first, as in {_EXAMPLES[kind]}"
            )
        if timed:
            self.fields["time"] = self.time(first)
        elif first:
            self.fields["share"] = self.share(first)
        values = {
            _FIELDS.get(key, key): value for key, value in self.fields.items() if key not in ("id", "at")
        }
        can_id, mask = self.fields.get("id", (0, 0))
        try:
            fault = BusFault(kind=kind, can_id=can_id, mask=mask, **values)
            if "at" in self.fields:
                fault = replace(fault, timed=True, from_s=self.fields["at"])
        except CanductorError as error:
            raise UsageError(f"{self.option}: {error}") from error
        return fault

    def _check_keys(self, kind: BusFaultKind) -> None:
        only = {
            "jitter": (BusFaultKind.DELAY,),
            "at": (BusFaultKind.BUS_OFF,),
            "share": (BusFaultKind.DELAY, BusFaultKind.BUS_OFF),
        }
        for key, kinds in only.items():
            if key in self.fields and kind not in kinds:
                raise UsageError(f"{self.option} has no {key}=")
        if "at" in self.fields and self.fields.keys() - {"at", "sender"}:
            raise UsageError(f"{self.option} with at= takes no other key than sender=")
        if kind is BusFaultKind.BUS_OFF and not self.fields.keys() & {"at", "share", "frame"}:
            raise UsageError(f"{self.option} needs at=SECONDS, share= or frame= to know when")

    def share(self, text: str) -> float:
        return parse_ratio(text, 1.0, name=self.option)

    def seconds(self, text: str) -> float:
        return parse_float(text, 0, TIME_S_MAX, "s", name=self.option)

    def time(self, text: str) -> float:
        digits = text.rstrip("abcdefghijklmnopqrstuvwxyz")
        unit = text[len(digits) :]
        if unit not in UNITS_S:
            raise UsageError(f"{self.option} is '{text}', must be a number with the unit us, ms or s")
        return parse_float(digits, 0, TIME_S_MAX, unit, name=self.option) * UNITS_S[unit]

    def frame(self, text: str) -> int:
        return parse_int(text, 1, name=f"{self.option}'s frame")

    def place(self, text: str) -> int:
        if text in self._names:
            return self._names[text]
        if not text.isdecimal() and self._names:
            raise UsageError(f"{self.option}: unknown node '{text}'; the nodes are {', '.join(self._names)}")
        return parse_int(text, 0, CLIENTS - 1, name=f"{self.option}'s client")

    def id(self, text: str) -> tuple[int, int]:
        can_id, slash, mask = text.partition("/")
        return self._id(can_id), self._id(mask) if slash else ID_MAX

    def _id(self, text: str) -> int:
        return parse_hex(text, ID_MAX, name=f"{self.option}'s id")


_KEYS: Final[dict[str, Callable[[_Reader, str], Any]]] = {
    "id": _Reader.id,
    "sender": _Reader.place,
    "receiver": _Reader.place,
    "frame": _Reader.frame,
    "from": _Reader.seconds,
    "until": _Reader.seconds,
    "share": _Reader.share,
    "jitter": _Reader.time,
    "at": _Reader.seconds,
}
_FIELDS: Final = {
    "frame": "nth",
    "from": "from_s",
    "until": "until_s",
    "jitter": "jitter_s",
    "time": "time_s",
}
"""Fields of BusFault with other names than their keys."""
_EXAMPLES: Final = {
    BusFaultKind.LOSE: "--loss 1%,id=0x109",
    BusFaultKind.CORRUPT: "--corrupt 1%",
    BusFaultKind.DUPLICATE: "--duplicate 1%",
    BusFaultKind.ERROR: "--error 1%",
    BusFaultKind.DELAY: "--delay 5ms,jitter=2ms",
    BusFaultKind.BUS_OFF: "--bus-off 2s,at=5,sender=0",
}
