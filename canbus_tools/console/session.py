"""A session of the console: carries out what is typed, and shows what the node says."""

import asyncio
import json
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Final

from canbus_tools.bus.talk import NodeTalk
from canbus_tools.console.expressions import Quantity, evaluate, is_name, names_in
from canbus_tools.console.parser import (
    OWN,
    Command,
    ConsoleError,
    NodeCommand,
    OwnCommand,
    answer_to,
    frequency_hz,
    may_repeat,
    names_wanted,
    read_duration_s,
    read_line,
    read_repeat,
    values_of,
)
from canbus_tools.protocol.decoded import MessageShape
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message

NAMES_MAX: Final = 1000
LIST_MAX: Final = 200
"""Lines that /list shows of one kind."""
ONLY_ONCE_S: Final = 1.5
"""How long the answer to a command is waited for that must not be sent twice."""
_CLOCKS: Final = (("get_uptime", "uptime"), ("get_clock", "clock"))
_COUNTERS: Final = (
    *("commands_sent", "blocks_sent", "bytes_sent", "blocks_repeated", "naks", "timeouts"),
    *("blocks_received", "bytes_received", "bytes_invalid"),
)
_PER_S: Final = 1_000_000_000


class Quit(Exception):  # noqa: N818 (no failure)
    """The session is to end."""


