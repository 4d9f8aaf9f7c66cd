"""The dictionary cache: what is recognised, what is downloaded, and what a hostile folder can do."""

import hashlib
import json
import os
import random
import zlib
from pathlib import Path
from typing import Any

import pytest

from nodes.bus.can_bus import CanBus
from nodes.dictionary.cache import MAX_FILES, MAX_KEPT, DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.parts import DictionaryError
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.machine import make_config, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode, source_of


def build(version: str, *, level: int = -1, **parts: Any) -> TwinNode:
    source = source_of(version=version, **parts)
    return TwinNode(source=source, compressed=zlib.compress(json.dumps(source).encode(), level))


def start(cache: DictionaryCache, *twins: TwinNode, loss: float = 0.0) -> CanBus:
    """Start a bus with TWINS on it, all of them READY at the end, and close it."""
    for number, twin in enumerate(twins, 1):
        twin.reset()
        twin.uuid = uuid(number)
        twin.executed.clear()
    bus = CanBus("can0", TwinIO(list(twins), loss=loss, seed=1), cache=cache)
    for number in range(1, len(twins) + 1):
        bus.add_node(f"node{number}", uuid(number), make_config())

    async def main() -> None:
        await bus.start()
        assert all(node.state is NodeState.READY for node in bus.nodes)
        await bus.close()

    virtual_time.run(main())
    return bus


def asked(twin: TwinNode) -> int:
    return sum(line.startswith("identify") for line in twin.executed)


def full(twin: TwinNode) -> int:
    return len(range(0, len(twin.compressed), 40)) + 1


def test_what_was_downloaded_once_is_recognised_by_three_pieces(tmp_path: Path) -> None:
    twin = build("v1")
    start(DictionaryCache(tmp_path / "deep" / "down"), twin)
    assert asked(twin) == full(twin) > 10
    again = DictionaryCache(tmp_path / "deep" / "down")
    bus = start(again, twin)
    assert asked(twin) == 3
    assert again.problem is None
    [path] = (tmp_path / "deep" / "down").iterdir()
    assert path.name == f"v1-{hashlib.sha256(twin.compressed).hexdigest()}.dict"
    assert path.read_bytes() == twin.compressed
    assert bus.nodes[0].dictionary.version == "v1"
    assert again.candidates(twin.compressed[:40])[0].dictionary.version == "v1"


def test_the_memory_alone_knows_a_restarted_node() -> None:
    cache, twin = DictionaryCache(), build("v1")
    start(cache, twin)
    start(cache, twin)
    assert asked(twin) == 3


def test_of_equal_nodes_that_start_together_one_downloads() -> None:
    twins = [build("v1") for _ in range(12)]
    start(DictionaryCache(), *twins)
    counts = sorted(asked(twin) for twin in twins)
    assert counts[-1] == full(twins[0])
    assert counts[:-1] == [3] * 11


def test_of_equal_nodes_on_a_lossy_bus_all_get_it() -> None:
    twins = [build("v1") for _ in range(8)]
    start(DictionaryCache(), *twins, loss=0.05)
    assert sum(asked(twin) for twin in twins) < full(twins[0]) + 8 * 3 * 2 < 8 * full(twins[0])


@pytest.mark.parametrize("other", ["v2", "a much longer version of it"])
def test_another_build_is_downloaded(tmp_path: Path, other: str) -> None:
    cache = DictionaryCache(tmp_path)
    start(cache, build("v1"))
    twin = build(other)
    start(cache, twin)
    assert asked(twin) >= full(twin)
    assert len(list(tmp_path.iterdir())) == 2


def test_the_same_beginning_with_another_end_is_downloaded() -> None:
    # Stored without compression, the first piece says nothing of what comes later.
    first, second = (
        build("v1", level=0, config=source_of()["config"] | {"MCU": name}) for name in ("simulX", "simulY")
    )
    assert first.compressed[:40] == second.compressed[:40]
    cache = DictionaryCache()
    third = build("v1", level=0, config=source_of()["config"] | {"MCU": "simulX"})
    start(cache, first, second, third)
    assert asked(second) >= full(second)
    assert asked(third) <= 3 + 3  # compared with both
    found = {kept.dictionary.str_constant("MCU") for kept in cache.candidates(first.compressed[:40])}
    assert found == {"simulX", "simulY"}


def test_a_longer_dictionary_that_contains_a_cached_one_is_not_taken_for_it() -> None:
    cache, twin = DictionaryCache(), build("v1")
    start(cache, twin)
    longer = build("v1")
    longer.compressed += b"more"
    start(cache, longer)
    assert asked(longer) >= full(longer)


# --------------------------------------------------------------------------------------- hostile folders


