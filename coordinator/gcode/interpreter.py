"""Runs a G-code program: moves go the planner's hot path, other lines through tables of commands.

``Job`` does no I/O but reading its program, keeps no clock and never sleeps: the batch planner and the
real-time streamer drive the same ``step`` and act on its events (events.py).
"""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace

from coordinator.gcode.absent_commands import ABSENT
from coordinator.gcode.builtins import basic as basic_commands
from coordinator.gcode.builtins import machine as machine_commands
from coordinator.gcode.builtins import tuning
from coordinator.gcode.commands import (
    NO_WORDS,
    AtStandstill,
    BuiltIn,
    Call,
    GCodeCommand,
    Immediate,
    Lines,
    Phases,
    PrintControl,
    ProgramAction,
    ProgramContext,
    Reading,
    Synchronized,
    Vocabulary,
)
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import (
    Done,
    End,
    Event,
    Full,
    Idle,
    Notice,
    PositionSet,
    Progress,
    Reply,
    StandstillAction,
    Timed,
)
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.parser import Command, WordError, parse, quoted
from coordinator.gcode.program import Program
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.gcode.status import Figures, MotionStatus
from coordinator.motion.planner.language import READ_IN_C
from coordinator.motion.planner.planner import Feed, FeedStatus, Planner
from coordinator.support.bug_log import log_bug
from nodes.support.errors import CanductorError

QUOTE = "'"
MAX_NOTICES = 100
"""Different notices a job gives; a file of garbage must not flood the screen."""
MAX_DEPTH = 30
"""Commands that stand in for a command that stands in for a command ..."""
MAX_LINES = 100_000
"""Lines that take the place of one line of the program, with all those that take the place of these."""
LINES_AT_ONCE = 50
"""Lines, but for those read in C, after which ``step`` returns, event or not. One that others replace counts
as all of them: its template may have taken a while to be rendered."""
MAX_PLACES = 4
"""Of such commands that a message names all; of more, it names the outermost and the innermost one."""


@dataclass(slots=True)
class _Inner:
    """The lines that take a command's place; read one by one, they count as the line of that command."""

    name: str
    data: bytes
    start: int = 0
    """Of the line that comes next."""
    at: int = 0
    """Of the line that is being carried out."""
    where: Callable[[int], str] | None = None
    """Names the place of a line."""
    comes_before: bool = False
    """Whether they come before a line, which is read again then."""

    @property
    def place(self) -> str:
        """Where the line stands that is being carried out."""
        line = self.data.count(b"\n", 0, self.at) + 1
        return f"{self.name}:{line}" if self.where is None else self.where(line)

    def line_end(self) -> int:
        end = self.data.find(b"\n", self.start)
        return len(self.data) if end < 0 else end


@dataclass(slots=True)
class _Phase:
    """Readings that take a command's place, one after the other."""

    command: Command
    readings: Iterator[Reading]
    waiting: Reading | None = None
    """Which could not be followed yet: the planner was full."""

    @property
    def name(self) -> str:
        return self.command.name

    @property
    def place(self) -> str:
        return ""  # it has no lines of its own


