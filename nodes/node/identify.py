"""Identification of a node's dictionary: recognised by three pieces when it is cached, else downloaded.

A dictionary is identified by its first bytes, its last bytes, and that nothing comes after them. The first
piece holds the compressor's code tables, which depend on the whole text; the last holds the Adler-32 of the
whole text; and the length must be exact. Two builds of one firmware differ at least in their version text,
and the checksum alone agrees by chance for one build in 2^32. If it did, the node would get commands with
another build's ids: the commands that the machine needs are checked against that dictionary as usual, and a
node does not execute a command whose parameters it cannot read.
"""

from collections.abc import Callable
from typing import Final

from nodes.dictionary.cache import CachedDictionary, DictionaryCache
from nodes.dictionary.dictionary import MAX_COMPRESSED_BYTES, Dictionary
from nodes.dictionary.parts import DictionaryError
from nodes.node.errors import NodeLost
from nodes.node.request_reply import QueryTimeout, RequestReply

IDENTIFY_PIECE: Final = 40
PIECE_TRIES: Final = 32
"""A piece takes seven frames and a dictionary about sixty pieces: where one frame in ten is lost, one start
in fifteen would fail with the tries of other queries. The link detects a silent node sooner."""
MAX_CANDIDATES: Final = 4
"""Dictionaries with the same beginning that are compared, at two queries each, before downloading."""


async def identify(
    talk: RequestReply, cache: DictionaryCache, why_silent: Callable[[], Exception | None]
) -> Dictionary:
    """Return the dictionary of the node that TALK talks with.

    Raises DictionaryError when it cannot be used, the error from WHY_SILENT when the node never answered, and
    whatever RequestReply.ask raises.
    """
    try:
        beginning = await _piece(talk, 0)
    except (QueryTimeout, NodeLost):
        better = why_silent()
        if better is not None:
            raise better from None
        raise
    if not beginning:
        raise DictionaryError(f"node {talk.name}: its dictionary is empty; other firmware?")
    known = await _recognised(talk, cache, beginning)
    if known is not None:
        return known
    async with cache.downloading(beginning):
        # A dictionary with the same beginning may have been downloaded during the wait.
        known = await _recognised(talk, cache, beginning)
        if known is not None:
            return known
        compressed = await _download(talk, beginning)
        try:
            dictionary = Dictionary.parse(compressed)
        except DictionaryError as error:
            raise DictionaryError(f"node {talk.name}: {error}") from None
        cache.store(compressed, dictionary)
        return dictionary


async def _recognised(talk: RequestReply, cache: DictionaryCache, beginning: bytes) -> Dictionary | None:
    for cached in cache.candidates(beginning)[:MAX_CANDIDATES]:
        if await _has(talk, cached, len(beginning)):
            cache.used(cached)
            return cached.dictionary
    return None


async def _has(talk: RequestReply, cached: CachedDictionary, piece_size: int) -> bool:
    """Return whether the node's dictionary ends as this one does, at the same length."""
    size = len(cached.compressed)
    tail_at = max(0, size - piece_size)
    if await _piece(talk, tail_at) != cached.compressed[tail_at:]:
        return False
    return await _piece(talk, size) == b""


async def _download(talk: RequestReply, beginning: bytes) -> bytes:
    data = bytearray(beginning)
    while piece := await _piece(talk, len(data)):
        data += piece
        if len(data) > MAX_COMPRESSED_BYTES:
            raise DictionaryError(f"node {talk.name}: its dictionary does not end; other firmware?")
    return bytes(data)


async def _piece(talk: RequestReply, offset: int) -> bytes:
    answer = await talk.ask(
        "identify",
        "identify_response",
        {"offset": offset, "count": IDENTIFY_PIECE},
        matching={"offset": offset},
        tries=PIECE_TRIES,
    )
    return answer.message.data("data")
