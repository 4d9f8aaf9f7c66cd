"""The folders of a user: named by the environment, in the home, or nowhere."""

from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.support.user_folder import user_folder


def test_the_environment_goes_first_unless_its_path_is_relative(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("XDG_STATE_HOME", "/var/me")
    assert user_folder("XDG_STATE_HOME", ".local", "state") == Path("/var/me")
    monkeypatch.setenv("XDG_STATE_HOME", "me")
    assert user_folder("XDG_STATE_HOME", ".local", "state") == Path("/home/me/.local/state")


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container: an id that has no name, and no HOME."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr("os.getuid", lambda: 2**31 - 7)
    with pytest.raises(CanductorError, match="this user has no home folder; set HOME or XDG_STATE_HOME"):
        user_folder("XDG_STATE_HOME")
