"""What holds for all tests."""

import threading

import pytest
from hypothesis import settings

from tests.standstill import Repeating, Watcher

# How long an example takes says how busy the machine is, and nothing else.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def pytest_configure(config: pytest.Config) -> None:
    """Have tests repeated that failed while the computer stood still."""
    watcher = Watcher()
    threading.Thread(target=watcher.run, name="standstill", daemon=True).start()
    config.pluginmanager.register(Repeating(watcher))
