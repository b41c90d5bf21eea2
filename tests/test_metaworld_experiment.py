"""The recorder of Meta-World's demonstrations."""

import json
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.metaworld import protocol
from experiments.metaworld.protocol import VARIANTS, Run, TrainedPolicy, found_policies
from experiments.metaworld.recording import VERSION, Record, demonstrate, record, seeds_of
from experiments.metaworld.sight import write_sight
from experiments.metaworld.table import Judged, judged, overview, success_table, write_tables
from experiments.sight import regressed
from pipeline.base.config import Source
from pipeline.base.errors import ConfigError
from pipeline.data import open_recordings
from pipeline.simulation.meta_world import HZ, VIEW, instruction_of
from pipeline.store.reader import FeatureStore


def test_no_two_purposes_or_runs_share_an_episode() -> None:
    ranges = [
        seeds_of(purpose, run)
        for purpose in ("demonstrations", "validation", "evaluation")
        for run in (0, 1, 99)
    ]
    assert len(set().union(*ranges)) == sum(map(len, ranges)) > 0
    with pytest.raises(ConfigError, match="0 to 99, found 100"):
        seeds_of("validation", 100)


@pytest.mark.usefixtures("meta_world")
@pytest.mark.extra
def test_a_set_is_what_the_expert_did_and_is_recorded_once(tmp_path: Path) -> None:
    task = "button-press-topdown-v3"
    asked = Record(version=VERSION, task=task, run=0, episodes=2, image=48)
    (kept,) = record(tmp_path, [asked], jobs=1)
    assert len(kept.seeds) == 2 and {*kept.seeds} <= {*seeds_of("demonstrations", 0)}
    folder = tmp_path / asked.task
    opened = open_recordings([Source(name="s", path=str(folder))]).recordings
    assert len(opened) == 2
    truth = demonstrate(asked, kept.seeds[0])
    assert truth is not None
    first = opened[0]
    action, state = first.action(), first.state()
    assert state is not None and action is not None and action.kind == "delta"
    np.testing.assert_array_equal(action.values, truth.columns["action"])
    np.testing.assert_array_equal(state.values, truth.columns["observation.state"])
    assert np.allclose(np.diff(state.time), 1 / HZ, atol=1e-6)
    assert first.instruction == instruction_of(asked.task)
    camera = first.cameras()[VIEW]
    film = truth.films[f"observation.images.{VIEW}"]
    assert len(camera.time) == len(film)
    shown = np.stack([*camera.read(range(len(film)))])
    np.testing.assert_array_equal(shown, film, "a policy in the simulation sees these very pixels")
    before = (folder / "meta" / "info.json").stat().st_mtime_ns
    assert record(tmp_path, [asked], jobs=1) == [kept]
    assert (folder / "meta" / "info.json").stat().st_mtime_ns == before
    for name, value in ("episodes", 3), ("version", 1):
        found = f"record.json: .*{name} {getattr(asked, name)}"
        with pytest.raises(ConfigError, match=found):
            record(tmp_path, [asked.model_copy(update={name: value})], jobs=1)


@pytest.mark.usefixtures("meta_world")
@pytest.mark.extra
def test_the_protocol_goes_from_demonstrations_to_a_table(tmp_path, monkeypatch, capsys):
    """Tiny: three demonstrations of one task, six steps, rollouts of one episode."""
    monkeypatch.setattr(protocol, "EPISODES", 3)
    blind = VARIANTS["features off"]
    blind = replace(blind, policy=(*blind.policy, "train_head.keep_every=2"))
    monkeypatch.setitem(VARIANTS, "features off", blind)
    monkeypatch.setattr("pipeline.simulation.meta_world.MAX_TICKS", 60)
    small = {"max_steps: 1500": "max_steps: 6", "eval_every: 250": "eval_every: 3"}
    text = protocol._PARAMS.read_text(encoding="utf-8")
    for old, new in small.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "params.yaml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(protocol, "_PARAMS", tmp_path / "params.yaml")
    tasks = ("button-press-topdown-v3",)
    run = protocol.Run(tmp_path / "out", ("features off",), tasks, seeds=1, episodes=1)
    run_here(run, monkeypatch)
    (policy,) = run.policies()
    assert policy.done and {2, 4, 6} <= {*policy.checkpoints}
    assert (policy.rollout(6) / "report.html").exists()
    before = {p: p.stat().st_mtime_ns for p in policy.folder.rglob("*") if p.is_file()}
    run_here(run, monkeypatch)
    assert before == {p: p.stat().st_mtime_ns for p in policy.folder.rglob("*") if p.is_file()}
    with pytest.raises(ConfigError, match="found those of another run"):
        run_here(replace(run, settings=("train_head.lr=0.1",)), monkeypatch)
    with pytest.raises(ConfigError, match=r"vlm\.dtyp"):
        run_here(replace(run, out=tmp_path / "new", settings=("vlm.dtyp=x",)), monkeypatch)
    assert not (tmp_path / "new").exists()
    assert not replace(policy, run=replace(run, episodes=2)).done, "more are to be rolled out"
    (one,) = judged(run.out)
    assert one.task == tasks[0] and {len(ended) for ended in one.successes.values()} == {1}
    capsys.readouterr()
    assert write_tables(run.out).exists()
    tables = json.loads((run.out / "tables.json").read_text())
    made = {part: made for part, (made, *_) in tables["parts"].items()}
    assert made["recorded episodes"] == 3 and made["policies"] == 1, "what is there is not made"
    store = FeatureStore.open(policy.store)
    assert 0 < made["extracted rows"] <= len(store.array("vl/features"))
    table = tables["variants"]["features off"]
    assert list(table) == [*tasks, "mean of 1"] and table["mean of 1"][-2:] == [1, 1]
    assert "features off" in capsys.readouterr().out


