"""Files that clients put into the job folder: one plain name each, in parts, visible only once complete."""

import asyncio
import contextlib
import errno
import os
import shutil
import stat
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, Final

from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope, shown
from coordinator.support.job_names import NAME_BYTES_MAX, RULE, SUFFIXES, is_job_name
from coordinator.support.values import Value

PART_MAX: Final = 32_768
"""Characters of one part; however they are written, a message holds them."""
SIZE_MAX: Final = 2**31
PARTS_MAX: Final = 4
"""Files of one client that are not complete."""
FREE_MIN: Final = 256 * 2**20
"""Bytes of the disk that stay free: the journal and the logs need some."""
_ENDS: Final = ", ".join(SUFFIXES)
_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
_PARTIAL: Final = ".part"
_NO_LINKS: Final = (errno.EPERM, errno.ENOTSUP, errno.EMLINK)
"""Of a disk without hard links."""


def upload_method(folder: Path) -> Method:
    """Return the method "job.upload", which writes into FOLDER and nowhere else; removes parts left there."""
    _remove_left(folder)
    uploads = _Uploads(folder)
    return Method(
        "job.upload",
        Scope.OPERATE,
        "Write a part of a file for the job folder; the file appears with its last part.",
        uploads.upload,
        (
            Param(
                "file",
                Kind.STR,
                f"a plain name that ends in one of {', '.join(SUFFIXES)}",
                high=NAME_BYTES_MAX,
            ),
            Param("offset", Kind.INT, "bytes sent before; 0 starts over", "bytes", low=0, high=SIZE_MAX),
            Param("text", Kind.STR, "the text at that offset", high=PART_MAX),
            Param("done", Kind.BOOL, "this is the last part", required=False, default=False),
            Param(
                "replace", Kind.BOOL, "overwrite an existing file of that name", required=False, default=False
            ),
        ),
        (Param("size_bytes", Kind.INT, "so far", "bytes"),),
    )


@dataclass(slots=True, eq=False)
class _Part:
    """A file that is not complete; its OWNER is who began it."""

    owner: Caller
    lock: Lock = field(default_factory=Lock)
    """Of the threads that write or remove it."""
    gone: bool = False