class Session:
    """Executes lines on a connection to a node; SAY receives each line of output.

    With AS_JSON each message is one JSON object in a line. Use from one event loop.
    """

    def __init__(self, talk: NodeTalk, say: Callable[[str], None], *, as_json: bool = False) -> None:
        self.talk = talk
        self.names: dict[str, Quantity] = {}
        self.commands = 0
        """Sent to the node."""
        self.messages = 0
        """Shown."""
        self._say = say
        self._unsaid: OSError | None = None
        """Why a message could not be shown; raised by ``run``, as nobody catches it where messages come."""
        self._as_json = as_json
        self._shapes: dict[str, MessageShape] = {}
        self._hidden: set[str] = set()
        self._own_question = ""
        self._asked = ""
        freq_hz = frequency_hz(self.dictionary)
        if freq_hz is not None:
            self.names["freq"] = Quantity(Fraction(freq_hz))
        self.close = talk.on_message(self._came)

    @property
    def dictionary(self) -> Dictionary:
        """The node's."""
        return self.talk.dictionary

    def known_names(self) -> list[str]:
        """Return all names that expressions can use."""
        return sorted({"clock", *self.names})

    async def run(self, text: str) -> None:
        """Carry out one line; raises CanductorError, Quit, and OSError when output cannot be written."""
        command = read_line(text)
        if command is not None:
            await self._run(command)
        if self._unsaid is not None:
            raise self._unsaid

    async def _run(self, command: Command) -> None:
        if isinstance(command, OwnCommand):
            await self._run_own(command)
            return
        names = await self._with_clock(names_wanted(self.dictionary, command))
        values = values_of(self.dictionary, command, names)
        self.commands += 1
        answer = answer_to(self.dictionary, command.name)
        self._asked = _text_of(command)
        try:
            if answer is None:
                self.talk.link.send(self.talk.encode(command.name, values))
                await self.talk.drained()
            elif may_repeat(command.name):
                await self.talk.ask(command.name, answer, values)
            else:
                await self.talk.ask(command.name, answer, values, tries=1, timeout_s=ONLY_ONCE_S)
        finally:
            self._asked = ""

    # ---------------------------------------------------------------------------------------------- messages

    def _came(self, message: Message, received_ns: int) -> None:
        unasked = message.name == self._own_question or (not self._asked and message.name in self._hidden)
        if unasked:
            return
        self.messages += 1
        try:
            self._show_message(message, received_ns)
        except OSError as error:
            self._unsaid = error

    def _show_message(self, message: Message, received_ns: int) -> None:
        text = self._text(message)
        if not self._as_json:
            self._say(text)
            return
        params = {name: v.hex() if isinstance(v, bytes) else v for name, v in message.params.items()}
        asked = (
            self._asked if answer_to(self.dictionary, self._asked.partition(" ")[0]) == message.name else None
        )
        self._say_json(message=message.name, params=params, text=text, host_ns=received_ns, asked=asked)

    def _text(self, message: Message) -> str:
        format_ = self.dictionary.responses.get(message.name)
        if format_ is None:
            said = message.params.get("text", b"")
            text = said.decode(errors="backslashreplace") if isinstance(said, bytes) else str(said)
            return f"{message.name} {text if text.isprintable() else ascii(text)}"
        if message.name not in self._shapes:
            self._shapes[message.name] = MessageShape(format_, self.dictionary)
        return self._shapes[message.name].text(list(message.params.values()))

    def _show(self, text: str, **values: object) -> None:
        if self._as_json:
            self._say_json(**values)
        else:
            self._say(text)

    def _say_json(self, **values: object) -> None:
        self._say(json.dumps({key: value for key, value in values.items() if value is not None}))

    # ------------------------------------------------------------------------------------------------ clocks

    async def _with_clock(self, wanted: set[str]) -> Mapping[str, Quantity]:
        if "clock" not in wanted or "clock" in self.names:
            return self.names
        return {**self.names, "clock": Quantity.clock(await self._clock())}

    async def _clock(self) -> int:
        """Return the node's clock now: what it said, and the time since, to half a round trip."""
        freq_hz = frequency_hz(self.dictionary)
        known = next(((ask, says) for ask, says in _CLOCKS if self.talk.knows(ask, says)), None)
        if known is None or freq_hz is None:
            raise ConsoleError("the node's firmware does not report its clock, so 'clock' has no value")
        self._own_question = known[1]
        try:
            answer = await self.talk.ask(*known)
        finally:
            self._own_question = ""
        read_ns = (answer.sent_ns + answer.received_ns) // 2 if answer.sent_ns else answer.received_ns
        ticks = answer.message.integer("clock")
        if "high" in answer.message.params:
            ticks += answer.message.integer("high") << 32
        return ticks + (round(asyncio.get_running_loop().time() * _PER_S) - read_ns) * freq_hz // _PER_S

    # ---------------------------------------------------------------------------------------- own commands

    async def _run_own(self, command: OwnCommand) -> None:
        rest = command.rest
        if command.name == "/quit":
            raise Quit
        if command.name == "/delay":
            await asyncio.sleep(read_duration_s(rest))
        elif command.name == "/repeat":
            await self._repeat(rest)
        elif command.name == "/set":
            await self._set(rest)
        elif command.name == "/eval":
            value = await self._evaluate(rest)
            self._show(_shown(value), expression=rest, value=value.whole(), exact=str(value.value))
        elif command.name == "/hide":
            self._hide(rest.split())
        elif command.name == "/stats":
            self._stats()
        elif command.name == "/list":
            self._list(rest)
        else:
            self._help()

    async def _repeat(self, rest: str) -> None:
        times, interval_s, text = read_repeat(rest)
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        for n in range(times):
            await asyncio.sleep(max(0.0, begun_s + n * interval_s - loop.time()))
            await self.run(text)

    async def _evaluate(self, text: str) -> Quantity:
        names = await self._with_clock(names_in(text))
        return evaluate(text, names, frequency_hz(self.dictionary))

    async def _set(self, rest: str) -> None:
        name, _, expression = rest.partition(" ")
        if not name:
            shown = {name: value.whole() for name, value in sorted(self.names.items())}
            self._show("\n".join(f"{name} = {value}" for name, value in shown.items()), names=shown)
            return
        expression = expression.strip().removeprefix("=").strip()
        if not is_name(name) or name == "clock" or not expression:
            raise ConsoleError("/set takes a name of letters and digits (not clock) and an expression")
        if len(self.names) >= NAMES_MAX and name not in self.names:
            raise ConsoleError(f"there are {NAMES_MAX} names already")
        self.names[name] = await self._evaluate(expression)

    def _hide(self, names: list[str]) -> None:
        unknown = [name for name in names if name not in self.dictionary.responses]
        if unknown:
            raise ConsoleError(f"the node's firmware has no response '{unknown[0]}'; /list shows all")
        self._hidden = self._hidden | set(names) if names else set()

    def _stats(self) -> None:
        stats = self.talk.stats
        self._show(
            f"sent {stats.commands_sent} commands in {stats.blocks_sent} blocks ({stats.bytes_sent} bytes); "
            f"{stats.blocks_repeated} blocks repeated, {stats.naks} naks, {stats.timeouts} timeouts\n"
            f"received {stats.blocks_received} blocks ({stats.bytes_received} bytes); "
            f"{stats.bytes_invalid} bytes invalid, {self.talk.undecodable} responses unknown\n"
            f"round trip {stats.srtt_s * 1000:.2f} ms, spread {stats.rttvar_s * 1000:.2f} ms",
            stats={name: getattr(stats, name) for name in _COUNTERS}
            | {
                "undecodable": self.talk.undecodable,
                "round_trip_s": stats.srtt_s,
                "round_trip_spread_s": stats.rttvar_s,
            },
        )

    def _list(self, part: str) -> None:
        words = self.dictionary
        found = {
            "commands": [f.text for f in words.commands.values() if part in f.name],
            "responses": [f.text for f in words.responses.values() if part in f.name],
            "enumerations": [
                f"{e.name}: {', '.join(list(e.values)[:12])}{', …' if len(e.values) > 12 else ''}"
                for e in words.enumerations.values()
                if part in e.name
            ],
            "constants": [f"{name} = {value}" for name, value in words.constants.items() if part in name],
        }
        lines: list[str] = []
        for kind, texts in found.items():
            if texts:
                lines += [f"{kind}:", *(f"  {text}" for text in sorted(texts)[:LIST_MAX])]
        self._show("\n".join(lines) or f"nothing is called like '{part}'", **found)

    def _help(self) -> None:
        rows = [(f"{name} {takes}".strip(), does) for name, (takes, does) in OWN.items()]
        width = max(len(row[0]) for row in rows)
        lines = [f"{left:{width}}  {right}" for left, right in rows]
        self._show(
            "\n".join(
                (
                    "command parameter=value …   send it to the node; Tab completes, /list shows all",
                    'values: numbers, names of the parameter\'s enumeration, hex digits or "text" for bytes,',
                    "  and arithmetic: clock+50ms, 3*freq/1000, max(100us, 2*n)",
                    *lines,
                )
            ),
            help=[f"{left}: {right}" for left, right in rows],
        )


def _text_of(command: NodeCommand) -> str:
    return " ".join((command.name, *(f"{name}={text}" for name, text in command.args.items())))


def _shown(value: Quantity) -> str:
    whole = value.whole()
    if value.value.denominator != 1:
        return f"{float(value.value):.9g}, sent as {whole}"
    if value.clocks == 1 and not 0 <= whole < 1 << 32:
        return f"{whole}, sent as {whole % (1 << 32)}"
    return str(whole) if abs(whole) < 10 else f"{whole} (0x{whole:x})"
