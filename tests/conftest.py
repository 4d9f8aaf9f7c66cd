"""What holds for all tests."""

import signal

import pytest

from tests import profiles

profiles.register()

# A shell that starts a job in the background has it ignore Ctrl-C, and children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

WAITING_FIRST = ("tests/smoke", "tests/coordinator/web/test_page.py")
"""What waits for real processes most of its time: others' work fills that time when these begin first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what waits; the order is kept otherwise (with --no-loadscope-reorder also by xdist)."""
    items.sort(key=lambda item: not item.nodeid.startswith(WAITING_FIRST))
