"""Tables, as a terminal, a spreadsheet and a page show them."""

import csv

import pytest

from pipeline.base.text import NOTHING, Table, number

TABLE = Table(
    ("what", "count", "error", "right"),
    [("one", 1234, 0.00012345678, True), ("another", None, float("nan"), False)],
)


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
        (1234567.8, "1,234,568"),
        (9.99996, "10.00"),
        (2e9, "2.000e+09"),
        (-3e-7, "-3.000e-07"),
        (float("nan"), NOTHING),
        (float("-inf"), "-∞"),
    ],
)
def test_a_number_has_four_digits(value, words):
    assert number(value) == words
