"""Which dictionary each node of a bus has: given in a file, fetched by a caller, or learnt by listening.

A host downloads a node's dictionary with ``identify``, in pieces that everybody on the bus can read. A host
that knows it already asks only for three pieces, by which the user's cache knows it here too. And of a node
that was running before anybody listened, the cache may have the dictionary that explains what it says
(guess.py).
"""

import argparse
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from canbus_tools.protocol.guess import Guess
from canbus_tools.protocol.protocol import Direction
from nodes.dictionary.cache import CachedDictionary, DictionaryCache
from nodes.dictionary.dictionary import MAX_COMPRESSED_BYTES, MAX_INFLATED_BYTES, Dictionary
from nodes.dictionary.parts import DictionaryError
from nodes.support.can_protocol import DATA_NODEID_MAX
from nodes.support.errors import CanductorError
from nodes.support.option_values import Assignments, existing_file, parse_assignment, parse_int
from nodes.support.regular_file import read_regular

GIVEN: Final = "given"
LEARNT: Final = "learnt from the bus"
CACHED: Final = "recognised from the cache"
GUESSED: Final = "guessed from the cache"


class DictionarySource:
    """The dictionaries of one bus's nodes by node id; one thread."""

    def __init__(
        self, given: Mapping[int, Dictionary] | None = None, cache: DictionaryCache | None = None
    ) -> None:
        self.known: dict[int, Dictionary] = dict(given or {})
        """By node id. Read it; change it with ``put`` and ``forget``."""
        self.origins: dict[int, str] = dict.fromkeys(self.known, GIVEN)
        """In words, where each came from."""
        self.fitting: dict[int, tuple[Dictionary, ...]] = {}
        """By node id, of a guess: all dictionaries that explain what was heard; the first one is taken."""
        self._cache = cache
        self._downloads: dict[int, _Download] = {}
        self._guesses: dict[int, Guess] = {}

    def put(self, nodeid: int, dictionary: Dictionary, origin: str = GIVEN) -> None:
        """Set a node's dictionary; one with the origin GIVEN is not changed by what the bus says."""
        self.known[nodeid] = dictionary
        self.origins[nodeid] = origin
        self.fitting.pop(nodeid, None)

    def forget(self, nodeid: int) -> None:
        """Drop what was learnt: another board has the id now."""
        self._downloads.pop(nodeid, None)
        self._guesses.pop(nodeid, None)
        if self.origins.get(nodeid) != GIVEN:
            self._drop(nodeid)

    def hear(self, nodeid: int, offset: int, data: bytes) -> Dictionary | None:
        """Take an ``identify_response``; returns the dictionary when this piece made it known."""
        if self.origins.get(nodeid) == GIVEN:
            return None
        download = self._downloads.get(nodeid)
        if offset == 0 and data and (download is None or not download.began_with(data)):
            self.forget(nodeid)  # the first one, or another firmware
            candidates = self._cache.candidates(data) if self._cache else ()
            download = self._downloads[nodeid] = _Download(candidates)
        if download is None or download.finished:
            return None
        found = download.take(offset, data)
        if found is not None:
            self._remember(found, complete=download.complete)
            self.put(nodeid, found.dictionary, LEARNT if download.complete else CACHED)
        return None if found is None else found.dictionary

    def unread(self, nodeid: int, direction: Direction, content: bytes, time_s: float) -> bool:
        """Take what a block holds that the node's dictionary, if there is one, does not explain.

        Tells whether that made a dictionary known that does: a guess (``fitting`` has what it rests upon).
        """
        if self.origins.get(nodeid, GUESSED) != GUESSED or self._cache is None:
            return False
        guess = self._guesses.get(nodeid)
        if guess is None:
            guess = self._guesses[nodeid] = Guess(cached.dictionary for cached in self._cache.all())
        if nodeid in self.known:  # a guess that this contradicts
            guess.refuse(self.known[nodeid])
            self._drop(nodeid)
        fitting = guess.take(direction, content, time_s)
        if fitting:
            self.put(nodeid, fitting[0], GUESSED)
            self.fitting[nodeid] = fitting
        return bool(fitting)

    def is_open(self, nodeid: int) -> bool:
        """Return whether the dictionary is unknown, but may be in the cache."""
        guess = self._guesses.get(nodeid)
        return nodeid not in self.known and guess is not None and guess.is_open

    def _drop(self, nodeid: int) -> None:
        self.known.pop(nodeid, None)
        self.origins.pop(nodeid, None)
        self.fitting.pop(nodeid, None)

    def _remember(self, found: CachedDictionary, *, complete: bool) -> None:
        """Let the user's cache have what was heard: next time listening for a second may be enough."""
        if self._cache is None:
            return
        if complete:
            self._cache.store(found.compressed, found.dictionary)
        else:
            self._cache.used(found)


