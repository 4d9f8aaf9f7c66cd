"""A record behaves like the frozen dataclass with slots that it replaces."""

import pickle
from dataclasses import FrozenInstanceError, asdict, dataclass, field, fields, replace
from typing import Any

import pytest

from nodes.support.records import record


@record
class Point:
    x: int
    y: int = 2
    tags: list[str] = field(default_factory=list, compare=False)


@record(kw_only=True)
class Named(Point):
    name: str
    hidden: int = field(default=7, repr=False)
    derived: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "derived", self.x + self.hidden)


@dataclass(frozen=True, slots=True)
class PointTwin:
    x: int
    y: int = 2
    tags: list[str] = field(default_factory=list, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedTwin(PointTwin):
    name: str
    hidden: int = field(default=7, repr=False)
    derived: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "derived", self.x + self.hidden)


@record(frozen=False)
class Changeable:
    x: int
    y: list[int] = field(default_factory=list)


@record
class Empty:
    pass


@record
class OwnText:  # noqa: PLW1641 (like a dataclass, a record adds the hash)
    x: int

    def __repr__(self) -> str:
        return "own"

    def __eq__(self, other: object) -> bool:
        return True


MADE: list[tuple[Any, Any]] = [
    (Point(1), PointTwin(1)),
    (Point(1, 3, ["a"]), PointTwin(1, 3, ["a"])),
    (Point(y=1, x=0), PointTwin(y=1, x=0)),
    (Named(4, name="n"), NamedTwin(4, name="n")),
    (Named(4, 5, name="n", hidden=1), NamedTwin(4, 5, name="n", hidden=1)),
]


@pytest.mark.parametrize(("made", "twin"), MADE)
def test_a_record_is_what_its_twin_is(made: Any, twin: Any) -> None:
    assert asdict(made) == asdict(twin)
    assert repr(made) == repr(twin).replace("Twin", "")
    assert [f.name for f in fields(made)] == [f.name for f in fields(twin)]
    assert made.__match_args__ == twin.__match_args__
    assert hash(made) == hash(twin)
    assert asdict(replace(made, x=9)) == asdict(replace(twin, x=9))
    copy = pickle.loads(pickle.dumps(made))  # noqa: S301 (our own bytes)
    assert copy == made
    assert asdict(copy) == asdict(made)
    assert not hasattr(made, "__dict__")


def test_comparing() -> None:
    for first, _ in MADE:
        for second, _ in MADE:
            assert (first == second) == (first is second)
    assert Point(1, tags=["a"]) == Point(1, tags=["b"])
    assert Point(1) != PointTwin(1)  # type: ignore[comparison-overlap]
    assert Empty() == Empty()
    assert repr(Empty()) == "Empty()"
    assert Point(1).tags is not Point(1).tags


@pytest.mark.parametrize("name", ["x", "other"])
def test_nothing_can_be_changed(name: str) -> None:
    point = Point(1)
    with pytest.raises(FrozenInstanceError):
        setattr(point, name, 2)
    with pytest.raises(FrozenInstanceError):
        delattr(point, name)
    assert point == Point(1)


def test_own_methods_stay() -> None:
    assert repr(OwnText(1)) == "own"
    assert OwnText(1) == OwnText(2)


@pytest.mark.parametrize("words", [{}, {"x": 1, "z": 2}])
def test_a_wrong_call_is_a_type_error(words: dict[str, int]) -> None:
    with pytest.raises(TypeError, match=r"Point\.__init__\(\)"):
        Point(**words)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"Named\.__init__\(\)"):
        Named(1, 2, [], "n")  # type: ignore[call-arg]


def test_matching() -> None:
    match Point(5, 6):
        case Point(x, y):
            assert (x, y) == (5, 6)


def test_one_that_may_be_changed_has_no_hash() -> None:
    one = Changeable(1)
    one.x, one.y = 2, [3]
    assert one == Changeable(2, [3]) != Changeable(1)
    assert repr(one) == "Changeable(x=2, y=[3])"
    assert pickle.loads(pickle.dumps(one)) == replace(one) == one  # noqa: S301
    del one.x
    with pytest.raises(AttributeError):
        one.z = 1  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match="unhashable"):
        hash(one)


def test_the_first_instances_are_those_that_come_later() -> None:
    @record
    class Fresh(Point):
        z: int = field(default=3, kw_only=True)

    with pytest.raises(TypeError, match=r"Fresh\.__init__\(\)"):
        Fresh(1, x=2)  # type: ignore[misc]

    @record
    class Often(Point):
        z: int = field(default=3, kw_only=True)

    many = [Often(1, tags=["a"], z=n) for n in range(40)]
    assert [repr(one) for one in many] == [
        f"{Often.__qualname__}(x=1, y=2, tags=['a'], z={n})" for n in range(40)
    ]
    with pytest.raises(TypeError, match=r"Often\.__init__\(\)"):
        Often(1, 2, [], 4)  # type: ignore[call-arg]
