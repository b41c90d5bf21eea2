"""The experiments that the documentation's tables come from."""

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from experiments import closed_loop
from experiments.recipes import RECIPES, ROLLOUTS, STORES, TABLES, store_settings
from pipeline.base.config import load_params

PARAMS = Path(__file__).parents[1] / "params.yaml"


@pytest.mark.parametrize("name", TABLES)
def test_what_a_table_names_can_be_run(name: str, tmp_path: Path) -> None:
    table = TABLES[name]
    for recipe in (RECIPES[name] for name in table.recipes):
        told = [*store_settings(recipe, tmp_path), *recipe.params]
        steps = [text.format(out=tmp_path) for _, s in STORES[recipe.store].steps for text in s]
        load_params(PARAMS, steps)
        for rollout in table.rollouts:
            said = [text.format(folder=tmp_path, out=tmp_path) for text in ROLLOUTS[rollout]]
            load_params(PARAMS, [*told, *said])
        with ExitStack() as patched:
            patched.enter_context(patch(closed_loop._WRITE_PAGE))
            for place, value in recipe.patches.items():
                patched.enter_context(patch(place, value))


@pytest.fixture
def done(tmp_path: Path) -> Path:
    """A folder in which all of a table has been done: policies with errors 0.1, 0.2, …"""
    rng = np.random.default_rng(0)
    for place, name in enumerate(TABLES["experts"].recipes):
        for seed in range(2):
            folder = tmp_path / f"{name.replace(' ', '-')}-{seed}"
            (folder / "report").mkdir(parents=True)
            (folder / "on time").mkdir()
            error = 0.1 * (place + 1)
            groups = [f"g{n},{error},{2 * error},10,80" for n in range(5)]
            heads = "group,policy_executed,policy_overall,executed_entries,overall_entries"
            (folder / "report" / "groups.csv").write_text("\n".join([heads, *groups]))
            (folder / "on time" / "metrics.json").write_text("{}")
            ended = [f"{rng.random() > error},{error}" for _ in range(50)]
            episodes = "\n".join(["success,lateral_mm", *ended])
            (folder / "on time" / "episodes.csv").write_text(episodes)
            beside = "\n".join(["controller,success,lateral_mm", *["expert,True,0.1"] * 50])
            (folder / "on time" / "beside.csv").write_text(beside)
    return tmp_path


def run(monkeypatch: pytest.MonkeyPatch, capsys: Any, *arguments: str) -> dict[str, Any]:
    """The last line that the command prints; nothing may be trained."""

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("all is done already")

    monkeypatch.setattr(closed_loop, "run", never)
    monkeypatch.setattr("sys.argv", ["closed_loop", *arguments])
    closed_loop.main()
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_finished_table_is_told_from_its_files(done, monkeypatch, capsys):
    rows = run(monkeypatch, capsys, "experts", "--out", str(done), "--episodes", "50")["rows"]
    assert [label.partition(" | ")[0] for label in rows] == list(TABLES["experts"].recipes)
    row = rows["diffusion | on time"]
    assert row["executed"] == pytest.approx([0.2, 0.2, 0.2])
    assert row["overall_difference"] == pytest.approx([0.2, 0.2, 0.2])
    rate, low, high = row["success"]
    assert low < rate < high and high - low == pytest.approx(0.16, abs=0.02)  # of 100, at 0.8


def test_more_episodes_are_rolled_out_again(done, monkeypatch, capsys):
    with pytest.raises(AssertionError, match="all is done already"):
        run(monkeypatch, capsys, "experts", "--out", str(done), "--episodes", "60")
