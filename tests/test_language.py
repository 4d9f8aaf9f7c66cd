"""Names that were replaced by the field's usual words do not come back (docs/glossary.md)."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
RETIRED = {
    "Vigil": "NodeWatchdog",
    "LinkLike": "LinkInterface",
    "LinkIOLike": "LinkIoInterface",
    "Census": "NodeDiscovery",
    "CensusResult": "DiscoveredNodes",
    "Overhearing": "PassiveDiscovery",
    "interview": "node_info",
    "survey": "inventory",
    "AtOnce": "Immediate",
    "InTime": "Synchronized",
    "AtRest": "AtStandstill",
    "NotYetActing": "Unsupported",
    "LATER_SECTIONS": "UNSUPPORTED_SECTIONS",
    "RestTask": "StandstillTask",
    "Resting": "StandstillAction",
    "WayHome": "ResumeHomingPlan",
    "way_home": "resume_homing",
    "RailPlaces": "StepperPositions",
    "Door": "TcpListener",
    "no_answer": "connect_errors",
    "Answered": "ParserExit",
    "write_whole": "atomic_write",
    "read_whole": "read_int",
    "told_version": "version_text",
    "Desk": "Endpoint",
    "Reactions": "Engine",
    "Scanner": "Lexer",
    "flying_bytes": "in_flight_bytes",
    "flying_blocks": "in_flight_blocks",
    "flying_commands": "in_flight_commands",
    "schedule_breathe": "schedule_pause",
    "naks_owed": "naks_outstanding",
    "owed_until_ns": "outstanding_until_ns",
    "lost_told": "lost_reported",
    "FrameLike": "Frame",
    "ResponseLike": "Response",
    "WAY_S": "TRANSIT_S",
    "world_axis": "a plant",
    "Surroundings": "Environment",
    "DncReport": "PlainReport",
    "ServeReport": "PlainReport",
    "ScenarioList": "PlainReport",
    "ToProgram": "ProgramAction",
    "MachineModules": "Modules",
    "ConfiguresNodes": "configure_modules",
    "Pinned": "Build.add_device(node, device, pin)",
    "add_pinned": "Build.add_device(node, device, pin)",
    "ConfigView": "config_view",
    "set_in_time": "set_target",
    "add_timed": "nothing: outputs have queue slots of their own",
    "ThisComputer": "Computer",
    "BusAddress": "BusOptions",
    "TalkBus": "BusTalk",
    "TableTalk": "NodeTables",
    "end_of_calm": "start_of_queries",
    "release_on": "release",
}
"""By the name that is refused: what to write instead."""
SEARCHED = ("coordinator", "nodes", "canbus_tools", "tests", "bench", "docs", "README.md", "CONTRIBUTING.md")
SUFFIXES = (".py", ".md", ".c", ".h")


def test_retired_names_are_not_used() -> None:
    command = ["git", "ls-files", "-z", *SEARCHED]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a checkout of git")
    names = re.compile(rf"(?<![\w.-])({'|'.join(RETIRED)})(?![\w-])")
    found = [
        f"{path}:{number}: write {RETIRED[match[1]]} instead of {match[1]}"
        for path in listed.stdout.split("\0")
        if path.endswith(SUFFIXES) and path != "tests/test_language.py" and "adr/" not in path
        for number, line in enumerate((ROOT / path).read_text(encoding="utf-8").splitlines(), 1)
        for match in names.finditer(line)
    ]
    assert not found, "\n".join(found)
