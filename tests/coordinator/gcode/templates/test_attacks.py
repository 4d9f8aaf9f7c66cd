"""A template cannot hold the control loop, whatever it calls: it ends with a sentence, and the next works."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from coordinator.gcode.place import Place
from coordinator.gcode.templates.messages import JSON_BYTES_MAX, BadAnswer, encode_answer, read_answer
from coordinator.gcode.templates.renderer import RenderingFailed, TemplateRenderer
from coordinator.gcode.templates.templates import Asked, Template, TemplateError
from coordinator.gcode.templates.worker import MEMORY_BYTES
from tests.coordinator.gcode.templates.attacks import ATTACKS, SENTENCES
from tests.coordinator.gcode.templates.workers import children, size_bytes
from tests.stages.printer_text import PRINTER_CFG, write

TICKS = 3
"""That the loop has to make while the worker calculates, however busy the computer is."""


class Machine(Mapping[str, object]):
    """What a template sees as ``printer``: CALL is called for each value that it looks at."""

    def __init__(self, call: Callable[[str], object]) -> None:
        self.call = call

    def __getitem__(self, name: str) -> object:
        return self.call(name)

    def __iter__(self) -> Iterator[str]:
        return iter("abc")

    def __len__(self) -> int:
        return 3


async def attack(text: str) -> tuple[str, int]:
    """Render TEXT in a thread; return its error, and how often the loop came round meanwhile."""
    ticks = 0

    async def tick() -> None:
        nonlocal ticks
        while True:
            await asyncio.sleep(0.005)
            ticks += 1

    ticking = asyncio.ensure_future(tick())
    try:
        with pytest.raises(TemplateError) as error:
            await asyncio.to_thread(Template(text).render, {})
        return str(error.value), ticks
    finally:
        ticking.cancel()


@pytest.mark.parametrize("call", ATTACKS)
def test_a_call_that_holds_the_worker_does_not_hold_the_loop(call: str) -> None:
    told, ticks = asyncio.run(attack(ATTACKS[call]))
    assert any(sentence in told for sentence in SENTENCES), told
    assert SENTENCES[0] not in told or ticks >= TICKS
    assert Template("{ 1 + 1 }").render({}).text == "2"


def worker() -> int:
    """Return the process that renders templates; it is there when one was rendered."""
    assert Template("{ 1 }").render({}).text == "1"
    (found,) = children()
    return found


def test_a_worker_that_dies_is_named_and_replaced() -> None:
    dying = worker()
    with pytest.raises(TemplateError, match="the process that renders templates ended by signal 11"):
        Template("{ printer.a }").render({}, Machine(lambda _: os.kill(dying, signal.SIGSEGV)))
    between = worker()
    assert between != dying
    os.kill(between, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):  # it was missed already
        os.waitid(os.P_PID, between, os.WEXITED | os.WNOWAIT)
    assert worker() != between


@pytest.mark.parametrize(
    "end", ["{ l.nothing.x }", "{ action_raise_error('x') }", "{% do l.append(l) %}", "{ l|length }"]
)
def test_the_next_template_does_not_miss_what_one_has_built(end: str) -> None:
    """A worker that keeps much is replaced; before, a template could not be read for want of memory."""
    before_bytes = size_bytes(worker())
    built = "{% set l = [] %}{% for i in range(4500) %}{% do l.append('a'.center(9999)) %}{% endfor %}"
    for _ in range(4):
        with contextlib.suppress(TemplateError, Asked):
            Template(built + end).render({})
        assert size_bytes(worker()) - before_bytes < MEMORY_BYTES // 2


def test_values_arrive_as_they_were() -> None:
    values = {"t": (1, 2), "s": {3}, "n": None, "b": b"x", "f": 0.1, "p": Place(1, 2, 3, 4), "d": {1: [2]}}
    shown = "{ t == (1, 2) } { 3 in s } { n is none } { b.decode() } { f } { p.x + p[3] } { d[1][0] }"
    assert Template(shown).render(values).text == "True True True x 0.1 5 2"
    deep: list[object] = []
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(TemplateError, match="nested too deeply"):
        Template("{ d }").render({"d": deep})
    with pytest.raises(TemplateError, match="nested too deeply"):
        Template("{ printer.a }").render({}, {"a": deep})


def test_the_machine_is_looked_at_only_where_the_template_looks() -> None:
    looked: list[str] = []

    def look(name: str) -> object:
        looked.append(name)
        return {"x": len(looked)} if name != "b" else Machine(lambda inner: 2 * inner)

    text = (
        "{ printer.a.x }{ printer.a.x }{ 'c' in printer }{ printer.z is defined }{ printer.a.n.o is defined }"
    )
    assert Template(text).render({}, Machine(look)).text == "11TrueFalseFalse"
    assert looked == ["a"]
    assert Template("{ printer.b.c }{ printer.b.z is defined }").render({}, Machine(look)).text == "ccFalse"


def test_an_answer_that_is_none_is_refused() -> None:
    def reader(data: bytes) -> Callable[[int], bytes]:
        def read(size: int) -> bytes:
            nonlocal data
            taken, data = data[:size], data[size:]
            return taken

        return read

    good = encode_answer({"x": "\ud800"}, "ä\n")
    assert read_answer(reader(good))[:2] == ({"x": "\ud800"}, "ä\n")
    for bad in (
        (JSON_BYTES_MAX + 1).to_bytes(4, "little") + bytes(8),
        b"\x02\0\0\0" + bytes(8) + b"[]",
        b"\x01\0\0\0" + bytes(8) + b"{",
        b"\x02\0\0\0\x01\0\0\0" + bytes(4) + b"{}\xff",
        b"\x02\0\0\0\0\0\0\0\x01\0\0\0{}\xff",
    ):
        with pytest.raises(BadAnswer):
            read_answer(reader(bad))


def test_a_plan_without_macros_starts_no_worker(tmp_path: Path) -> None:
    """In a process of its own: in this one there may be a worker already."""
    write(
        tmp_path,
        PRINTER_CFG + "[gcode_macro A]\ngcode:\n    G4 P{params.P}\n[gcode_macro B]\ngcode:\n    M400\n",
    )
    (tmp_path / "a.gcode").write_text("A P=1\n", encoding="ascii")
    (tmp_path / "b.gcode").write_text("G28\nB\n", encoding="ascii")
    script = (
        "import sys\n"
        "from coordinator.cli.main import main\n"
        "from tests.coordinator.gcode.templates.workers import children\n"
        f"assert main(['plan', '{tmp_path}/printer.cfg', '{tmp_path}/b.gcode']) == 0\n"
        "assert children() == []\n"
        f"assert main(['plan', '{tmp_path}/printer.cfg', '{tmp_path}/a.gcode']) == 0\n"
        "assert len(children()) == 1\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.DEVNULL, env=os.environ)


def test_a_worker_that_cannot_be_started_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    renderer = TemplateRenderer()
    with pytest.raises(RenderingFailed, match="cannot be started: No such file or directory"):
        renderer.render("{ 1 }", {}, {})
    renderer.close()


def test_where_this_program_has_limits_of_its_own_the_worker_keeps_them() -> None:
    """As under systemd's LimitCPU: a process without privileges cannot raise a hard limit."""
    limits = "import resource\nresource.setrlimit(resource.RLIMIT_CPU, (60, 61))\n"
    render = (
        "from coordinator.gcode.templates.templates import Template\n"
        "print(Template('{6 * 7}').render({}).text)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", limits + render], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout.startswith("42"), done.stderr
