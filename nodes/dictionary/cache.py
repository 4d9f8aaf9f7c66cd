"""Cache of downloaded dictionaries, which saves the download at the next start.

In memory for all nodes that share the cache, and on disk for the next start. Files are trusted no more than
bytes off a wire: a file counts only when its content has the SHA-256 of its name, and is parsed with
all the bounds of a download. An invalid file is ignored and replaced by the next download.
"""

import asyncio
import contextlib
import hashlib
import json
import os
import re
import stat
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from nodes.dictionary.dictionary import MAX_COMPRESSED_BYTES, Dictionary
from nodes.dictionary.parts import DictionaryError
from nodes.support.plain_json import read_json
from nodes.support.user_folder import user_folder

MAX_FILES: Final = 64
"""Most files on disk; the least recently used are dropped."""
MAX_KEPT: Final = 64
"""In memory."""
_NAME: Final = re.compile(r"[A-Za-z0-9_.+-]{1,40}-([0-9a-f]{64})\.dict\Z")
_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_.+-]+")
_TEMPORARY: Final = ".new-"
_ADDRESSES: Final = "nodes.json"
MAX_ADDRESSES: Final = 256
"""Of nodes whose dictionary is known; the least recently added are dropped."""


@dataclass(frozen=True, slots=True)
class CachedDictionary:
    """A dictionary, parsed and in its downloaded form."""

    compressed: bytes
    dictionary: Dictionary


