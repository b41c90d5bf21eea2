"""How issues read, and that a group that cannot be looked at is one."""

from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.look import doctor as machine
from pipeline.look.doctor import WIDTH, describe, missing, note, ok


@pytest.fixture
def params() -> Params:
    return Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "x/y"}}
    )


def test_lines_stay_within_the_width_and_words_whole() -> None:
    command = "pip install --force-reinstall torch --index-url https://a.example/" + "x" * 20
    lines = describe("A group", [ok("subject", "word " * 40), note("other", "found", command)])
    assert lines[0] == "A group" and lines[-1] == ""
    assert all(len(line) <= WIDTH for line in lines)
    assert sum(line.startswith("  ok ") for line in lines) == 1
    assert "https://a.example/" + "x" * 20 in "\n".join(lines)
    starts = {line.index("word") for line in lines if "word" in line}
    assert starts == {30}, "found stands in one column"


def _refuse(params: Params) -> None:
    raise ConfigError("device: cuda:7")


@pytest.mark.parametrize(
    ("check", "said"),
    [
        (ImportError("No module named 'av'"), "No module named 'av'"),
        (_refuse, "device: cuda:7"),
        (lambda params: [missing("it", "is not there", "get it")], "is not there"),
    ],
)
def test_what_cannot_be_looked_at_is_an_issue(params, monkeypatch, check, said):
    def load(name: str) -> Any:
        if isinstance(check, Exception):
            raise check
        return SimpleNamespace(check=check)

    monkeypatch.setattr(machine, "import_module", load)
    monkeypatch.setattr(machine, "GROUPS", {"A group": ("one", "check")})
    ((title, (issue,)),) = machine.examine(params)
    assert (title, issue.severity) == ("A group", "error")
    assert said in issue.message