class _Download:
    """One node's dictionary, piece by piece as another host reads it; bounded."""

    def __init__(self, candidates: Sequence[CachedDictionary]) -> None:
        self.finished = False
        """Known, or given up."""
        self.complete = False
        """Read to its end."""
        self._compressed = bytearray()
        self._first_size = 0
        self._inflater = zlib.decompressobj()
        self._inflated_bytes = 0
        self._candidates = list(candidates)
        self._agreed_at: set[int] = set()

    def began_with(self, data: bytes) -> bool:
        size = min(len(data), self._first_size)
        return self._compressed[:size] == data[:size]

    def take(self, offset: int, data: bytes) -> CachedDictionary | None:
        if offset == len(self._compressed) and data:
            found = self._append(data)
            if self.finished:
                return found
        return self._recognise(offset, data) if offset else None

    def _append(self, data: bytes) -> CachedDictionary | None:
        self._first_size = self._first_size or len(data)
        self._compressed += data
        try:
            self._inflated_bytes += len(self._inflater.decompress(data, MAX_INFLATED_BYTES))
            if self._inflater.eof:
                self.finished = self.complete = True
                compressed = bytes(self._compressed)
                return CachedDictionary(compressed, Dictionary.parse(compressed))
        except (zlib.error, DictionaryError):
            self.finished = True  # what cannot be used is not there
            return None
        # unconsumed_tail: this piece alone inflates to more than any dictionary may have.
        beyond = self._inflater.unconsumed_tail or self._inflated_bytes > MAX_INFLATED_BYTES
        self.finished = bool(beyond) or len(self._compressed) > MAX_COMPRESSED_BYTES
        return None

    def _recognise(self, offset: int, data: bytes) -> CachedDictionary | None:
        """Compare with the cache; a host's proof is the last piece, and that nothing follows it."""
        if data:
            self._agreed_at.add(offset + len(data))
            self._candidates = [
                c for c in self._candidates if c.compressed[offset : offset + len(data)] == data
            ]
            if len(self._agreed_at) > MAX_COMPRESSED_BYTES // 8:
                self._candidates = []
            return None
        if offset not in self._agreed_at:
            return None
        for candidate in self._candidates:
            if len(candidate.compressed) == offset:
                self.finished = True
                return candidate
        return None


# ---------------------------------------------------------------------------------------------------- options


def declare_dictionaries(command: argparse.ArgumentParser) -> None:
    """Add the option ``dictionaries``: by node id, read from files."""
    command.add_argument(
        "--dictionary",
        dest="dictionaries",
        type=_node_dictionary,
        action=Assignments,
        metavar="NODE=FILE",
        help="dictionary of node NODE, as JSON or as downloaded (default: learnt from traffic)",
    )


def _node_dictionary(text: str) -> tuple[int, Dictionary]:
    node, path = parse_assignment(text, Path)
    return parse_int(node, 1, DATA_NODEID_MAX, name="NODE"), read_dictionary(path)


def read_dictionary(path: Path) -> Dictionary:
    """Read a dictionary's file, JSON or zlib-compressed; raises CanductorError."""
    existing_file(path)
    try:
        content = read_regular(path, MAX_INFLATED_BYTES + 1)
    except OSError as error:
        raise CanductorError(f"dictionary '{path}' cannot be read: {error.strerror or error}") from None
    try:
        plain = content.lstrip()[:1] == b"{"
        return Dictionary.from_json(content) if plain else Dictionary.parse(content)
    except DictionaryError as error:
        raise CanductorError(f"'{path}': {error}") from None