class DictionaryCache:
    """Dictionaries by their first bytes; kept in FOLDER, or only in memory when there is none.

    For one event loop. A disk error makes nothing fail: what cannot be read or written counts as not cached,
    and ``problem`` states the reason.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.problem: str | None = None
        """Why the last read or write failed, as a phrase for messages."""
        self.ignored_files = 0
        """Number of files with the name of a dictionary that do not hold one."""
        self._folder = folder
        self._kept: dict[str, CachedDictionary] = {}
        """By SHA-256 of the compressed form; the one used last comes last."""
        self._looked_for: set[bytes] = set()
        self._downloads: dict[bytes, _Download] = {}

    @classmethod
    def of_user(cls) -> "DictionaryCache":
        """Return the cache in the user's own cache folder (XDG_CACHE_HOME); raises CanductorError."""
        return cls(user_folder("XDG_CACHE_HOME", ".cache") / "canductor" / "dictionaries")

    def candidates(self, beginning: bytes) -> list[CachedDictionary]:
        """Return all dictionaries whose compressed form begins like this, most recently used first."""
        assert beginning
        self._read_folder(beginning)
        return [kept for kept in reversed(self._kept.values()) if kept.compressed.startswith(beginning)]

    def all(self) -> list[CachedDictionary]:
        """Return all dictionaries, most recently used first."""
        self._read_folder(b"")
        return list(reversed(self._kept.values()))

    def used(self, cached: CachedDictionary) -> None:
        """Record that a node has this dictionary: it becomes the last to be dropped."""
        key = _sha256(cached.compressed)
        self._keep(key, cached)
        if self._folder is not None:
            with contextlib.suppress(OSError):
                os.utime(self._folder / _file_name(cached, key))

    def store(self, compressed: bytes, dictionary: Dictionary) -> None:
        """Store a dictionary that was downloaded and parsed without an error."""
        cached = CachedDictionary(compressed, dictionary)
        key = _sha256(compressed)
        self._keep(key, cached)
        if self._folder is None:
            return
        try:
            self._write(self._folder, _file_name(cached, key), compressed)
        except OSError as error:
            self.problem = f"cannot write to {self._folder}: {error.strerror or error}"

    def remember(self, address: str, dictionary: Dictionary) -> None:
        """Record that the node at ADDRESS has DICTIONARY, if it is one of the cache."""
        key = next((key for key, kept in self._kept.items() if kept.dictionary is dictionary), None)
        if key is None or self._folder is None:
            return
        addresses = self._addresses()
        if addresses.get(address) == key:
            return
        addresses.pop(address, None)
        addresses[address] = key
        newest = dict(list(addresses.items())[-MAX_ADDRESSES:])
        try:
            self._replace(self._folder, _ADDRESSES, json.dumps(newest, indent=0).encode())
        except OSError as error:
            self.problem = f"cannot write to {self._folder}: {error.strerror or error}"

    def of_node(self, address: str) -> Dictionary | None:
        """Return the dictionary that the node at ADDRESS had when it was last connected; None: not known."""
        key = self._addresses().get(address)
        if key is None:
            return None
        if key not in self._kept:
            self._read_files(b"", (found for found in self._files() if found[1] == key))
        kept = self._kept.get(key)
        return None if kept is None else kept.dictionary

    def _addresses(self) -> dict[str, str]:
        """Return the SHA-256 of the dictionary of each address, the newest last."""
        if self._folder is None:
            return {}
        content = _read(self._folder / _ADDRESSES, b"")
        try:
            found = read_json(content or b"{}")
        except ValueError:
            return {}
        if not isinstance(found, dict):
            return {}
        return {str(address): str(key) for address, key in found.items()}

    @contextlib.asynccontextmanager
    async def downloading(self, beginning: bytes) -> AsyncIterator[None]:
        """Exclude other downloads with the same beginning; look into the cache again inside the context.

        Of thirty equal nodes that start together one downloads, and different ones do not wait.
        """
        download = self._downloads.setdefault(beginning, _Download(asyncio.Lock()))
        download.users += 1
        try:
            async with download.lock:
                yield
        finally:
            download.users -= 1
            if not download.users:
                del self._downloads[beginning]

    # ------------------------------------------------------------------------------------------- in memory

    def _keep(self, key: str, cached: CachedDictionary) -> None:
        self._kept.pop(key, None)
        self._kept[key] = cached
        while len(self._kept) > MAX_KEPT:
            del self._kept[next(iter(self._kept))]

    # --------------------------------------------------------------------------------------------- on disk

    def _read_folder(self, beginning: bytes) -> None:
        """Read the dictionaries of the folder that begin like this; once for each beginning."""
        if beginning in self._looked_for:
            return
        if len(self._looked_for) >= MAX_KEPT:
            self._looked_for.clear()
        self._looked_for.add(beginning)
        self._read_files(beginning, self._files())

    def _read_files(self, beginning: bytes, files: Iterable[tuple[Path, str]]) -> None:
        """Keep those of FILES (path, SHA-256) that begin like this."""
        for path, key in files:
            compressed = None if key in self._kept else _read(path, beginning)
            if compressed is None:
                continue
            cached = _checked(compressed, key)
            if cached is None:
                self.ignored_files += 1
            else:
                self._keep(key, cached)

    def _files(self) -> Iterator[tuple[Path, str]]:
        """Yield the newest MAX_FILES dictionaries with their SHA-256, oldest first."""
        for path in self._oldest_first()[-MAX_FILES:]:
            match = _NAME.match(path.name)
            assert match
            yield path, match[1]

    def _oldest_first(self) -> list[Path]:
        if self._folder is None:
            return []
        found: list[tuple[int, Path]] = []
        try:
            found += (
                (entry.stat(follow_symlinks=False).st_mtime_ns, Path(entry.path))
                for entry in os.scandir(self._folder)
                if _NAME.match(entry.name)
            )
        except FileNotFoundError:
            pass  # nothing was cached yet, or another process just dropped a file
        except OSError as error:
            self.problem = f"cannot read {self._folder}: {error.strerror or error}"
        return [path for _, path in sorted(found)]

    def _write(self, folder: Path, name: str, compressed: bytes) -> None:
        self._replace(folder, name, compressed)
        for path in self._oldest_first()[:-MAX_FILES]:
            path.unlink(missing_ok=True)

    @staticmethod
    def _replace(folder: Path, name: str, content: bytes) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # Another process may write the same: each writes a file of its own and renames it when complete.
        temporary = folder / f"{_TEMPORARY}{os.getpid()}"
        try:
            temporary.write_bytes(content)
            temporary.replace(folder / name)
        finally:
            temporary.unlink(missing_ok=True)


@dataclass(slots=True)
class _Download:
    lock: asyncio.Lock
    users: int = 0


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _checked(compressed: bytes, key: str) -> CachedDictionary | None:
    """Parse the content of a file; None when it does not match its name or is not a dictionary."""
    if _sha256(compressed) != key:
        return None
    try:
        return CachedDictionary(compressed, Dictionary.parse(compressed))
    except DictionaryError:
        return None


def _file_name(cached: CachedDictionary, key: str) -> str:
    version = _NOT_IN_NAMES.sub("_", cached.dictionary.version)[:40]
    return f"{version or 'unknown'}-{key}.dict"


def _read(path: Path, beginning: bytes) -> bytes | None:
    """Return the content of a regular file that begins like this and is not too large, else None."""
    try:
        # A symbolic link could lead anywhere, and opening a pipe would wait for its other end.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_COMPRESSED_BYTES:
            return None
        compressed = os.read(descriptor, MAX_COMPRESSED_BYTES)
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return compressed if compressed.startswith(beginning) else None
