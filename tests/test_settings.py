"""Settings are read by their types, and what does not fit is told by its place."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neeco.base.errors import NeecoError
from neeco.base.settings import described, plain, structure, with_fields


@dataclass(frozen=True)
class Inner:
    count: int = 3  # of things
    # which
    word: Literal["on", "off"] = "on"


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    share: float | None = None
    names: tuple[str, ...] | None = None
    flag: bool = False

    def __post_init__(self) -> None:
        if self.share == 7:
            raise NeecoError("group.share: 7 is unlucky")


settings = st.builds(
    Outer,
    st.builds(Inner, st.integers(-(2**63) + 1, 2**63 - 1), st.sampled_from(["on", "off"])),
    st.none() | st.floats(allow_nan=False, allow_infinity=False).filter(lambda value: value != 7),
    st.none() | st.lists(st.text()).map(tuple),
    st.booleans(),
)


@given(settings)
def test_what_is_written_is_read_again(value: Outer) -> None:
    assert structure(Outer, plain(value)) == value


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"inner": {"count": "4"}}, "group.inner.count: '4' is not a whole number"),
        ({"inner": {"count": True}}, "group.inner.count: True is not a whole number"),
        ({"inner": {"count": 4.0}}, "group.inner.count: 4.0 is not a whole number"),
        ({"inner": {"word": True}}, "group.inner.word: True is none of on, off"),
        ({"inner": {"size": 1}}, "group.inner.size: it has no such field; it has count, word"),
        ({"inner": 3}, "group.inner: is a group of fields, each with a value of its own"),
        ({"share": "half"}, "group.share: 'half' is not a number"),
        ({"share": float("nan")}, "group.share: nan is not a finite number"),
        ({"share": 10**400}, "group.share: a huge integer is out of range"),
        ({"share": 7}, "group.share: 7 is unlucky"),
        ({"names": "jaw"}, r"group.names: 'jaw' is not a list; write \[jaw\]"),
        ({"names": [1]}, r"group.names\[0\]: 1 is not a word"),
        ({"flag": "no"}, "group.flag: 'no' is not true or false"),
        ({"colour": 1}, "group.colour: it has no such field"),
    ],
)
def test_what_does_not_fit_is_told_by_its_place(values: dict[str, Any], told: str) -> None:
    with pytest.raises(NeecoError, match=f"^{told}"):
        structure(Outer, values, "group")


def test_any_mapping_and_any_sequence_are_read() -> None:
    given = MappingProxyType({"inner": MappingProxyType({"count": 4}), "names": deque(["jaw"])})
    read = structure(Outer, given, "group")
    assert (read.inner.count, read.names) == (4, ("jaw",))


def test_dots_reach_into_groups() -> None:
    changed = with_fields(Outer(), {"inner.word": "off", "flag": True})
    assert (changed.inner.word, changed.flag, changed.inner.count) == ("off", True, 3)


def test_fields_are_described_in_words() -> None:
    fields = {name: (default, text) for name, default, text in described(Outer)}
    assert fields["share"] == ("None", " (FLOAT)")
    assert fields["inner.count"] == ("3", "of things")
    assert fields["inner.word"] == ("on", "which (on,off)")
