"""The program's side of the process that renders templates: it is started once, kept, and ended from here.

One call of a template, such as the comparison of two nested lists, can hold the interpreter for as long as
it likes; in a thread of this process it would hold the control loop with it. So templates are rendered in a
process of their own, with limits that do not depend on what a template does: processor time is read from the
kernel's clock of that process, memory is bounded by the kernel, answers by their announced size. Who renders
waits, in the thread that reads programs; the control loop does not. The process that went beyond a limit is
killed, and another one is started at once.
"""

import atexit
import contextlib
import functools
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.gcode.templates.messages import BadAnswer, encode_request, read_answer
from coordinator.support.realtime import end_realtime

CPU_S: Final = 0.3
"""Processor time that rendering a template may take."""
COMPILE_CPU_S: Final = 2.0
"""That reading one may take; this grows with its text only, and is done when a machine starts."""
WAIT_S: Final = 5.0
"""How long the process may be silent, working or not; it may have to wait for the processor."""
START_S: Final = 60.0
"""Likewise, for it to start."""
END_S: Final = 0.2
"""For a process whose socket has closed to be gone."""
ASKS_MAX: Final = 10_000
"""Values that one rendering may look at."""
TEMPLATES_MAX: Final = 1_000
"""Compiled ones that the process keeps; then it is started again."""
LOOKS_KEPT: Final = 50
"""Values that a template gets at once, because it has looked at them before."""
_CHUNK_BYTES: Final = 65_536
_ROOT: Final = Path(__file__).parents[3]


class RenderingFailed(Exception):  # noqa: N818 (an answer to the user)
    """A template cannot be read, went wrong, or went beyond a limit; LINE of its text, from 1."""

    def __init__(self, line: int, problem: str, actions: "Actions" = ()) -> None:
        super().__init__(problem)
        self.line = line
        self.actions = actions


Actions = tuple[tuple[Any, ...], ...]
"""What a template asked for, in order: ("respond", text), ("call", method, values)."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of a rendering."""

    text: str
    lines: tuple[int, ...]
    """For each line of the text: the template's line it comes from."""
    actions: Actions
    end: str | None = None
    """The template ended itself, with this text."""
    emergency: bool = False
    """And with it the machine."""


class _Process:
    """One worker; all raises RenderingFailed, after which ``alive`` says whether it can be used again."""

    def __init__(self) -> None:
        self._channel, theirs = socket.socketpair()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "coordinator.gcode.templates.worker"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": str(_ROOT), "PYTHONHASHSEED": "0"},
                start_new_session=True,  # Ctrl-C is for the program
            )
            end_realtime(self._process.pid)
        except OSError:
            self._channel.close()
            raise
        finally:
            theirs.close()
        self._channel.settimeout(WAIT_S)
        self._poll = select.poll()
        self._poll.register(self._channel, select.POLLIN)
        self.numbers: dict[str, int] = {}
        """Of the templates that it has compiled."""
        self._looks: dict[int, list[tuple[str, ...]]] = {}
        """By template: what it has looked at so far; the next time it gets that at once."""
        self._received = bytearray()
        self.alive = True
        self._until_cpu_s = float("inf")
        self._limit_s = 0.0
        self._receive(START_S)

    @property
    def ended(self) -> bool:
        """Whether it cannot be used any more; also when somebody else has ended it."""
        if self.alive and self._process.poll() is not None:
            self.close()
        return not self.alive

    def compile(self, text: str) -> int:
        """Return the number of TEXT, compiled."""
        if text not in self.numbers:
            number = len(self.numbers)
            self._begin(COMPILE_CPU_S)
            self._send(("compile", number, text))
            answer, _, _ = self._receive()
            self._check(answer)
            self.numbers[text] = number
        return self.numbers[text]

    def render(self, text: str, values: Mapping[str, object], printer: Mapping[str, Any]) -> Answer:
        """Render TEXT with VALUES; what it looks at of PRINTER is asked for."""
        number = self.compile(text)
        looks = self._looks.setdefault(number, [])
        self._begin(CPU_S)
        self._send(("render", number, dict(values), {path: _look(printer, path) for path in looks}))
        for _ in range(ASKS_MAX):
            answer, made, lines = self._receive()
            if "ask" not in answer:
                self._check(answer)
                end = answer.get("end")
                emergency = bool(answer.get("emergency"))
                return Answer(
                    made, lines, _actions(answer), None if end is None else str(end), emergency=emergency
                )
            asked = answer["ask"]
            path = tuple(str(name) for name in asked) if isinstance(asked, list) else ()
            if len(looks) < LOOKS_KEPT:
                looks.append(path)
            self._send(_look(printer, path))
        raise self._end(f"it looks at more than {ASKS_MAX} values")

    def close(self) -> None:
        """End the process."""
        self.alive = False
        self._channel.close()
        self._process.kill()
        self._process.wait()

    # ---------------------------------------------------------------------------------------- inside

    def _begin(self, cpu_s: float) -> None:
        self._limit_s = cpu_s
        self._until_cpu_s = self._cpu_s() + cpu_s

    def _cpu_s(self) -> float:
        """Return the processor time that the process has taken so far; CPUCLOCK_SCHED of linux/time.h."""
        with contextlib.suppress(OSError):
            return time.clock_gettime((~self._process.pid << 3) | 2)
        return 0.0

    def _send(self, request: tuple[object, ...]) -> None:
        try:
            data = encode_request(request)
        except RecursionError:
            data = encode_request(("failed", "a value is nested too deeply"))
            if request[0] == "render":
                raise RenderingFailed(1, "a value is nested too deeply") from None
        try:
            self._channel.sendall(data)
        except OSError:
            raise self._end(self._silence()) from None

    def _receive(self, wait_s: float = WAIT_S) -> tuple[dict[str, Any], str, tuple[int, ...]]:
        until_s = time.monotonic() + wait_s
        try:
            return read_answer(lambda size: self._read(size, until_s))
        except BadAnswer as error:
            raise self._end(str(error)) from None

    def _read(self, size: int, until_s: float) -> bytes:
        received = self._received
        while len(received) < size:
            self._wait(until_s)
            try:
                chunk = self._channel.recv(_CHUNK_BYTES)
            except OSError:
                chunk = b""
            if not chunk:
                raise self._end(self._silence())
            received += chunk
        data = bytes(received[:size])
        del received[:size]
        return data

    def _wait(self, until_s: float) -> None:
        """Wait until there is something to read, for as long as the limits allow."""
        while True:
            left_s = until_s - time.monotonic()
            cpu_left_s = self._until_cpu_s - self._cpu_s()
            if self._poll.poll(max(0.0, min(left_s, cpu_left_s)) * 1000):
                return
            if cpu_left_s <= 0:
                raise self._end(f"it takes more than {self._limit_s:g} s of processor time; have it do less")
            if left_s <= 0:
                raise self._end(self._silence())

    def _silence(self) -> str:
        """Return why there is no answer."""
        try:
            status = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            return f"the process that renders templates did not answer for {WAIT_S:g} s; it was ended"
        how = f"by signal {-status}" if status < 0 else f"with status {status}"
        return f"the process that renders templates ended {how} while it did this one"

    def _end(self, problem: str) -> RenderingFailed:
        self.close()
        return RenderingFailed(1, problem)

    def _check(self, answer: dict[str, Any]) -> None:
        """Raise what ANSWER says went wrong; end a process whose memory the next one may not find enough."""
        if answer.get("memory"):
            self.close()
        if "problem" not in answer:
            return
        line = answer.get("line")
        raise RenderingFailed(line if isinstance(line, int) else 1, str(answer["problem"]), _actions(answer))


