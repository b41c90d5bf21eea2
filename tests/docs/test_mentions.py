"""What the documentation names is there: commands, keys of params.yaml, files behind links.

`<!-- no-check: why -->` before a paragraph or block excuses it.
"""

import re
from pathlib import Path

from pipeline.base.config import Params
from pipeline.base.config.section import Section
from tests.docs.conftest import PAGES, ROOT

STAGES = {path.stem for path in (ROOT / "stages").glob("*.py")} - {"__init__", "command"}
WRITTEN_AT_BUILD = re.compile(r"(^|/)docs/reference/\w+\.md$")
EXCUSED = re.compile(
    r"<!-- no-check: [^>]*-->\s*\n(?:```.*?^```$|.*?(?=\n\n|\Z))", re.DOTALL | re.MULTILINE
)
COMMAND = re.compile(r"\bstages\.([a-z_]+)")
KEY = re.compile(
    rf"(?<![\w./-])({'|'.join(Params.model_fields)})"
    r"\.([a-z_]+(?:\.[a-z_]+)*)(?![\w(/])"
)
FILES = {"zarr", "pkl", "md", "py", "yaml", "json", "csv", "png", "html", "lock", "npz", "parquet"}
LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|srcset|href)=\"([^\"]+)\"")


def text_of(page: Path) -> str:
    return EXCUSED.sub("", page.read_text(encoding="utf-8"))


def keys() -> set[str]:
    """Every key and section of params.yaml by its full name."""
    found: set[str] = set()

    def collect(section: type[Section], place: str) -> None:
        for name, one in section.model_fields.items():
            found.add(f"{place}{name}")
            if isinstance(one.annotation, type) and issubclass(one.annotation, Section):
                collect(one.annotation, f"{place}{name}.")

    collect(Params, "")
    return found


def test_every_command_is_there():
    named = {(page, name) for page in PAGES for name in COMMAND.findall(text_of(page))}
    assert named
    assert not [one for one in named if one[1] not in {*STAGES, "command"}]


def test_every_key_is_there():
    known = keys()
    named = {
        (page, f"{section}.{key}")
        for page in PAGES
        for piece in re.findall(r"```.*?```|`[^`\n]+`", text_of(page), re.DOTALL)
        if not piece.startswith("```python")
        for section, key in KEY.findall(piece)
    }
    assert named
    # demo.zarr is a file of the demo, demo.episodes a key.
    strange = [one for one in named if one[1] not in known]
    assert not [one for one in strange if one[1].rpartition(".")[2] not in FILES]


def test_every_link_within_the_project_resolves():
    links = [(page, "".join(link)) for page in PAGES for link in LINK.findall(text_of(page))]
    assert links
    for page, target in links:
        if target.startswith(("https://", "http://", "#", "mailto:")):
            continue
        place = (page.parent / target.partition("#")[0]).resolve()
        written = WRITTEN_AT_BUILD.search(place.as_posix())
        assert place.exists() or written, f"{page.relative_to(ROOT)} -> {target}"
