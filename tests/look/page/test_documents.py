"""Names and plain words as those of a page."""

from pipeline.look.page.writing import breakable, prose


def test_long_names_break_between_their_words() -> None:
    assert breakable("/lab/run_1<b>") == "/lab/<wbr>run_<wbr>1&lt;b&gt;"


def test_backticks_are_code_and_nothing_is_markup() -> None:
    assert prose("a `b_c` & <d> `") == "a <code>b_c</code> &amp; &lt;d&gt; `"
