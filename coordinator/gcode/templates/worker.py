"""The process that renders templates, and does nothing else.

It serves requests from its standard input, a socket, until that ends (messages.py). The kernel bounds what it
takes of memory and, should the program have died, of processor time; it may write no file.
"""

import gc
import json
import os
import resource
import socket
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final

from jinja2 import ChainableUndefined, Template

from coordinator.gcode.templates.messages import encode_answer, read_request
from coordinator.gcode.templates.rendering import Ended, Failed, TemplateCompiler
from coordinator.gcode.templates.sandbox import Meter, TooMuch

MEMORY_BYTES: Final = 64 * 1024 * 1024
"""That rendering may take, beyond what the process has at its start."""
KEPT_BYTES_MAX: Final = MEMORY_BYTES // 4
"""That renderings may leave behind, all together; a process that keeps more is replaced. What is free in it
is in pieces, and a template that needs little would find too little."""
ACTIONS_MAX: Final = 1_000
"""Of one rendering: whoever shows lines and calls clients has other things to do."""
TEXT_MAX: Final = 2_000
"""Characters of a line to show, or of a sentence; as the log keeps. The rest is left out."""
_STATM: Final = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
_ALONE_CPU_S: Final = 3
"""Processor time for one request after which the kernel ends the process, when nobody else does."""


class Section(dict[str, Any]):
    """The status of a section: what it does not have is undefined, and so is all of that."""

    def __init__(self, name: str, status: Mapping[str, Any]) -> None:
        super().__init__(status)
        self._name = name

    def __missing__(self, field: str) -> ChainableUndefined:
        return ChainableUndefined(f"printer[{self._name!r}] has no {field!r}")


class RemoteMapping(Mapping[str, Any]):
    """Values of the program by name, under PATH; each is asked for when it is first looked at, and kept."""

    def __init__(self, worker: "Worker", path: tuple[str, ...], names: list[str] | None = None) -> None:
        self._worker = worker
        self._path = path
        self._names = names
        self._known: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._known:
            if name not in self._all_names():
                raise KeyError(name)
            self._known[name] = self._worker.ask((*self._path, name))
        return self._known[name]

    def __contains__(self, name: object) -> bool:
        return name in self._all_names()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all_names())

    def __len__(self) -> int:
        return len(self._all_names())

    def _all_names(self) -> list[str]:
        if self._names is None:
            self._names = self._worker.ask_names(self._path)
        return self._names


class Actions:
    """What one rendering asks for: lines to show, calls of clients; in order, counted by METER."""

    def __init__(self, meter: Meter) -> None:
        self._meter = meter
        self.asked: list[tuple[Any, ...]] = []

    def functions(self) -> dict[str, object]:
        """Return what templates know of it."""

        def respond(text: object) -> str:
            return self._add("respond", str(text)[:TEXT_MAX])

        def call_remote(method: object, **values: object) -> str:
            return self._add("call", str(method), {name: _plain(value) for name, value in values.items()})

        def fail(text: object) -> str:
            raise Ended(str(text)[:TEXT_MAX])

        def stop(text: object = "") -> str:
            raise Ended(str(text)[:TEXT_MAX], emergency=True)

        return {
            "action_respond_info": respond,
            "action_call_remote_method": call_remote,
            "action_raise_error": fail,
            "action_emergency_stop": stop,
        }

    def _add(self, *action: object) -> str:
        if len(self.asked) >= ACTIONS_MAX:
            raise TooMuch(f"more than {ACTIONS_MAX:,} lines to show and calls of clients")
        self._meter.turn()
        self._meter.text(len(json.dumps(action)))
        self.asked.append(action)
        return ""