class _Uploads:
    """The files of FOLDER that are not complete: each is its client's, and goes with it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._parts: dict[str, _Part] = {}

    async def upload(self, caller: Caller, params: dict[str, Any]) -> Value:
        """Write a part."""
        name, offset = params["file"], params["offset"]
        _check_name(name)
        part = self._part(caller, name, offset)
        try:
            size = await asyncio.to_thread(_write, self._folder, params, part)
        except (OSError, ApiError) as error:
            if offset == 0 or isinstance(error, _FullError | OSError):
                await self._drop(name, part)  # what a failed call left of it is not known
            if isinstance(error, ApiError):
                raise
            raise ApiError("failed", f"{shown(name)} cannot be written: {error.strerror or error}") from None
        if params["done"]:
            self._forget(name, part)
        return {"size_bytes": size}

    def _part(self, caller: Caller, name: str, offset: int) -> _Part:
        part = self._parts.get(name)
        if part is not None and part.owner is not caller:
            raise ApiError("busy", f"another client is uploading {shown(name)}; wait, or choose another name")
        if part is not None:
            return part
        if offset:
            raise ApiError(
                "bad_params",
                f"{shown(name)} has 0 bytes so far of this client, not {offset}; start over with offset 0",
            )
        if sum(1 for other in self._parts.values() if other.owner is caller) >= PARTS_MAX:
            raise ApiError("busy", f"{PARTS_MAX} files of this client are not complete; finish those first")
        part = self._parts[name] = _Part(caller)
        if self._left not in caller.at_end:
            caller.at_end.append(self._left)
        return part

    def _left(self, caller: Caller) -> None:
        loop = asyncio.get_running_loop()
        for name, part in list(self._parts.items()):
            if part.owner is caller:
                self._forget(name, part)
                loop.run_in_executor(None, _remove, self._folder, name, part)

    async def _drop(self, name: str, part: _Part) -> None:
        self._forget(name, part)
        await asyncio.to_thread(_remove, self._folder, name, part)

    def _forget(self, name: str, part: _Part) -> None:
        if self._parts.get(name) is part:
            del self._parts[name]


class _FullError(ApiError):
    """The disk is full."""

    def __init__(self, free: int) -> None:
        super().__init__(
            "failed",
            f"the job folder's disk has {free >> 20:,} MiB left, of which {FREE_MIN >> 20} stay free;"
            " free some space there, then upload it again",
        )


def _partial_of(name: str) -> str:
    return f".{name}{_PARTIAL}"


def _remove(folder: Path, name: str, part: _Part) -> None:
    """Remove what there is of PART, and let no thread write it any more."""
    with part.lock:
        if not part.gone:
            part.gone = True
            _unlink(folder / _partial_of(name))


def _remove_left(folder: Path) -> None:
    """Remove what a service left that was killed; links and folders are none of ours."""
    with contextlib.suppress(OSError):  # who writes there says what is wrong
        for path in list(folder.iterdir()):
            name = path.name.removeprefix(".").removesuffix(_PARTIAL)
            if path.name == _partial_of(name) and is_job_name(name):
                _unlink(path)


def _unlink(path: Path) -> None:
    with contextlib.suppress(OSError):
        if stat.S_ISREG(path.lstat().st_mode):
            path.unlink()


def _write(folder: Path, params: dict[str, Any], part: _Part) -> int:
    directory = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with part.lock:
            if part.gone:
                raise ApiError("cancelled", f"{shown(params['file'])} is complete, or its client has left")
            return _write_into(directory, params, part)
    finally:
        os.close(directory)


def _write_into(directory: int, params: dict[str, Any], part: _Part) -> int:
    name, offset, data = params["file"], params["offset"], params["text"].encode()
    if not params["replace"] and _exists(name, directory):
        raise _exists_error(name)
    if (free := shutil.disk_usage(directory).free) - len(data) < FREE_MIN:
        raise _FullError(free)
    partial = _partial_of(name)
    out = os.open(partial, _FLAGS | (0 if offset else os.O_TRUNC), 0o644, dir_fd=directory)
    try:
        size = _append(out, name, offset, data)
        if params["done"]:
            os.fsync(out)
            _show(directory, partial, name, replace=params["replace"])
            part.gone = True
            os.fsync(directory)
    finally:
        os.close(out)
    return size


def _show(directory: int, partial: str, name: str, *, replace: bool) -> None:
    """Give the file PARTIAL its NAME; raises ApiError where that exists by now, unless REPLACE."""
    folders = {"src_dir_fd": directory, "dst_dir_fd": directory}
    if not replace:
        try:
            os.link(partial, name, **folders, follow_symlinks=False)
        except FileExistsError:
            raise _exists_error(name) from None
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
        else:
            os.unlink(partial, dir_fd=directory)
            return
    os.rename(partial, name, **folders)  # noqa: PTH104 (in an open folder)


def _exists_error(name: str) -> ApiError:
    return ApiError("file_exists", f"{shown(name)} exists already; choose another name, or set replace")


def _append(out: int, name: str, offset: int, data: bytes) -> int:
    status = os.fstat(out)
    if not stat.S_ISREG(status.st_mode) or status.st_size != offset:
        raise ApiError(
            "bad_params",
            f"{shown(name)} has {status.st_size} bytes so far, not {offset}; start over with offset 0",
        )
    if offset + len(data) > SIZE_MAX:
        raise ApiError("bad_params", f"{shown(name)} gets longer than {SIZE_MAX:,} bytes")
    os.lseek(out, offset, os.SEEK_SET)
    view = memoryview(data)
    while view:
        view = view[os.write(out, view) :]
    return offset + len(data)


def _exists(name: str, directory: int) -> bool:
    try:
        os.stat(name, dir_fd=directory, follow_symlinks=False)
    except FileNotFoundError:
        return False
    return True


def _check_name(name: str) -> None:
    if not is_job_name(name):
        raise ApiError("bad_params", f"{shown(name)} must be {RULE}")
