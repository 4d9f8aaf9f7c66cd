"""The doctor as tests ask it, and its findings."""

from typing import Any

from tests.canbus_tools.command import Command, Said

BITRATE = "1000000"


def examine(tool: Command, *words: str) -> Said:
    """Run ``canductor can doctor`` on a bus of BITRATE."""
    return tool("doctor", "--bitrate", BITRATE, "--json", *words)


def findings(said: Said) -> dict[str, dict[str, Any]]:
    """Return all findings by name."""
    return {finding["name"]: finding for finding in said.json["findings"]}


def problems(said: Said) -> set[str]:
    """Return the names of all findings but notes."""
    return {name for name, finding in findings(said).items() if finding["severity"] != "note"}


def expect(said: Said, *names: str) -> dict[str, dict[str, Any]]:
    """Check that these problems were found and no others; return all findings."""
    assert problems(said) == set(names), said.out
    assert said.status == 1 or not names, said.out
    return findings(said)
