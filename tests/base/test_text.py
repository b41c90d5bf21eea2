"""Amounts, documents and tables read the same everywhere."""

import csv

import pytest

from pipeline.base.text import NOTHING, Table, as_yaml, duration, number, size

TABLE = Table(
    ("what", "count", "error", "right"),
    [("one", 1234, 0.00012345678, True), ("another", None, float("nan"), False)],
)


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (2**10, "1 KiB"),
        (2**20 - 2**9, "1024 KiB"),
        (2**20, "1.0 MiB"),
        (2**30, "1.0 GiB"),
        (1.5 * 2**40, "1.5 TiB"),
    ],
)
def test_bytes(count: float, text: str) -> None:
    assert size(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0123, "0.0123 s"),
        (5.345, "5.34 s"),
        (119, "119 s"),
        (120, "2.0 min"),
        (7200, "2.0 h"),
        (3600 * 1447.2, "1,447.2 h"),
    ],
)
def test_seconds(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_documents_keep_their_order_and_what_is_flat_stands_in_one_line() -> None:
    slots = [{"layer": -1, "cell": (0, 1)}, {"name": "바늘", "of": None}]
    written = as_yaml({"b": {"list": list(range(99))}, "a": slots, "no": {}})
    first, numbers, *rest = written.splitlines()
    assert (first, numbers[:16], len(numbers)) == ("b:", "  list: [0, 1, 2", 394)
    assert rest == ["a:", "- layer: -1", "  cell: [0, 1]", "- {name: 바늘, of: null}", "'no': {}"]


def test_text_aligns_words_left_and_numbers_right():
    assert TABLE.text() == [
        "what     count      error  right",
        "one      1,234  0.0001235  yes",
        f"another      {NOTHING}          {NOTHING}  no",
    ]


def test_csv_has_six_digits_and_nothing_for_no_value():
    rows = list(csv.reader(TABLE.csv().splitlines()))
    assert rows[0] == ["what", "count", "error", "right"]
    assert rows[1:] == [["one", "1234", "0.000123457", "True"], ["another", "", "", "False"]]


def test_markdown_tells_numbers_from_words():
    heads, rule, first, _ = TABLE.markdown()
    assert heads == "| what | count | error | right |"
    assert rule == "| --- | ---: | ---: | --- |"
    assert first == "| one | 1,234 | 0.0001235 | yes |"


def test_a_table_without_rows_has_heads():
    empty = Table(("a", "b"), [])
    assert empty.text() == ["a  b"]
    assert empty.csv() == "a,b\n"
    assert len(empty.markdown()) == 2


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0, "0"),
        (9.99996, "10.00"),
        (2e9, "2.000e+09"),
        (-3e-7, "-3.000e-07"),
        (float("nan"), NOTHING),
        (float("-inf"), "-∞"),
    ],
)
def test_a_number_has_four_digits(value, words):
    assert number(value) == words
