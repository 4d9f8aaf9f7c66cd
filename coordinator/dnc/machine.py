"""A program that a machine prints while it is received, as a job of its own.

The machine answers each piece when it has room for the next. Until then some lines wait here, and the next
one over the serial line is not acknowledged. All in one thread: calls are begun, and checked later.
"""

import contextlib
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future, wait
from typing import Any, Final, Protocol

from coordinator.dnc.files import FileRefused
from coordinator.ipc.protocol.methods import ApiError
from nodes.support.errors import CanductorError

LINES_MAX: Final = 64
"""Lines that wait here for the machine."""
ANSWER_S: Final = 10.0
"""Timeout of an answer that needs no work of the machine."""
_FAILURE_MAX: Final = 500

Begin = Callable[[str, Mapping[str, Any]], Future[Any]]
"""Begins a call of a method."""


class Client(Protocol):
    """The interface of a client of the machine."""

    def begin(self, method: str, params: Mapping[str, Any]) -> Future[Any]: ...  # noqa: D102


class MachineSink:
    """The job NAME of the machine that CLIENT talks to; raises CanductorError when it cannot begin."""

    is_live = True

    def __init__(self, client: Client, name: str) -> None:
        self.name = name
        self.size_bytes = 0
        self._begin: Begin = client.begin
        self._lines: list[str] = []
        self._fed = 0
        self._ended = False
        self._job = self._begin("job.stream", {"name": name})
        self._answer: Future[Any] = self._feed(0)
        try:
            self._answer.result(ANSWER_S)
        except ApiError as error:
            wait((self._job,), ANSWER_S)  # its error is the reason
            self._check_job()
            raise _refused(str(error)) from None
        except TimeoutError:
            raise _refused(f"the machine did not begin {name} within {ANSWER_S:g} s") from None

    @property
    def ready(self) -> bool:
        """Whether another line may come; raises CanductorError when the job is over."""
        self._go_on()
        return len(self._lines) < LINES_MAX

    def write(self, line: bytes) -> None:
        """Take a line; raises CanductorError."""
        self.size_bytes += len(line) + 1
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            raise FileRefused(
                f"line {self._fed + len(self._lines) + 1} of {self.name} is not ASCII", "BAD CHARACTER"
            ) from None
        self._lines.append(text)
        self._go_on()

    def keep(self) -> None:
        """Report the end of the program; raises CanductorError."""
        self._end({"end": True})

    def drop(self, why: str = "") -> None:
        """Report that no more lines follow, for the reason WHY; the lines so far are carried out."""
        if not self._ended:
            with contextlib.suppress(CanductorError):  # the job is over already
                self._end({"failure": (why or "no more lines were received")[:_FAILURE_MAX]})

    def wait_until_over(self) -> Mapping[str, Any]:
        """Return how the job ended, once it has; raises CanductorError unless it was done."""
        result: Mapping[str, Any] = _result(self._job)
        if result["state"] != "done":
            raise CanductorError(result["message"] or f"{self.name} was {result['state']} at the machine")
        return result

    # ------------------------------------------------------------------------------------------- calls

    def _go_on(self) -> None:
        """Check the last call, and send the lines that wait."""
        if self._answer.done():
            self._check_job()
            try:
                _result(self._answer)
            except CanductorError as error:
                raise _refused(str(error)) from None
            if self._lines:
                self._answer = self._feed(LINES_MAX)

    def _feed(self, count: int, more: Mapping[str, Any] | None = None) -> Future[Any]:
        """Begin to feed COUNT lines of those that wait, at most."""
        lines, self._lines = self._lines[:count], self._lines[count:]
        params = {"name": self.name, "first_line": self._fed + 1, "text": "".join(f"{t}\n" for t in lines)}
        self._fed += len(lines)
        return self._begin("job.feed", {**params, **(more or {})})

    def _end(self, how: Mapping[str, Any]) -> None:
        self._ended = True
        try:
            self._feed(len(self._lines), how).result(ANSWER_S)
        except ApiError as error:
            self._check_job()
            raise _refused(str(error)) from None
        except (TimeoutError, CancelledError):
            raise _refused(f"the machine did not answer within {ANSWER_S:g} s") from None

    def _check_job(self) -> None:
        """Raise FileRefused if the job is over already."""
        if self._job.done():
            try:
                result = _result(self._job)
            except CanductorError as error:
                raise _refused(str(error)) from None
            message = result["message"]
            raise _refused(message or f"{self.name} was {result['state']} at the machine")


def _refused(sentence: str) -> FileRefused:
    return FileRefused(sentence, "NOT PRINTED")


def _result(answer: Future[Any]) -> Any:
    """Return the result of ANSWER; raises CanductorError."""
    try:
        return answer.result()
    except CancelledError:
        raise CanductorError("the connection to the machine was lost") from None
