"""What the site is made of: figures as they are drawn, a page that describes every parameter."""

import re
from pathlib import Path

import pytest

from pipeline.base.config import described_keys

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs" / "figures"


def test_the_figures_are_as_they_are_drawn(machinery):
    drawn = machinery("draw").documents()
    assert {path.name for path in FIGURES.glob("*.svg")} == set(drawn)
    for name, text in drawn.items():
        kept = (FIGURES / name).read_text(encoding="utf-8")
        assert kept == text, f"{name} is stale: python docs/machinery/draw.py"


def test_the_site_knows_every_colour_of_the_figures(machinery):
    css = (ROOT / "docs" / "machinery" / "site.css").read_text(encoding="utf-8")
    drawing = machinery("drawing")
    for name, value in (*drawing.LIGHT.items(), *drawing.DARK.items()):
        assert f"--{name}: {value};" in css or name == "paper"


class TestParamsPage:
    @pytest.fixture
    def page(self, machinery) -> str:
        kept = (ROOT / "docs" / "params.md").read_text(encoding="utf-8")
        return machinery("params_page").params_page(kept)

    def test_has_every_key_that_the_commands_list(self, page):
        from pipeline.base.config import Params

        listed = [
            line.split(" = ")[0].strip()
            for line in described_keys(tuple(Params.model_fields))
            if re.match(r"  \w+\.[\w.]+ = ", line)
        ]
        assert len(listed) > 100
        for key in listed:
            assert f"`{key}`{{ #{key} }}" in page

    def test_says_type_range_default_and_meaning(self, page):
        (entry,) = re.findall(r"^`vlm\.layers`.*\n:   .*$", page, re.MULTILINE)
        assert "list of (whole number or `vision`), at least 1; default `[-1]`" in entry
        assert "Decoder layers whose output is taken" in entry
        assert "`train_head.drop_state`{ #train_head.drop_state } number, from 0 to 1;" in page
        assert "`data.sources[].name`{ #data.sources.name } text, not empty; **has to" in page

    def test_lists_them_in_place_of_what_the_file_says_instead(self, page):
        assert page.startswith("# Parameters\n")
        assert "mkdocs serve" not in page

    def test_refuses_what_it_has_no_words_for(self, machinery):
        with pytest.raises(KeyError):
            machinery("params_page").words({"type": "unheard-of"}, {})


def test_every_room_has_a_page_in_the_index(machinery):
    index = (ROOT / "docs" / "reference" / "index.md").read_text(encoding="utf-8")
    for room in machinery("reference_pages").rooms():
        assert f"({room}.md)" in index, f"docs/reference/index.md does not name {room}"
