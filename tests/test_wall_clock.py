"""Steps of the computer's clock (NTP, summer time, an empty battery) reach nothing that controls the machine.

Whatever is timed uses the monotonic clock. The wall clock is read where people, files or browsers need it.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
WALL_CLOCK = re.compile(
    r"\btime\.(time|time_ns|localtime|gmtime|ctime|strftime)\b|\b(datetime|date)\.(now|utcnow|today)\b"
    r"|from time import|CLOCK_REALTIME"
)
READ_BY = {
    "canbus_tools/bus/computer.py": "times of frames in recordings",
    "canbus_tools/inject/socketcand_server.py": "times of frames, as the protocol has them",
    "canbus_tools/monitor/text.py": "how long ago a recorded node was heard",
    "coordinator/front_ends/log_file.py": "times of lines, for people",
    "coordinator/service/api/machine.py": "when the service began, for people",
    "coordinator/service/core/machine_service.py": "when a job ended, for the history of jobs",
    "coordinator/service/state/log_ring.py": "time of a line of the log",
    "coordinator/web/server.py": "age of sessions, which outlive the process",
    "nodes/virtual/python_can.py": "times of frames, as python-can has them",
}
C_CALLS = ("CLOCK_REALTIME", "gettimeofday", "time(NULL)", "time(0)", "timespec_get")


def sources(*suffixes: str) -> list[Path]:
    folders = (ROOT / name for name in ("coordinator", "nodes", "canbus_tools", "firmware"))
    return [path for folder in folders for suffix in suffixes for path in folder.rglob(f"*{suffix}")]


def test_the_wall_clock_is_read_where_that_is_listed_and_nowhere_else() -> None:
    found = {str(path.relative_to(ROOT)) for path in sources(".py") if WALL_CLOCK.search(path.read_text())}
    assert found == READ_BY.keys()


def test_no_c_code_reads_it() -> None:
    assert not [p for p in sources(".c", ".h") if any(call in p.read_text() for call in C_CALLS)]
