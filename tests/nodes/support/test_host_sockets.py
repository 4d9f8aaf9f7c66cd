"""Where the sockets of this user's machines are looked for, however the machines were started."""

import os
import socket
from pathlib import Path

import pytest

from nodes.support.host_sockets import (
    SYSTEM_FOLDERS,
    folder_problem,
    folder_problems,
    host_sockets,
    socket_folder,
    socket_folders,
)
from tests.stages.own_sockets import own_sockets

UNIT = Path(__file__).parents[3] / "docs" / "examples" / "systemd" / "canductor.service"
LOOKED_INTO = "nodes.support.host_sockets.SYSTEM_FOLDERS"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder that the environment names; the working folder is its parent."""
    own_sockets(monkeypatch, tmp_path / "run")
    monkeypatch.chdir(tmp_path)  # the path of a socket has 107 bytes
    return tmp_path / "run" / "canductor"


def leave_socket(path: str) -> Path:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(path)
    return Path(path)


def test_machines_are_looked_for_also_where_others_start_them(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service of the system has no XDG_RUNTIME_DIR: what a login shell looked for was not there."""
    mine = leave_socket("run/canductor/mine.sock")
    (tmp_path / f"of-{os.geteuid()}").mkdir(mode=0o700)
    of_system = leave_socket(f"of-{os.geteuid()}/theirs.sock")
    monkeypatch.setattr(LOOKED_INTO, (f"{tmp_path}/none", f"{tmp_path}/of-{{uid}}"))
    assert host_sockets() == sorted((tmp_path / mine, tmp_path / of_system))
    assert socket_folder() == folder  # where a new one gets its own


def test_the_folders_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    shell = [Path("/run/user/1000/canductor"), Path("/run/canductor"), Path("/tmp/canductor-1000")]  # noqa: S108
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert (socket_folder(), socket_folders()) == (shell[0], shell)
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("TMPDIR", "/home/me/tmp")
    assert (socket_folder(), sorted(socket_folders())) == (shell[2], sorted(shell))


def test_the_systemd_unit_has_its_socket_where_it_is_looked_for() -> None:
    unit = UNIT.read_text()
    path = Path(unit.split("--ipc ")[1].split()[0])
    assert str(path.parent) in SYSTEM_FOLDERS
    assert f"\nRuntimeDirectory={path.parent.relative_to('/run')}\n" in unit


def test_one_socket_is_one_machine_whatever_leads_to_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where XDG_RUNTIME_DIR goes by /var/run: a stop asked which of the two machines was meant."""
    (tmp_path / "var").symlink_to("run")
    monkeypatch.setattr(LOOKED_INTO, (f"{tmp_path}/var/canductor",))
    leave_socket("run/canductor/mine.sock")
    assert host_sockets() == [folder / "mine.sock"]


def test_what_is_no_socket_is_none(folder: Path) -> None:
    (folder / "file.sock").touch()
    (folder / "nothing.sock").symlink_to("none")
    (folder / "long.sock").symlink_to("x" * 256)
    leave_socket("run/canductor/other")
    assert host_sockets() == []


@pytest.mark.parametrize("spoiled", ["owner", "group", "others", "link"])
def test_a_folder_that_others_may_have_made_is_not_used(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoiled: str
) -> None:
    """In /tmp anybody may be first: a socket of his answered a stop with a lie, and got what was sent."""
    leave_socket("run/canductor/mine.sock")
    assert folder_problem(folder) is None
    if spoiled == "owner":
        owner = os.geteuid()
        monkeypatch.setattr("os.geteuid", lambda: owner + 1)
    elif spoiled == "link":
        folder = folder.rename(tmp_path / "elsewhere")
        (tmp_path / "run" / "canductor").symlink_to(folder)
    else:
        folder.chmod(0o720 if spoiled == "group" else 0o702)
    assert host_sockets() == []
    must = "must be a folder of this user's, no link, that nobody else may write to"
    assert folder_problems() == [f"{tmp_path}/run/canductor {must}"]


@pytest.mark.parametrize("name", ["x" * 256, "file", "loop"])
def test_a_folder_that_cannot_be_looked_at_hides_no_other(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """As after ``su``: XDG_RUNTIME_DIR is that of another user, and a stop ended as an internal error."""
    leave_socket("run/canductor/mine.sock")
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / name))
    monkeypatch.setattr(LOOKED_INTO, (str(folder),))
    assert host_sockets() == [folder / "mine.sock"]
    (problem,) = folder_problems()
    assert problem.startswith(f"{tmp_path / name / 'canductor'} cannot be looked at: ")


def test_a_full_disk_hides_no_machine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python finds its folder for temporary files by writing one: a stop ended as an internal error."""

    def full() -> str:
        raise FileNotFoundError("no usable temporary directory found")

    monkeypatch.setattr("tempfile.gettempdir", full)
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(LOOKED_INTO, (str(folder),))
    leave_socket("run/canductor/mine.sock")
    assert folder / "mine.sock" in host_sockets()