class Worker:
    """Serves CHANNEL."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._compiler = TemplateCompiler()
        self._compiled: dict[int, Template] = {}
        self._kept_bytes = 0
        """By which renderings have made this process larger."""
        self._known: dict[tuple[str, ...], tuple[Any, ...]] = {}
        """What the program has sent with the request, by path."""

    def run(self) -> None:
        """Serve until the program ends."""
        self._answer({"ready": True})
        while (request := read_request(self._channel)) is not None:
            _bound_cpu()
            kind, *given = request
            if kind == "compile":
                self._compile(*given)
            else:
                self._render(*given)

    def ask(self, path: tuple[str, ...]) -> Any:
        """Return what the program has under PATH."""
        answer = self._request(path)
        if answer[0] == "names":
            return RemoteMapping(self, path, answer[1])
        value = answer[1]
        return Section(path[0], value) if len(path) == 1 and isinstance(value, dict) else value

    def ask_names(self, path: tuple[str, ...]) -> list[str]:
        """Return the names that the program has under PATH."""
        names: list[str] = self._request(path)[1]
        return names

    def _request(self, path: tuple[str, ...]) -> tuple[Any, ...]:
        answer = self._known.get(path)
        if answer is None:
            self._answer({"ask": path})
            answer = read_request(self._channel)
        if answer is None:
            raise SystemExit
        if answer[0] == "failed":
            raise RuntimeError(answer[1])
        return answer

    def _answer(self, answer: Mapping[str, object]) -> None:
        self._channel.sendall(encode_answer(answer))

    def _compile(self, number: int, text: str) -> None:
        try:
            self._compiled[number] = self._compiler.compile(text)
        except Failed as failed:
            self._answer(_problem(failed))
        else:
            self._answer({"compiled": True})

    def _render(
        self, number: int, values: Mapping[str, object], known: dict[tuple[str, ...], tuple[Any, ...]]
    ) -> None:
        self._known = known
        before_bytes = _size_bytes()
        meter = Meter()
        actions = Actions(meter)
        printer = RemoteMapping(self, ())
        text, lines, memory = "", None, False
        answer: dict[str, object] = {"actions": actions.asked}
        try:
            text, lines = self._compiler.render(
                self._compiled[number], {**values, "printer": printer, **actions.functions()}, meter
            )
        except Ended as ended:
            answer |= {"end": str(ended), "emergency": ended.emergency}
        except Failed as failed:
            answer |= _problem(failed)
            memory = failed.memory
        if _size_bytes() > before_bytes:
            gc.collect()  # an error's traceback goes in circles, and keeps what was built
            self._kept_bytes += _size_bytes() - before_bytes
        answer["memory"] = memory or self._kept_bytes > KEPT_BYTES_MAX
        self._channel.sendall(encode_answer(answer, text, lines))


def _problem(failed: Failed) -> dict[str, object]:
    return {"problem": str(failed), "line": failed.line, "memory": failed.memory}


def _plain(value: object) -> object:
    """Return VALUE as JSON can carry it."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(inner) for inner in value]
    return str(value)


def _bound_cpu() -> None:
    """End this process when the request at hand takes far too long."""
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    soft = _within(resource.RLIMIT_CPU, int(time.process_time()) + _ALONE_CPU_S)
    resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def _size_bytes() -> int:
    """Return the size of this process's address space, which is what ``_bound_memory`` bounds."""
    return int(os.pread(_STATM, 32, 0).split()[0]) * resource.getpagesize()


def _bound_memory() -> None:
    size = _within(resource.RLIMIT_AS, _size_bytes() + MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _within(what: int, limit: int) -> int:
    """Return LIMIT, or the hard limit on WHAT that this process was given, where that is lower."""
    _, hard = resource.getrlimit(what)
    return limit if hard == resource.RLIM_INFINITY else min(limit, hard)


def main() -> None:
    """Serve standard input."""
    with socket.socket(fileno=0) as channel:
        worker = Worker(channel)
        _bound_memory()
        try:
            worker.run()
        except ConnectionError:  # the program has ended
            return


if __name__ == "__main__":
    main()
