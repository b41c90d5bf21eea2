"""How findings read, and that a group that cannot be looked at is one."""

from collections.abc import Callable
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError
from pipeline.look import doctor as machine
from pipeline.look.doctor.findings import WIDTH, described, missing, note, ok


@pytest.fixture
def params() -> Params:
    return Params.model_validate(
        {"data": {"sources": [{"name": "a", "path": "."}]}, "vlm": {"checkpoint": "x/y"}}
    )


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """`only(check)`: one group, whose check this is; an error stands for a failing import."""

    def set_check(check: Any) -> None:
        def load(name: str) -> Any:
            if isinstance(check, Exception):
                raise check
            return SimpleNamespace(check=check)

        monkeypatch.setattr(machine, "import_module", load)
        monkeypatch.setattr(machine, "GROUPS", (("A group", "one", "check"),))

    return set_check


def test_lines_stay_within_the_width_and_words_whole() -> None:
    command = "pip install --force-reinstall torch --index-url https://a.example/" + "x" * 20
    lines = described(
        "A group", [ok("subject", "word " * 40), note("other", "found", command), ok("s", "")]
    )
    assert lines[0] == "A group" and lines[-1] == ""
    assert all(len(line) <= WIDTH for line in lines)
    assert sum(line.startswith("  ok ") for line in lines) == 2
    assert "https://a.example/" + "x" * 20 in "\n".join(lines)
    starts = {line.index("word") for line in lines if "word" in line}
    assert starts == {30}, "found stands in one column"


@pytest.mark.parametrize(
    ("check", "level", "said"),
    [
        (ImportError("No module named 'av'"), "missing", "No module named 'av'"),
        (lambda params: _raise(ConfigError("device: cuda:7")), "missing", "device: cuda:7"),
        (lambda params: _raise(OSError("stale handle")), "note", "stale handle"),
        (lambda params: [missing("it", "is not there", "get it")], "missing", "is not there"),
    ],
)
def test_what_cannot_be_looked_at_is_a_finding(
    params: Params,
    only: Callable[[Any], None],
    monkeypatch: pytest.MonkeyPatch,
    check: Any,
    level: str,
    said: str,
) -> None:
    monkeypatch.setattr(machine, "PATIENCE_S", 200.0)
    only(check)
    ((title, (finding,)),) = machine.examine(params)
    assert (title, finding.level) == ("A group", level)
    assert said in finding.found


def test_what_hangs_is_named_and_left(
    params: Params, only: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    end = Event()
    monkeypatch.setattr(machine, "PATIENCE_S", 0.01)
    only(lambda params: end.wait())
    ((_, (finding,)),) = machine.examine(params)
    end.set()
    assert (finding.level, finding.found) == ("note", "not known: no answer within 0.01 s")


def test_a_bug_in_a_check_costs_its_group_alone_and_is_raised_at_the_end(
    params: Params, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = SimpleNamespace(
        broken=lambda params: _raise(KeyError("typo")), sound=lambda params: [ok("it", "is there")]
    )

    def load(name: str) -> Any:
        return checks if name != "pipeline.look.doctor.zero" else _raise(NameError("no such name"))

    monkeypatch.setattr(machine, "PATIENCE_S", 200.0)
    monkeypatch.setattr(machine, "import_module", load)
    groups = (
        ("Zeroth", "zero", "sound"),
        ("First", "one", "broken"),
        ("Second", "two", "sound"),
    )
    monkeypatch.setattr(machine, "GROUPS", groups)
    seen: list[tuple[str, str]] = []
    with pytest.raises(ExceptionGroup) as caught:
        seen.extend((title, one.found) for title, (one,) in machine.examine(params))
    assert [type(error) for error in caught.value.exceptions] == [NameError, KeyError]
    assert seen == [
        ("Zeroth", "sound failed with NameError: no such name"),
        ("First", "broken failed with KeyError: 'typo'"),
        ("Second", "is there"),
    ]


def _raise(error: Exception) -> None:
    raise error
