"""Where two JSON documents differ."""

import copy
import json

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.base.differences import describe, differences

LEAVES = st.booleans() | st.integers() | st.text(max_size=3)
NAMES = st.sampled_from(["a", "b", "c"])
DOCUMENTS = st.dictionaries(
    NAMES,
    st.recursive(
        LEAVES,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
        max_leaves=6,
    ),
    max_size=3,
)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(DOCUMENTS, DOCUMENTS)
def test_there_are_differences_where_documents_are_not_equal(a, b):
    assert not differences(a, copy.deepcopy(a))
    assert bool(differences(a, b)) == (a != b)


def test_names_the_place_and_both_values():
    a = {"prompt": "x", "slots": [{"layer": -1}, {"layer": 2}], "views": ["View1"]}
    b = {"prompt": "x", "slots": [{"layer": -1}, {"layer": 3}], "views": ["View1", "View2"]}
    assert differences(a, b) == {"slots[1].layer": (2, 3), "views": (["View1"], ["View1", "View2"])}


def test_what_is_absent_is_none_and_tuples_are_lists():
    assert differences({"a": {"b": 1}}, {"a": {}}) == {"a.b": (1, None)}
    assert differences({}, {"a": 1}) == {"a": (None, 1)}
    assert not differences({"a": (1, 2)}, json.loads(json.dumps({"a": (1, 2)})))


def test_equal_digests_are_equal_documents_and_else_named_where_nothing_else_is():
    assert not differences({"spec": {"digest": "d", "x": 1}}, {"spec": {"digest": "d", "x": 2}})
    assert differences({"digest": "d", "x": 1}, {"digest": "e", "x": 2}) == {"x": (1, 2)}
    assert differences({"digest": "d", "x": 1}, {"digest": "e", "x": 1}) == {"digest": ("d", "e")}


def test_long_values_are_cut_around_where_they_differ():
    long = "word " * 100
    (line,) = describe(differences({"prompt": long + "x"}, {"prompt": long + "y"}))
    assert line.startswith("prompt: …")
    assert 'x" -> …' in line
    assert len(line) < 200
