"""The command ``canductor``: parses the command line, runs the job, reports the result.

``parse_command_line`` only makes a job of the command line. ``main`` runs it, so that every failure ends in
one place: one sentence on stderr, with --json also one object on stdout.
"""

import json
import select
import signal
import sys
from collections.abc import Callable, Mapping, Sequence

from coordinator.cli.parser import Job, build_parser, parse_command_line
from coordinator.support.bug_log import log_bug
from coordinator.support.interrupts import Terminated
from coordinator.support.report import Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import ParserExit, UsageError
from nodes.support.terminal import OutputError, discard, replace_closed_outputs, show, show_error
from nodes.support.termination import TERMINATION

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_BUG = 70
EXIT_SIGNAL = 128
"""Added to the number of a signal, as shells do."""
EXIT_BROKEN_PIPE = 141


def main(
    arguments: Sequence[str] | None = None, parse: Callable[[Sequence[str]], Job] = parse_command_line
) -> int:
    """Run one command and return the exit status; never raises.

    PARSE makes a job of the command line.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    as_json = "--json" in words
    replace_closed_outputs()
    before = {number: signal.signal(number, _terminate) for number in _to_be_handled()}
    try:
        return _run(words, as_json, parse)
    except BrokenPipeError as error:
        if not _stdout_is_gone():
            return _fail(log_bug(error), EXIT_BUG, as_json)
        discard(sys.stdout)
        return EXIT_BROKEN_PIPE
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _to_be_handled() -> list[signal.Signals]:
    """Return which signals of TERMINATION end the command: SIGHUP not where nohup has it ignored."""
    return [n for n in TERMINATION if n == signal.SIGTERM or signal.getsignal(n) is not signal.SIG_IGN]


def _terminate(number: int, _: object) -> None:
    raise Terminated(number)


def _print_help() -> int:
    build_parser().print_help()
    return EXIT_USAGE


def _run(words: list[str], as_json: bool, parse: Callable[[Sequence[str]], Job]) -> int:
    try:
        return _show(parse(words)(), as_json) if words else _print_help()
    except ParserExit:
        return EXIT_OK
    except (CanductorError, OutputError) as error:
        return _fail(str(error), EXIT_FAILED, as_json)
    except UsageError as error:
        sentence = " ".join(str(error).split())
        return _fail(f"{sentence} (see '{error.command or 'canductor'} --help')", EXIT_USAGE, as_json)
    except KeyboardInterrupt as error:
        number = error.signal if isinstance(error, Terminated) else signal.SIGINT
        name = "Ctrl-C" if number == signal.SIGINT else number.name
        return _fail(f"stopped by {name}", EXIT_SIGNAL + number, as_json)
    except BrokenPipeError:
        raise
    except Exception as bug:  # noqa: BLE001 (the last line of defence: whatever arrives here is reported as a bug)
        return _fail(log_bug(bug), EXIT_BUG, as_json)


def _show(report: Report, as_json: bool) -> int:
    if as_json:
        _show_json({"ok": report.ok, **report.to_json()})
    elif text := report.to_text():
        show(text)
    return EXIT_OK if report.ok else EXIT_FAILED


def _fail(sentence: str, status: int, as_json: bool) -> int:
    show_error(f"canductor: {sentence}")
    if as_json:
        try:
            _show_json({"ok": False, "error": sentence})
        except OutputError as error:
            show_error(f"canductor: {error}")
    return status


def _show_json(values: Mapping[str, object]) -> None:
    show(json.dumps(values, allow_nan=False))


def _stdout_is_gone() -> bool:
    """Return whether the reader of our output is gone; a broken pipe elsewhere would be a bug."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0))
    except (OSError, ValueError):  # not a file: nobody can close its other end
        return False


if __name__ == "__main__":
    sys.exit(main())
