"""Documents and names as the words of a page."""

from pipeline.look.page.writing import breakable, document_lines, prose


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


def test_of_a_long_list_the_first_items_stand_there() -> None:
    names = [f"sensor_{index}" for index in range(1026)]
    ((_, key, value),) = document_lines({"names": names})
    assert key == "names" and value.endswith('"sensor_7", "… 1,026 in all"]')


def test_long_names_break_between_their_words() -> None:
    assert breakable("/lab/run_1<b>") == "/lab/<wbr>run_<wbr>1&lt;b&gt;"


def test_backticks_are_code_and_nothing_is_markup() -> None:
    assert prose("a `b_c` & <d> `") == "a <code>b_c</code> &amp; &lt;d&gt; `"
