"""Latency of G-code templates: a macro of 20 lines that looks at the machine; attacks to their sentence."""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.gcode.commands import Call
from coordinator.gcode.interpreter import Job
from coordinator.gcode.parser import parse
from coordinator.gcode.program import Program
from coordinator.gcode.templates.templates import Template, TemplateError
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.streaming.program_machine import machine_state

ROUNDS = 2_000
CONFIG = Path(__file__).parents[1] / "config" / "corexy_toolhead.cfg"
MACRO = """
[gcode_macro PURGE]
variable_length: 30
variable_places: [10, 20]
gcode:
    {% set bed = params.BED|default(60)|float %}
    {% set hot = params.HOT|default(210)|float %}
    {% set x = printer.toolhead.position.x + 5 %}
    {% set most = printer.configfile.settings.printer.max_velocity * 60 %}
    {% if "xyz" not in printer.toolhead.homed_axes %}
    G28
    {% endif %}
    {% if printer.extruder.target < hot %}
    M104 S{hot}
    {% endif %}
    M140 S{bed}
    {% for place in places %}
    G1 X{x + place} Y{place} F{[most, 9000]|min}
    G1 E{length / 2} F300
    {% endfor %}
    {% if printer["gcode_macro PURGE"].length > 10 %}
    G92 E0
    {% endif %}
    {action_respond_info("purged %.1f mm" % length)}
    G1 Z{printer.toolhead.axis_maximum.z / 2}
"""
ATTACKS = {
    "nested comparison": "{% set n = namespace(a=[1], b=[1]) %}{% for i in range(60) %}"
    "{% set n.a = [n.a, n.a] %}{% set n.b = [n.b, n.b] %}{% endfor %}{ n.a == n.b }",
    "sum of lists": "{ (([[1] * 900] * 90000)|sum(start=[]))|length }",
    "memory": "{% set l = [] %}{% for i in range(900) %}{% do l.append([i] * 900000) %}{% endfor %}",
}


def caller() -> tuple[Callable[[], object], Template]:
    """Return what reads the macro, on a machine that is only described."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "printer.cfg"
        path.write_text(CONFIG.read_text(encoding="utf-8") + MACRO, encoding="utf-8")
        description = load_machine(str(path))
    modules = build_modules(description)
    program = Program.from_lines([], "bench")
    state, planner = machine_state(description), Planner(description.limits)
    job = Job(program, planner, description.homed_position, state, modules.vocabulary)
    command = parse(b"PURGE BED=70")
    assert command is not None
    call: Call = job.call(command)
    read = modules.vocabulary.commands["PURGE"].read
    return lambda: read(call), Template("{ 1 }")


def main() -> None:
    read, small = caller()
    before_s = time.perf_counter()
    small.render({})
    print(f"start of the worker and a first template {(time.perf_counter() - before_s) * 1e3:8.1f} ms")
    before_s = time.perf_counter()
    read()
    print(f"macro of 20 lines, first (compiled)      {(time.perf_counter() - before_s) * 1e3:8.2f} ms")
    for name, call in (("template without status", lambda: small.render({})), ("macro of 20 lines", read)):
        taken_ms = []
        for _ in range(ROUNDS):
            before_s = time.perf_counter()
            call()
            taken_ms.append((time.perf_counter() - before_s) * 1e3)
        quantiles = statistics.quantiles(taken_ms, n=100)
        print(
            f"{name:<32} median {statistics.median(taken_ms):6.3f} ms, 99 % {quantiles[98]:6.3f} ms,"
            f" worst {max(taken_ms):6.3f} ms"
        )
    for name, text in ATTACKS.items():
        before_s = time.perf_counter()
        try:
            Template(text).render({})
        except TemplateError as error:
            print(f"{name:<20} ends after {(time.perf_counter() - before_s) * 1e3:6.0f} ms: {error}")
        small.render({})


if __name__ == "__main__":
    main()