class TemplateRenderer:
    """Renders templates in a process of its own, one at a time; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: _Process | None = None
        self._closed = False
        self._owner = os.getpid()

    def render(self, text: str, values: Mapping[str, object], printer: Mapping[str, Any]) -> Answer:
        """Render TEXT with VALUES and PRINTER; raises RenderingFailed."""
        with self._lock:
            process = self._started()
            try:
                return process.render(text, values, printer)
            finally:
                if not process.alive:
                    self._start_soon([known for known in process.numbers if known != text])

    def prepare(self, texts: Iterable[str]) -> None:
        """Start the process, and have it compile TEXTS; returns at once."""
        self._start_soon(list(dict.fromkeys(texts)))

    def close(self) -> None:
        """End the process, unless it is that of the program which forked this one."""
        if os.getpid() != self._owner:
            return
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.close()

    def _start_soon(self, texts: list[str]) -> None:
        threading.Thread(target=self._prepare, args=(texts,), name="templates", daemon=True).start()

    def _prepare(self, texts: list[str]) -> None:
        """Compile TEXTS; who renders meanwhile comes in between."""
        for text in texts:
            with self._lock:
                if self._closed:
                    return
                with contextlib.suppress(RenderingFailed):  # who renders it gets the sentence
                    self._started().compile(text)

    def _started(self) -> _Process:
        process = self._process
        if process is not None and len(process.numbers) >= TEMPLATES_MAX:
            process.close()
        if process is None or process.ended:
            try:
                process = self._process = _Process()
            except OSError as error:
                problem = f"the process that renders templates cannot be started: {error.strerror}"
                raise RenderingFailed(1, problem) from None
        return process


def _actions(answer: Mapping[str, Any]) -> Actions:
    """Return the actions of ANSWER that are as they should be."""
    asked = answer.get("actions")
    return (
        tuple(tuple(action) for action in asked if isinstance(action, list))
        if isinstance(asked, list)
        else ()
    )


def _look(printer: Mapping[str, Any], path: tuple[str, ...]) -> tuple[object, ...]:
    """Return what PRINTER has under PATH, as an answer to the worker."""
    found: Any = printer
    try:
        for name in path:
            found = found[name]
        if isinstance(found, Mapping) and not isinstance(found, dict):
            return "names", [str(name) for name in found]
    except Exception as error:  # noqa: BLE001 (the template gets the sentence)
        return "failed", str(error) or type(error).__name__
    return "value", found


@functools.cache
def template_renderer() -> TemplateRenderer:
    """Return the one renderer of this process; its worker starts with the first template."""
    renderer = TemplateRenderer()
    atexit.register(renderer.close)
    return renderer


os.register_at_fork(after_in_child=template_renderer.cache_clear)