def stored(folder: Path, twin: TwinNode) -> Path:
    DictionaryCache(folder).store(twin.compressed, Dictionary.parse(twin.compressed))
    [path] = folder.iterdir()
    return path


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_file_is_ignored_and_replaced(tmp_path: Path, seed: int) -> None:
    twin = build("v1")
    path = stored(tmp_path, twin)
    source = random.Random(seed)
    damaged = bytearray(twin.compressed)
    damaged[source.randrange(40, len(damaged))] ^= 1 << source.randrange(8)
    path.write_bytes(damaged if seed % 2 else twin.compressed[: source.randrange(40, len(damaged))])
    cache = DictionaryCache(tmp_path)
    start(cache, twin)
    assert (asked(twin), cache.ignored_files) == (full(twin), 1)
    assert path.read_bytes() == twin.compressed


def test_a_file_with_the_right_hash_that_is_no_dictionary_is_ignored(tmp_path: Path) -> None:
    bomb = zlib.compress(bytes(10 << 20))
    (tmp_path / f"v1-{hashlib.sha256(bomb).hexdigest()}.dict").write_bytes(bomb)
    cache = DictionaryCache(tmp_path)
    assert cache.candidates(bomb[:40]) == []
    assert cache.ignored_files == 1


@pytest.mark.parametrize("content", ["[" * 100_000, "{", "7"])
def test_damaged_addresses_are_ignored(tmp_path: Path, content: str) -> None:
    (tmp_path / "nodes.json").write_text(content)
    assert DictionaryCache(tmp_path).of_node("can0/000000000001") is None


def test_of_a_node_that_is_known_one_file_is_read(tmp_path: Path) -> None:
    first, second = build("v1"), build("v2")
    stored(tmp_path, first).write_bytes(b"damaged")
    cache = DictionaryCache(tmp_path)
    dictionary = Dictionary.parse(second.compressed)
    cache.store(second.compressed, dictionary)
    cache.remember("can0/000000000001", dictionary)
    later = DictionaryCache(tmp_path)
    found = later.of_node("can0/000000000001")
    assert found is not None
    assert found.version == "v2"
    assert later.ignored_files == 0


def test_pipes_links_and_huge_files_are_not_read(tmp_path: Path) -> None:
    folder, twin = tmp_path / "cache", build("v1")
    path = stored(folder, twin)
    outside = tmp_path / "outside"
    path.rename(outside)
    path.symlink_to(outside)
    os.mkfifo(folder / f"pipe-{'0' * 64}.dict")
    (folder / f"dir-{'1' * 64}.dict").mkdir()
    with (folder / f"huge-{'2' * 64}.dict").open("wb") as huge:
        huge.write(twin.compressed[:40])
        huge.truncate(1 << 40)
    assert DictionaryCache(folder).candidates(twin.compressed[:40]) == []


@pytest.mark.parametrize("version", ["", "../../../evil", "v" * 500, "ünïcode/\x00\n"])
def test_a_version_cannot_lead_out_of_the_folder(tmp_path: Path, version: str) -> None:
    folder, twin = tmp_path / "cache", build(version)
    path = stored(folder, twin)
    assert path.parent == folder
    assert [entry.name for entry in tmp_path.iterdir()] == ["cache"]
    assert DictionaryCache(folder).candidates(twin.compressed[:40])


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    cache, twin = DictionaryCache(tmp_path / "file" / "cache"), build("v1")
    start(cache, twin)
    assert cache.problem is not None
    assert "cannot" in cache.problem
    start(cache, twin)
    assert asked(twin) == 3


def test_the_files_used_longest_ago_give_way(tmp_path: Path) -> None:
    cache = DictionaryCache(tmp_path)
    (tmp_path / "mine.txt").write_text("not the cache's")
    builds = [build(f"v{number}").compressed for number in range(MAX_FILES + 1)]
    for number, compressed in enumerate(builds[:-1]):
        cache.store(compressed, Dictionary.parse(compressed))
        path = next(tmp_path.glob(f"v{number}-*"))
        os.utime(path, ns=(number, number))
    first = cache.candidates(builds[0][:40])
    cache.used(next(kept for kept in first if kept.compressed == builds[0]))
    cache.store(builds[-1], Dictionary.parse(builds[-1]))
    names = {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert names == {"mine.txt", *(f"v{number}" for number in range(MAX_FILES + 1) if number != 1)}


def test_the_memory_is_bounded() -> None:
    cache = DictionaryCache()
    for number in range(MAX_KEPT + 5):
        compressed = build(f"v{number}", level=0).compressed
        cache.store(compressed, Dictionary.parse(compressed))
    assert len(cache.candidates(compressed[:2])) == MAX_KEPT


def test_what_fails_to_parse_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(DictionaryError):
        start(DictionaryCache(tmp_path), TwinNode(compressed=b"garbage" * 9))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("xdg", "expected"),
    [("/x/cache", "/x/cache"), ("", "/h/.cache"), ("relative", "/h/.cache")],
)
def test_the_users_cache_is_where_it_should_be(
    xdg: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", xdg)
    monkeypatch.setenv("HOME", "/h")
    assert DictionaryCache.of_user()._folder == Path(expected) / "canductor" / "dictionaries"
