"""Files that clients put into the job folder: one plain name each, in parts, visible only once complete."""

import asyncio
import os
import stat
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.methods import ApiError, Caller, Kind, Method, Param, Scope, Value, shown

PART_MAX: Final = 32_768
"""Characters of one part; however they are written, a message holds them."""
SIZE_MAX: Final = 2**31
NAME_MAX: Final = 128
SUFFIXES: Final = (".gcode", ".gco", ".g", ".nc", ".ngc")
_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
_PARTIAL: Final = ".part"


def upload_method(folder: Path) -> Method:
    """Return the method "job.upload", which writes into FOLDER and nowhere else."""

    async def upload(_: Caller, params: dict[str, Any]) -> Value:
        try:
            size = await asyncio.to_thread(_write, folder, params)
        except OSError as error:
            name = shown(params["file"])
            raise ApiError("failed", f"{name} cannot be written: {error.strerror or error}") from None
        return {"size_bytes": size}

    return Method(
        "job.upload",
        Scope.OPERATE,
        "Write a part of a file for the job folder; the file is there once the last part is.",
        upload,
        (
            Param("file", Kind.STR, f"a plain name that ends in one of {', '.join(SUFFIXES)}", high=NAME_MAX),
            Param("offset", Kind.INT, "bytes sent before; 0 begins anew", "bytes", low=0, high=SIZE_MAX),
            Param("text", Kind.STR, "what comes there", high=PART_MAX),
            Param("done", Kind.BOOL, "this is the last part", required=False, default=False),
            Param("replace", Kind.BOOL, "a file of that name may be there", required=False, default=False),
        ),
        (Param("size_bytes", Kind.INT, "so far", "bytes"),),
    )


def _write(folder: Path, params: dict[str, Any]) -> int:
    name, offset = params["file"], params["offset"]
    data = params["text"].encode()
    _check_name(name)
    directory = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not params["replace"] and _exists(name, directory):
            raise ApiError("file_exists", f"{shown(name)} is there already; choose another name, or replace")
        partial = f".{name}{_PARTIAL}"
        out = os.open(partial, _FLAGS | (0 if offset else os.O_TRUNC), 0o644, dir_fd=directory)
        try:
            size = _append(out, name, offset, data)
            if params["done"]:
                os.fsync(out)
                os.rename(partial, name, src_dir_fd=directory, dst_dir_fd=directory)
        finally:
            os.close(out)
    finally:
        os.close(directory)
    return size


def _append(out: int, name: str, offset: int, data: bytes) -> int:
    status = os.fstat(out)
    if not stat.S_ISREG(status.st_mode) or status.st_size != offset:
        raise ApiError(
            "bad_params", f"{shown(name)} has {status.st_size} bytes so far, not {offset}; begin anew"
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
    plain = name.isprintable() and "/" not in name and not name.startswith((".", "-"))
    if not plain or not name.lower().endswith(SUFFIXES):
        raise ApiError(
            "bad_params", f"{shown(name)} must be a plain name that ends in one of {', '.join(SUFFIXES)}"
        )