class Job(ProgramContext):
    """One run of PROGRAM through PLANNER.

    HOMED_POSITION: where each axis (letter) stands after G28, mm; these are the axes that exist. VOCABULARY:
    what the machine's modules add.
    ``step`` raises GCodeError at a line that cannot be carried out, and again when called again; the moves
    before that line are still in the planner, to be flushed or dropped by the driver.
    """

    def __init__(
        self,
        program: Program,
        planner: Planner,
        homed_position: Mapping[str, float],
        machine: MachineState | None = None,
        vocabulary: Vocabulary = NO_WORDS,
        *,
        while_printing: bool = False,
        prints: PrintControl | None = None,
        strict: bool = False,
    ) -> None:
        self.program = program
        self.planner = planner
        self.machine = machine or MachineState()
        """What the program may change; it is changed in place."""
        self.vocabulary = vocabulary
        self.homed_position = dict(homed_position)
        self.while_printing = while_printing
        """Whether its lines come between those of a job that prints: then only some are carried out."""
        self.prints = prints
        """Has the jobs; None: there are none, this program is all there is."""
        self.strict = strict
        """Whether a line that moves, heats or levels and that nothing acts on is an error; else a notice."""
        self._breaks = False
        self._events: deque[Event] = deque()
        self._inner: list[_Inner | _Phase] = []
        self._inner_lines = 0
        """Done of those that take the place of the present line."""
        self._left = 0
        """Lines that the present ``step`` may still read."""
        self._action: StandstillAction | None = None
        self._over: Event | GCodeError | None = None
        self._noticed: set[str] = set()
        planner.forget_line()
        planner.leave_out(READ_IN_C if while_printing else vocabulary.commands)
        for set_up in vocabulary.set_ups:
            set_up(planner)
        machine_commands.begin(self)
        tuning.watch(self)

    @property
    def name(self) -> str:
        """What is being read."""
        return self.program.name

    @property
    def line(self) -> int:
        """Number of the line that comes next, or is being carried out."""
        return self.planner.lines + 1

    def step(self) -> Event:
        """Work until there is an event; at most one piece of the program (64 KiB), and LINES_AT_ONCE.

        Waits for input only where the program's source does (pipes, standard input).
        """
        self._left = LINES_AT_ONCE
        while not self._events:
            if self._breaks and self.at_line:
                self._breaks = False
                return self._progress()
            if self._left <= 0:
                return self._progress()
            self._left -= 1
            if isinstance(self._over, GCodeError):
                raise self._over.with_traceback(None)
            if self._over is not None:
                return self._over
            if (z_shift := self.vocabulary.z_shift) is not None:
                planned_z = self.planner.toolhead_position[2] - self.planner.z_shift_mm
                self.planner.z_shift_mm = z_shift(planned_z)
            filament = self.machine.filament
            self.planner.cold = self.vocabulary.too_cold(filament.active if filament is not None else "")
            try:
                if self._action is not None:
                    self._take_result(self._action)
                elif self._inner:
                    self._advance_inner(self._inner[-1])
                else:
                    self._advance()
            except GCodeError as error:
                self._over = error
                self.close()
        return self._events.popleft()

    @property
    def at_line(self) -> bool:
        """Whether it stands between two lines of its program, with nothing left of the one before."""
        return not self._inner and self.settled and not self.planner.arc_open

    @property
    def settled(self) -> bool:
        """Whether the result of every action at standstill is taken over, and no event waits."""
        return self._action is None and not self._events

    def break_after_line(self) -> None:
        """Make ``step`` return as soon as the present line is done, with all lines that replace it."""
        self._breaks = True

    def attend_others(self) -> Event | None:
        """Return None: no other lines come between those of the program."""
        return None

    def pending(self) -> Event | None:
        """Take over the result of an action at standstill; return a waiting event, None: there is none.

        Raises GCodeError.
        """
        if self._action is not None and not self._events:
            try:
                self._take_result(self._action)
            except GCodeError as error:
                self._over = error
                self.close()
                raise
        return self._events.popleft() if self._events else None

    def close(self) -> None:
        """End the phases of commands that it does not go on with, after an error or before its end."""
        while self._inner:
            inner = self._inner.pop()
            if isinstance(inner, _Phase) and isinstance(inner.readings, Generator):
                inner.readings.close()

    def _progress(self) -> Progress:
        return Progress(self.planner.lines, self.program.done_bytes, self.program.size_bytes)

    # ---- One piece ----

    def _advance(self) -> None:
        program = self.program
        feed = self.planner.feed(program.data, program.start, len(program.data), final=program.final)
        program.start = feed.offset
        if self._tower_comes_first():
            return
        if feed.status is FeedStatus.OTHER_LINE:
            self._other_line()
        elif feed.status is not FeedStatus.NEED_DATA:
            self._refused(feed)
        elif program.final:
            self._end()
        else:
            program.check_line_length(self.line)
            more = program.refill()
            self._events.append(self._progress() if more else Idle())

    def _refused(self, feed: Feed) -> None:
        if feed.status is FeedStatus.LIMIT:
            raise self._error(str(self.planner.fault))
        self._events.append(Full())

    def _end(self) -> None:
        if not self.planner.flush():
            self._events.append(Full())
            return
        self._over = End(self.planner.lines, self.planner.print_time_end_s)

    def _other_line(self) -> None:
        program = self.program
        end = program.line_end()
        cut = program.final and end == len(program.data)
        hint = "; the file ends within this line: it is cut short, copy it again" if cut else ""
        if not self._do(program.data[program.start : end], hint):
            self._events.append(Full())
            return
        program.start = min(end + 1, len(program.data))
        if not self._inner:  # else its line is done when they are
            self.planner.line_done()

    def _advance_inner(self, inner: _Inner | _Phase) -> None:
        if isinstance(inner, _Phase):
            self._advance_phase(inner)
            return
        if inner.start >= len(inner.data):
            self._inner_done()
            return
        inner.at = inner.start
        end = inner.line_end()
        lines = self.planner.lines
        feed = self.planner.feed(inner.data, inner.start, end, final=True)
        self.planner.lines = lines
        if self._tower_comes_first():
            return
        if feed.status is FeedStatus.OTHER_LINE:
            if not self._do(inner.data[inner.start : end]):
                self._events.append(Full())
                return
        elif feed.status is not FeedStatus.NEED_DATA:
            self._refused(feed)
            return
        inner.start = end + 1
        self._inner_lines += 1
        if self._inner_lines > MAX_LINES:
            name = self._inner[0].name
            raise self._error(f"{name} stands for more than {MAX_LINES:,} lines; let there be fewer")

    def _advance_phase(self, phase: _Phase) -> None:
        try:
            reading = phase.waiting or next(phase.readings, None)
            if reading is None:
                self._inner_done()
            elif not self.follow(phase.command, reading):
                phase.waiting = reading
                self._events.append(Full())
            else:
                phase.waiting = None
        except (WordError, ValueError) as problem:
            raise self._error(str(problem)) from None

    def _tower_comes_first(self) -> bool:
        """Whether the line that the planner left prints at another height: its tower's command comes first.

        The line is read again then.
        """
        z_mm = self.planner.new_height_mm
        if z_mm is None:
            return False
        if line := tuning.reach(self, z_mm):
            if len(self._inner) >= MAX_DEPTH:
                raise self._error(self._too_deep(tuning.NAME))
            self._inner.append(_Inner(tuning.NAME, line.encode(), comes_before=True))
        return True

    def _inner_done(self) -> None:
        done = self._inner.pop()
        if self._inner:
            return
        self._inner_lines = 0
        if not (isinstance(done, _Inner) and done.comes_before):
            self.planner.line_done()

    def _do(self, line: bytes, hint: str = "") -> bool:
        """Carry out a line that is no move; False: the planner has to be emptied first."""
        try:
            command = parse(line)
            return command is None or self._act_noting(command)
        except (WordError, ValueError) as problem:
            raise self._error(f"{problem}{hint}") from None

    def _act_noting(self, command: Command) -> bool:
        """Act on COMMAND, and report parameters that were ignored."""
        taken: dict[str, bool] = {}
        done = self._act(replace(command, taken=taken))
        for key in (key for key, any_took in taken.items() if not any_took):
            self.notice(
                f"{quoted(key).strip(QUOTE)} of {command.name}", "it has no meaning here and is ignored"
            )
        return done

    def _act(self, command: Command) -> bool:
        known = self.vocabulary.commands.get(command.written) if command.written else None
        known = known or self.vocabulary.commands.get(command.name)
        if known is not None:
            self._check_while_printing(command, allowed=known.while_printing)
            return self.follow(command, self._read(known, command))
        return self._act_built_in(command)

    def _read(self, known: GCodeCommand, command: Command) -> Reading:
        """Return what COMMAND means to the module that KNOWN is of.

        A bug there ends this program alone: reading changes nothing. What acts may leave the planner and step
        generation at odds, and stops the machine.
        """
        try:
            return known.read(self.call(command))
        except (CanductorError, ValueError):
            raise
        except Exception as bug:
            raise WordError(log_bug(bug)) from bug

    def _act_built_in(self, command: Command) -> bool:
        handler = basic_commands.HANDLERS.get(command.name)
        if handler:
            self._check_while_printing(command, allowed=command.name in basic_commands.WHILE_PRINTING)
            return handler(self, command)
        if machine_commands.is_tool(command.name):
            self._check_while_printing(command, allowed=False)
            return machine_commands.select_tool(self, command)
        self._skip(command)
        return True

    def _skip(self, command: Command) -> None:
        """Report an unknown command; raises WordError for one that a job must not skip."""
        what = quoted(command.name).strip(QUOTE)
        why = self.vocabulary.unsupported.get(command.name, "")
        absent = ABSENT.get(command.name)
        if absent is None or absent.harmless or not why:
            self.notice(f"unknown command {what}", why or "unknown commands are skipped")
            return
        self.refuse_skipping(command, f"{absent.effect.value}, but {why}")

    def refuse_skipping(self, command: Command, why: str) -> None:
        """Raise WordError: COMMAND, which does what WHY says, must not be skipped; a plan reports it."""
        if self.strict:
            raise WordError(f"{command.name} {why}; remove the line, or what asks for it")
        self.notice(f"{quoted(command.name).strip(QUOTE)} {why}", "a job would end here")

    def _check_while_printing(self, command: Command, *, allowed: bool) -> None:
        if self.while_printing and not allowed:
            raise WordError(
                f"{command.name} cannot run while a job prints; pause it first, or wait for its end"
            )

    # ---- What modules make of a command ----

    def call(self, command: Command) -> Call:
        """Return COMMAND with what holds where it stands."""
        planner = self.planner
        callers = tuple(inner.name for inner in self._inner)
        active = self.machine.active
        extruder = active.name if active is not None else ""
        position = self.machine.motor_position(planner.toolhead_position)

        def figures() -> Figures:
            return MotionStatus.of(planner, self.machine).figures()

        return Call(
            command, self.line, position, planner.homed, callers, extruder, figures, self.while_printing
        )

    def knows(self, name: str) -> bool:
        """Whether NAME is a command."""
        known = name in self.vocabulary.commands or name in basic_commands.HANDLERS
        return known or machine_commands.is_tool(name)

    def follow(self, command: Command, reading: Reading) -> bool:
        """Do what READING says; False: the planner has to be emptied first."""
        match reading:
            case Immediate():
                if reading.act is not None:
                    reading.act()
                self._reply(reading.replies, reading.kind)
            case Synchronized():
                self._events.append(Timed(self.line, self.planner.moves, reading.act))
            case AtStandstill():
                if not machine_commands.come_to_standstill(self):
                    return False
                end_s = self.planner.print_time_end_s
                self._action = StandstillAction(self.line, end_s, reading.perform, reading.planned)
                self._events.append(self._action)
            case Lines():
                self._check_depth(command)
                self._reply(reading.replies)
                data = reading.text.encode(errors="replace")
                self._inner.append(_Inner(command.name, data, where=reading.where))
                self._left = 0
            case Phases():
                self._check_depth(command)
                self._inner.append(_Phase(command, reading.run(self)))
            case ProgramAction():
                return reading.act(self)
            case BuiltIn():
                return self._act_built_in(command.called(reading.name))
        return True

    def _take_result(self, event: StandstillAction) -> None:
        self._action = None
        if event.moved and event.done is None:
            self.planner.homed = ""
        if event.failure:
            raise self._error(event.failure, event.line)
        if event.done is not None:
            self.take(event.done)

    def take(self, done: Done) -> None:
        """Take over the result of an action at standstill."""
        planner = self.planner
        self._reply(done.replies, done.kind)
        planner.homed = "".join(axis for axis in planner.homed if axis not in done.unhomed)
        if done.position is None:
            return
        position = self.machine.planned_position(done.position)
        planner.set_position(position)
        planner.clear_gcode_base(done.homed)
        planner.homed = planner.homed + done.homed
        machine_commands.home_carriages(self, done.homed, done.second_carriage_mm)
        self._events.append(PositionSet(self.line, done.homed, position, planner.print_time_end_s))

    def _reply(self, texts: tuple[str, ...], kind: ReplyKind = ReplyKind.INFORMATION) -> None:
        self._events.extend(Reply(self.line, text, kind) for text in texts)

    # ---- For the handlers ----

    def _check_depth(self, command: Command) -> None:
        if len(self._inner) >= MAX_DEPTH:
            raise WordError(self._too_deep(command.name))

    def _too_deep(self, name: str) -> str:
        """Say how NAME comes to stand in too many others."""
        callers = [inner.name for inner in self._inner]
        if name not in callers:
            return f"{name} stands in {MAX_DEPTH} others, one in another; let there be fewer"
        last = len(callers) - callers[::-1].index(name)
        by_way_of = f" by way of {' and '.join(callers[last:])}" if callers[last:] else ""
        return f"{name} calls itself{by_way_of}, {MAX_DEPTH} levels deep; end that"

    def _error(self, problem: str, line: int | None = None) -> GCodeError:
        places = [inner.place for inner in self._inner if inner.place]
        if len(places) > MAX_PLACES:
            places = [places[0], "…", places[-1]] if places[0] != places[-1] else places[:1]
        within = "".join(f"{place}: " for place in places)
        return GCodeError(self.program.name, line or self.line, f"{within}{problem}")

    def notice(self, what: str, remark: str) -> None:
        """Report WHAT with a REMARK, once in this job."""
        if what in self._noticed or len(self._noticed) > MAX_NOTICES:
            return
        self._noticed.add(what)
        text = f"{self.program.name}:{self.line}: {what}: {remark}"
        if len(self._noticed) > MAX_NOTICES:
            text = f"{self.program.name}:{self.line}: more than {MAX_NOTICES} notices: no more are shown"
        self._events.append(Notice(self.line, text))

    def emit(self, event: Event) -> None:
        """Return EVENT from the next ``step``."""
        self._events.append(event)

    def end_with(self, event: Event) -> None:
        """End the job with EVENT."""
        self._over = event
