"""The experiments that the documentation's tables come from."""

import json
import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch

from experiments import closed_loop, sight
from experiments.recipes import (
    RECIPES,
    ROLLOUTS,
    STORES,
    TABLES,
    _with_motion,
    _with_motion_names,
    store_settings,
)
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
            said = [text.format(folder=tmp_path) for text in ROLLOUTS[rollout]]
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


def test_own_motion_is_how_far_each_channel_is_from_now() -> None:
    kinds = ("deg", "plain", "rotation", "rotation", "rotation")
    states = torch.tensor([[[10.0, 5.0, -179.0, 0, 0], [11.0, 7.0, 180.0, 0, 0]]])
    moved = _with_motion(states, kinds)[..., -5:]
    degree = math.radians(1)
    wanted = [[-math.sin(degree), -2.0, math.sin(degree), 0, 0], [0.0] * 5]
    torch.testing.assert_close(moved[0], torch.tensor(wanted), atol=1e-5, rtol=0)
    assert len(_with_motion_names(["a"] * 5, kinds)) == _with_motion(states, kinds).shape[-1]


def test_sight_errs_by_what_features_do_not_tell() -> None:
    rng = np.random.default_rng(0)
    offset = rng.uniform(-4, 4, (600, 2))
    noisy = offset + 0.3 * rng.standard_normal(offset.shape)
    features = np.stack([noisy @ rng.normal(size=(2, 6)) for _ in range(3)], axis=1)
    told = sight._told(features.astype(np.float32), offset, np.arange(600) // 10)
    assert told["sigma_mm"] == pytest.approx([0.3, 0.3], abs=0.03) and told["slots"] == 3
    blind = sight._told(rng.normal(size=(600, 1, 4)).astype(np.float32), offset, np.arange(600))
    assert blind["sigma_mm"] == pytest.approx([2.3, 2.3], abs=0.15)
