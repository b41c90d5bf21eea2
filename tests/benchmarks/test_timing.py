"""Rounds are interleaved, ratios are taken within a round, and a report is one line."""

import json
import sys

from benchmarks import timing
from benchmarks.timing import Race, race, report


def test_rounds_are_interleaved_and_warm_up_does_not_count():
    order: list[str] = []
    contenders = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    result = race(contenders, rounds=2, warmup=1, before={"b": lambda: order.append("before b")})
    assert order == ["a", "before b", "b"] * 3
    assert [len(seconds) for seconds in result.seconds.values()] == [2, 2]


def test_short_work_is_called_until_it_fills_the_time(monkeypatch):
    calls = 0
    monkeypatch.setattr(timing.time, "perf_counter", lambda: calls / 1024)

    def work() -> None:
        nonlocal calls
        calls += 1

    result = race({"work": work}, rounds=1, least_s=1 / 16)
    assert calls == 1 + 64
    assert result.median("work") == 1 / 1024


def test_a_ratio_is_the_median_of_the_ratios_of_each_round():
    # The machine was three times as slow in the last round: medians alone would mix rounds.
    result = Race({"slow": [2.0, 8.0, 6.0], "fast": [1.0, 2.0, 3.0]})
    assert result.speed("fast", "slow") == 2.0
    assert result.ratios("slow") == {"fast": 2.0}
    assert result.results({"rows": 10})["fast"] == {
        "median_s": 2.0,
        "min_s": 1.0,
        "max_s": 3.0,
        "rows_per_s": 5.0,
    }


def test_a_report_is_one_line_of_json_with_machine_and_command(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/benchmarks/gather.py", "--rounds", "3"])
    report("gather", settings={"rows": 2}, results={}, ratios={}, targets=[], quick=True)
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    line = json.loads(out)
    assert line["command"] == "python -m benchmarks.gather --rounds 3"
    assert line["quick"] is True
    assert line["machine"]["cores"] >= 1
    assert line["machine"]["device"] == "cpu"
    assert line["machine"]["torch"]
