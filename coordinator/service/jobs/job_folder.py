"""The job folder: the only files that clients can have printed, whatever names they send."""

import contextlib
import fcntl
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from coordinator.gcode.program import Program, UnchangedFile
from coordinator.support.job_names import DEPTH_MAX, is_job_name, is_plain_part, job_path_parts
from nodes.support.errors import CanductorError

FILES_MAX: Final = 10_000
"""Looked at for one list."""
_NO_LINK: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC


class NoSuchJob(CanductorError):  # noqa: N818
    """There is no such file for a job."""


@dataclass(frozen=True, slots=True)
class JobFile:
    """A file that can be printed."""

    name: str
    """Relative to the job folder, parts separated by ``/``."""
    size_bytes: int
    modified_s: float
    """Since the epoch."""


class JobFolderInUse(CanductorError):  # noqa: N818
    """Another service has the job folder."""


class JobFolderClaim:
    """Makes the job folder PATH this service's until ``close``; raises JobFolderInUse.

    Two services would remove each other's uploads and overwrite each other's journal. The lock ends with the
    process, however that ends. A disk without locks, or no folder, is no reason to refuse.
    """

    def __init__(self, path: Path) -> None:
        self._fd: int | None = None
        with contextlib.suppress(OSError):
            self._fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        if self._fd is None:
            return
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise JobFolderInUse(
                f"the job folder {path} is used by another service; end that one, or use another folder"
            ) from None
        except OSError:
            self.close()

    def close(self) -> None:
        """Let others have it."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)


class JobFolder:
    """The files below PATH. Links are not followed, wherever they lead: not to files, not to folders.

    Every method reads a disk: not for the control loop.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def files(self) -> list[JobFile]:
        """Return the g-code files by name, the first FILES_MAX found; raises NoSuchJob without a folder."""
        try:
            root = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise NoSuchJob(_no_folder(self.path, error)) from None
        found: list[JobFile] = []
        try:
            for _, (folder, names, fd) in zip(range(FILES_MAX), _walk(root), strict=False):
                found += list(_jobs_of(folder, names, fd))[: FILES_MAX - len(found)]
        finally:
            os.close(root)
        return sorted(found, key=lambda job: job.name)

    def open(self, name: str) -> Program:
        """Open the file NAME, relative to the folder; raises NoSuchJob."""
        clean = "/".join(_parts(name))
        source = UnchangedFile(self._open(name), clean)
        status = source.status
        return Program(source, clean, size_bytes=status.st_size, modified_ns=status.st_mtime_ns)

    def head(self, name: str, size_bytes: int) -> bytes:
        """Return the first SIZE_BYTES of the file NAME; raises NoSuchJob."""
        with os.fdopen(self._open(name), "rb") as file:
            return file.read(size_bytes)

    def _open(self, name: str) -> int:
        """Return a descriptor of the file NAME; raises NoSuchJob."""
        parts = _parts(name)
        try:
            fd = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise NoSuchJob(_no_folder(self.path, error)) from None
        with contextlib.ExitStack() as opened:
            opened.callback(os.close, fd)
            try:
                for folder in parts[:-1]:
                    fd = os.open(folder, _NO_LINK | os.O_DIRECTORY, dir_fd=fd)
                    opened.callback(os.close, fd)
                fd = os.open(parts[-1], _NO_LINK | os.O_NONBLOCK, dir_fd=fd)  # a pipe is not waited for
            except OSError:
                raise NoSuchJob(
                    f"there is no file {_shown(name)} in the job folder; job.list returns those that exist"
                ) from None
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise NoSuchJob(f"{_shown(name)} in the job folder is not a file")
        return fd


def _parts(name: str) -> tuple[str, ...]:
    """Return the parts of a clean relative path; raises NoSuchJob for any other."""
    parts = job_path_parts(name)
    if not parts:
        raise NoSuchJob(
            f"{_shown(name)} is not the name of a job; use the name of a file as job.list returns it"
        )
    return parts


def _shown(name: str) -> str:
    return ascii(name if len(name) <= 60 else name[:60] + "...")


def _no_folder(path: Path, error: OSError) -> str:
    return f"the job folder {path} cannot be read: {(error.strerror or str(error)).lower()}; make it"


def _walk(root: int) -> Iterator[tuple[str, list[str], int]]:
    """Go through the folders below ROOT: name, entries and descriptor of each."""
    for folder, folders, names, fd in os.fwalk(".", dir_fd=root, follow_symlinks=False):
        clean = folder[2:] if folder.startswith("./") else ""
        depth = clean.count("/") + 1 if clean else 0
        folders[:] = [] if depth >= DEPTH_MAX - 1 else list(filter(is_plain_part, folders))
        yield clean, names, fd


def _jobs_of(folder: str, names: list[str], fd: int) -> Iterator[JobFile]:
    for name in names:
        if not is_job_name(name):
            continue
        try:
            status = os.stat(name, dir_fd=fd, follow_symlinks=False)
        except OSError:
            continue  # gone meanwhile
        if stat.S_ISREG(status.st_mode):
            yield JobFile(f"{folder}/{name}" if folder else name, status.st_size, status.st_mtime)
