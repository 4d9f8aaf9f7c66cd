import fnmatch
import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.ipc.protocol.messages import Encoder, Encoding
from coordinator.ipc.server.publisher import Publisher
from coordinator.ipc.server.state import FIELDS_MAX, REMOVALS_MAX, FieldFilter, StateTree, costly_stars

paths = st.sampled_from(["a", "a.x", "a.y", "b", "b.x", "ab.x"])
changes = st.lists(
    st.tuples(st.just("set"), paths, st.sampled_from([0, 1, 1.0, True, None, "x", [1]]))
    | st.tuples(st.just("remove"), st.sampled_from(["a", "b", "ab"]), st.none())
    | st.tuples(st.just("look"), st.integers(0, 2), st.none()),
    max_size=40,
)


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a == b and all(type(a[path]) is type(b[path]) for path in a)


@settings(deadline=None)
@given(changes, st.sampled_from([("*",), ("a*",), ("a.*", "b"), ("*b",)]))
def test_watchers_know_what_the_tree_holds_however_seldom_they_look(
    steps: list[tuple[str, Any, Any]], globs: tuple[str, ...]
) -> None:
    tree, wanted = StateTree(), FieldFilter(globs)
    known: list[dict[str, Any]] = [{}, {}, {}]
    seen = [0, 0, 0]
    for step, what, value in [*steps, *[("look", who, None) for who in range(3)]]:
        if step == "set":
            tree.set(what, value)
        elif step == "remove":
            tree.remove(what)
        else:
            told = tree.changes_since(seen[what], wanted)
            assert not told.values.keys() & set(told.removed)
            seen[what] = told.sequence
            known[what] = {p: v for p, v in known[what].items() if p not in told.removed} | told.values
            assert same(known[what], tree.snapshot(wanted).values)
            assert tree.changes_since(seen[what], wanted).values == {}


def test_memory_is_bounded_and_who_was_away_too_long_gets_a_snapshot() -> None:
    tree = StateTree()
    tree.set("stays", 1)
    for i in range(REMOVALS_MAX + 1):
        tree.set(f"gone.{i}", i)
    begun = tree.sequence
    tree.remove("gone")
    away, here = tree.changes_since(begun), tree.changes_since(begun + 1)
    assert (away.snapshot, away.values) == (True, {"stays": 1})
    assert (here.snapshot, len(here.removed)) == (False, REMOVALS_MAX)
    assert tree.changes_since(tree.sequence + 5).snapshot  # a number from another life
    tree.update("many", {str(i): i for i in range(FIELDS_MAX)})
    assert (len(tree), tree.refused) == (FIELDS_MAX, 1)


def test_only_changes_count_and_numbers_are_finite() -> None:
    tree = StateTree()
    tree.set("x", math.nan)
    tree.set("x", math.inf)
    assert (tree.get("x"), tree.sequence) == (None, 1)


def test_globs() -> None:
    wanted = FieldFilter(["nodes.*.load", "extruder [1]", "a*c"])
    yes = ["nodes.a.load", "nodes.a.b.load", "extruder [1]", "abc", "ac", "a.cc"]
    no = ["nodes.load", "extruder 1", "acb", "nodes.a.load.x", ""]
    assert [p for p in yes + no if wanted.matches(p)] == yes
    assert not FieldFilter(()).matches("a")


def test_stars_cost_no_more_than_their_number() -> None:
    """A glob that would take a backtracking matcher for ever, and those that stand for parts of others."""
    assert not FieldFilter(["*a" * 60 + "b"]).matches("a" * 5000)
    assert FieldFilter(["**a**b**"]).matches("ab")
    assert not FieldFilter(["ab*ba"]).matches("aba")
    assert costly_stars(["*", "a.*", "b", "*.load", "a*b*"]) == 2


@given(st.lists(st.text("ab*.", max_size=6), max_size=4), st.text("ab.", max_size=8))
def test_globs_match_as_patterns_of_files_do(globs: list[str], path: str) -> None:
    assert FieldFilter(globs).matches(path) == any(fnmatch.fnmatchcase(path, glob) for glob in globs)


def test_one_value_that_cannot_be_sent_does_not_hide_the_others() -> None:
    tree = StateTree()
    tree.update("a", {"good": 1, "huge": 2**70, "nan": [math.nan]})
    publisher = Publisher(tree, Encoder())
    body = publisher.body(publisher.filter(["*"]), 0, Encoding.JSON)
    assert body == b'"snapshot":false,"values":{"a.good":1},"removed":[]'
    assert publisher.unsendable == 2


def test_watchers_of_the_same_share_one_message() -> None:
    tree = StateTree()
    tree.set("a", 1)
    publisher = Publisher(tree, Encoder())
    first = publisher.body(publisher.filter(["a", "b"]), 0, Encoding.MSGPACK)
    assert publisher.body(publisher.filter(["b", "a"]), 0, Encoding.MSGPACK) is first
