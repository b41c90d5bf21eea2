"""Values as the words of a table or a document."""

import pytest

from pipeline.look.page.cells import breakable, columns_of, number
from pipeline.look.page.writing import document_lines


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0, "0"),
        (1.23456, "1.235"),
        (9.99996, "10.00"),
        (-0.012345, "-0.01235"),
        (12345.678, "12,346"),
        (1234567.8, "1,234,568"),
        (3.2e-7, "3.200e-07"),
        (float("nan"), "–"),
        (float("-inf"), "-∞"),
    ],
)
def test_numbers_have_the_digits_they_deserve(value: float, said: str) -> None:
    assert number(value) == said


def test_columns_know_whether_they_are_numbers() -> None:
    rows = [[1.0, 2.5, "x", True, None], [float("nan"), 7, 3.14159, False, None]]
    whole, mixed, words, flags, empty = columns_of(list("abcde"), rows)
    assert (whole.numeric, whole.cells) == (True, ("1", "–"))
    assert (mixed.numeric, mixed.cells) == (True, ("2.500", "7"))
    assert (words.numeric, words.cells) == (False, ("x", "3.142"))
    assert (flags.numeric, flags.cells) == (False, ("yes", "no"))
    assert (empty.numeric, empty.cells) == (False, ("–", "–"))
    with pytest.raises(ValueError, match="row 1: 1 cells under 2 heads"):
        columns_of(["a", "b"], [[1, 2], [1]])


def test_documents_keep_their_order_and_depth() -> None:
    content = {"b": 1, "a": {"list": [1, 2], "text": "x\ny"}, "no": {}}
    content["slots"] = [{"layer": -1, "cell": [0, 1]}, {"of": {"a": 1}}]
    assert document_lines(content) == [
        (0, "b", "1"),
        (0, "a", ""),
        (1, "list", "[1, 2]"),
        (1, "text", '"x\\ny"'),
        (0, "no", "{}"),
        (0, "slots", ""),
        (1, "-", "layer: -1, cell: [0, 1]"),
        (1, "-", ""),
        (2, "of", ""),
        (3, "a", "1"),
    ]


def test_long_names_break_between_their_words() -> None:
    assert breakable("/lab/run_1<b>") == "/lab/<wbr>run_<wbr>1&lt;b&gt;"