def test_a_mean_has_only_trainings_that_are_finished_for_every_task(tmp_path: Path) -> None:
    def one(task: str, seed: int, success: list[bool]) -> Judged:
        policy = TrainedPolicy(Run(tmp_path, ("reuse 3",)), "reuse 3", task, seed)
        policy.folder.mkdir(parents=True)
        return Judged(policy, task, {4: success, 8: success}, 8)

    both = [one("hammer-v3", 0, [True, True]), one("drawer-open-v3", 0, [False, False])]
    policies = [*both, one("hammer-v3", 1, [True, True])]
    with pytest.raises(ConfigError, match="no finished policy"):
        write_tables(tmp_path)
    assert {(p.variant, p.task, p.seed) for p in found_policies(tmp_path)} == {
        ("reuse 3", p.task, p.policy.seed) for p in policies
    }
    hammer, drawer, mean = success_table("reuse 3", policies).rows
    assert hammer[-2:] == (2, 4) and drawer[-2:] == (1, 2)
    assert mean[0] == "mean of 2" and mean[1] == "50.0" and mean[-2:] == (2, 4)
    elsewhere = [one("assembly-v3", 0, [True])]
    rows = {row[0]: row[1:] for row in overview({"a": policies, "b": elsewhere}).rows}
    assert rows["a"][:3] == ("100%", "0%", "") and rows["a"][-1] == ""
    assert overview({"a": policies}).rows[0][-1].startswith("50%")


def run_here(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """`run_protocol` without processes of its own, which would not see what is replaced here."""

    class Here:
        def __init__(self, *_: object, **__: object) -> None: ...

        def submit(self, task: Callable[..., object], *told: object) -> Future[object]:
            done: Future[object] = Future()
            done.set_result(task(*told))
            return done

        def shutdown(self, **_: object) -> None: ...

    monkeypatch.setattr(protocol, "ProcessPoolExecutor", Here)
    protocol.run_protocol(run)


def test_a_regression_finds_places_in_rows_that_it_did_not_see() -> None:
    features = np.random.default_rng(0).standard_normal((60, 3, 4)).astype(np.float32)
    target = 10 * features[:, 1, :1].astype(float) + 5  # a single coordinate stays a column
    known = np.where(np.arange(60)[:, None] < 40, target, np.nan)
    told = regressed(features, known, slice(0, 40), slice(40, None))
    np.testing.assert_allclose(told, target[40:], atol=1)


@pytest.mark.usefixtures("meta_world")
@pytest.mark.extra
def test_sight_has_a_row_for_each_variant_beside_the_mean(tmp_path: Path) -> None:
    run = Run(tmp_path / "out", ("mean",), ("button-press-topdown-v3",))
    table = write_sight(run, fitted=(4, 8), held=4)
    blind, seen = table.rows
    assert [blind[1], seen[1]] == ["places' mean", "mean"] and len({*blind[2:]}) == 1
    kept = json.loads((run.out / "sight.json").read_text())
    assert kept["fitted"] == [4, 8] and kept["median_error_mm"] == [[*row] for row in table.rows]
    with pytest.raises(ConfigError, match="run the variant tuned first"):
        write_sight(replace(run, variants=("tuned",)))


def test_every_variant_gives_params_that_can_be_read(tmp_path: Path) -> None:
    text = protocol._PARAMS.read_text(encoding="utf-8").replace("{out}", str(tmp_path))
    (tmp_path / "params.yaml").write_text(text, encoding="utf-8")
    policies = [*Run(tmp_path, tuple(VARIANTS), seeds=2).policies()]
    assert len({policy.folder for policy in policies}) == len(policies)
    stores: dict[Path, set[str]] = {}
    for policy in policies:
        params = policy.params()
        assert params.rollout.environment == tuple(f"metaworld:{task}" for task in policy.tasks)
        features = f"{params.vlm} {params.data}"
        stores.setdefault(params.extract.store, set()).add(features)
    assert all(len(features) == 1 for features in stores.values()), "a store has one kind of rows"
