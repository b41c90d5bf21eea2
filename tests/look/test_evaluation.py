"""The page of an evaluation says what was judged, and a browser finds nothing wrong with it."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.base.config import EvaluateParams, TrainHeadParams
from pipeline.base.text import Table
from pipeline.evaluate.ablation import evaluate_ablation
from pipeline.evaluate.baselines import Baselines
from pipeline.evaluate.evaluation import Evaluation, judged_document
from pipeline.evaluate.figures import Figure, Rivalry, rivalry
from pipeline.evaluate.tables import ablation_table, error_table
from pipeline.look.evaluation import evaluation_report
from pipeline.look.page.blocks import Outline, Report, Section
from pipeline.look.page.writing import PAGE, write_report
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.policy import Policy
from pipeline.policy.shape import Anchor
from pipeline.store import FeatureStore, episode_name
from pipeline.train.batches import Windows
from pipeline.train.predictions import predict
from pipeline.train.run import policy_shape
from pipeline.train.scores import action_space, compare
from pipeline.train.split import Split
from pipeline.train.statistics import fit_normalization
from pipeline.train.training_data import source_of, split_parts


@pytest.fixture(scope="module")
def judgement(
    tiny_store: Callable[..., Path],
    tiny_head: Callable[..., dict[str, Any]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Evaluation:
    """An untrained policy on three held-out episodes whose recordings are nowhere."""
    folder = tmp_path_factory.mktemp("judged")
    store = FeatureStore.open(tiny_store(folder, sensor_channels=40))
    params = TrainHeadParams.model_validate(tiny_head(folder, horizon=4))
    windows = Windows.of(params)
    normalization = fit_normalization(store, np.arange(store.ticks), windows)
    shape = policy_shape(store, normalization)
    policy = Policy(params, shape, normalization).eval()
    ticks = np.arange(90, 180)
    names = {episode_name(episode): episode_name(episode) for episode in store.episodes}
    checkpoint = PolicyCheckpoint(
        params=params,
        shape=shape,
        normalization=normalization,
        source=source_of(store),
        split=split_parts(store, Split(ticks[:0], ticks[:0], ticks, names, None)),
        step=20,
        weights=policy.state_dict(),
    )
    baselines = Baselines(store, np.arange(90), 4, normalization.features)
    predictions = predict(policy, store, ticks, windows, 64)
    space, phases = action_space(store, normalization), np.where(ticks % 2, "approach", "hold")
    comparison = compare(predictions, baselines.act(ticks), space, None, phases)
    return Evaluation(
        name="models/head",
        checkpoint=checkpoint,
        store=store,
        comparison=comparison,
        predictions=predictions,
        energy=None,
        study=evaluate_ablation(checkpoint, policy, store, ticks, baselines, 64),
        judged=judged_document(checkpoint, policy, store, EvaluateParams()),
    )


def test_trainings_that_differ_in_seed_or_fold_have_one_recipe(judgement: Evaluation) -> None:
    def recipe(**changed: Any) -> str:
        document = judgement.checkpoint.params.model_dump() | changed
        params = TrainHeadParams.model_validate(document)
        checkpoint = replace(judgement.checkpoint, params=params)
        policy = judgement.checkpoint.policy()
        judged = judged_document(checkpoint, policy, judgement.store, EvaluateParams())
        return judged["policy"]["recipe"]

    folds = [{"split": {"folds": 2, "fold": fold}, "seed": fold} for fold in (0, 1)]
    assert recipe(**folds[0]) == recipe(**folds[1])
    assert len({recipe(), recipe(**folds[0]), recipe(lr=0.5)}) == 3


def section(report: Report, title: str) -> Section:
    (found,) = (one for one in report.sections if one.title == title)
    return found


def test_tables_say_what_the_comparison_says(judgement: Evaluation) -> None:
    comparison = judgement.comparison
    report = evaluation_report(judgement)
    executed, chunk, differences, phases, dimensions, episodes, streams = report.blocks(Table)
    assert executed.rows == error_table(comparison.executed).rows
    assert chunk.rows == error_table(comparison).rows
    assert [row[0] for row in differences.rows] == ["executed"] * 3 + ["chunk"] * 3
    assert differences.rows[-1][3] == rivalry(comparison).ratio
    assert [(row[0], row[-1]) for row in phases.rows] == [("approach", 45), ("hold", 45)]
    assert [row[0] for row in dimensions.rows] == list(comparison.names)
    assert dimensions.rows[1][2] == comparison.scores["policy"].mae[1]
    worst_first = sorted(comparison.overall_by_episode("policy"), reverse=True)
    assert [row[1:3] for row in episodes.rows] == [(30, overall) for overall in worst_first]
    assert judgement.study is not None
    assert streams.rows == ablation_table(judgement.study).rows
    assert dict(report.tiles)["test episodes"] == "3"
    error = comparison.executed.overall("policy")
    assert float(report.tiles[0][1]) == pytest.approx(error, rel=1e-2)
    trained, spec, _, judged = report.blocks(Outline)
    assert trained.content["horizon"] == judged.content["on"]["horizon"] == 4
    assert spec.content["digest"] == "tiny-spec"


@pytest.mark.parametrize(
    ("policy", "low", "high", "verdict"),
    [
        (52.0, 40, 60, "the policy is 52 times worse than repeating the last action"),
        (1.3, 0.1, 0.5, "the policy is 30% worse than repeating the last action"),
        (0.25, -0.9, -0.6, "the policy errs 4 times less than repeating the last action"),
        (1.3, -0.1, 0.5, "Not told apart from repeating the last action"),
    ],
)
def test_the_verdict_is_a_sentence(
    judgement: Evaluation, monkeypatch: pytest.MonkeyPatch, policy: float, low: float, high: float,
    verdict: str,
) -> None:  # fmt: skip
    difference = Figure(policy - 1, low, high)
    rivals = Rivalry(Figure(policy, None, None), "repeat_last", Figure(1.0, None, None), difference)
    monkeypatch.setattr("pipeline.look.evaluation.rivalry", lambda part: rivals)
    report = evaluation_report(judgement)
    assert verdict in report.verdict
    advice = " ".join(block.words for block in section(report, "What to do next").blocks)
    assert ("docs/worse.md" in advice) == ("less" not in verdict)
    assert "Hold out more" in advice and "Five folds" in advice
    assert ("vla-cache rollout" in advice) == ("less" in verdict)


def test_an_anchored_policy_is_judged_by_rollouts(judgement, monkeypatch):
    error, none = Figure(3.0, None, None), Figure(1.0, None, None)
    rivals = Rivalry(error, "linear_fit", none, Figure(2.0, 1.0, 3.0))
    monkeypatch.setattr("pipeline.look.evaluation.rivalry", lambda part: rivals)
    shape = replace(judgement.checkpoint.shape, anchors=(Anchor((0,), (0,)),))
    anchored = replace(judgement, checkpoint=replace(judgement.checkpoint, shape=shape))
    report = evaluation_report(anchored)
    assert report.verdict.endswith(", as an anchored policy may be")
    assert "on purpose" in section(report, "What to do next").blocks[0].words


def test_what_spoils_the_judgement_stands_at_the_top(judgement: Evaluation) -> None:
    """Dimensions that hardly move, and episodes that were trained on before."""
    names = tuple(f"joint_{index}" for index in range(5))
    scale = np.array([1.0, 1.0, 1.0, 0.001, 0.0])
    still = replace(judgement.comparison, names=names, units=("",) * 5, scale=scale)
    test = judgement.checkpoint.split["test"]
    checkpoint = replace(judgement.checkpoint, split={"train": test, "val": {}, "test": test})
    odd = replace(judgement, comparison=still, checkpoint=checkpoint)
    summary = evaluation_report(odd).summary
    assert "Hardly moving: joint_3" in summary and "3 test episode(s) were cut by time" in summary
    share = rivalry(still.without_low_variance()).ratio
    assert share is not None and share != rivalry(still).ratio
    assert f"{share:.2f} times the best baseline's" in summary
    assert not re.search("ardly mov|trained on", evaluation_report(judgement).summary)


@pytest.mark.slow
def test_the_page_is_sound(judgement, tmp_path, assert_page_is_sound):
    write_report(tmp_path, evaluation_report(judgement))
    assert_page_is_sound(tmp_path / PAGE)
