"""Whatever stands in the JSON, checking tells it and reading refuses it in one line."""

from __future__ import annotations

import contextlib
import copy
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture

DELETE = object()
NUMBERS = [-1, 0, 1e-300, 1e300, 10**400, float("nan"), float("inf")]
TEXTS = ["", "x", "../..", "\ud800", "a\0b", "a\nb", "images/000001.png", "transforms.json"]
CONTAINERS = [[], {}, [[]], [None] * 4, [[0.0] * 4] * 4, {"name": 3}, [1, 2], {"\ud800\n": 1}]
VALUES = st.sampled_from([DELETE, None, True, *NUMBERS, *TEXTS, *CONTAINERS])


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """The path of every value inside a JSON document."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [] if not path else [path]
    for key, child in children:
        found += places(child, (*path, key))
    return found


@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_document_makes_check_raise(pristine, data):
    folder, original = pristine
    document = copy.deepcopy(original)
    for _ in range(data.draw(st.integers(1, 4))):
        options = places(document)
        if not options:
            break
        path, value = data.draw(st.sampled_from(options)), data.draw(VALUES)
        parent = document
        for key in path[:-1]:
            parent = parent[key]
        if value is DELETE:
            del parent[path[-1]]
        else:
            parent[path[-1]] = copy.deepcopy(value)
    folder.write(document)
    problems = check_capture(folder.root)
    for problem in problems:
        str(problem).encode("utf-8")  # printable
        assert "\n" not in str(problem)
    if errors_only(problems):
        # what the images, states and geometry show is found by the check alone; reading may still succeed
        with contextlib.suppress(NeecoError):
            read_capture(folder.root)
    else:
        read_capture(folder.root)
