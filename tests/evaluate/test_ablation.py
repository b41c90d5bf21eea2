"""A stream that decides the action must be missed, and one that decides nothing must not."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import SplitParams, TrainHeadParams
from pipeline.evaluate.ablation import AblationStudy, delays, evaluate_ablation, zeroed
from pipeline.evaluate.baselines import Baselines
from pipeline.evaluate.figures import rivalry
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.policy import Policy
from pipeline.store import FeatureStore
from pipeline.train.run import policy_shape
from pipeline.train.split import split_by_episode
from pipeline.train.training_data import source_of, split_parts

Make = Callable[..., Any]

PARAMS = {
    "sensor_encoder": {"channels": [16], "layers": 0, "heads": 1, "output_dim": 16},
    "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8, "patch": 1},
    "expert": {"dim": 16, "layers": 1, "heads": 1, "dropout": 0.0},
    "horizon": 1,
    "sensor_window": 1,
    "state_window": 1,
    "batch_size": 64,
}


def trained(store: FeatureStore, steps: int, **params: object) -> tuple[PolicyCheckpoint, Policy]:
    """A policy trained on the third action, which is the newest reading's first channel."""
    wanted = TrainHeadParams.model_validate(PARAMS | params)
    split = split_by_episode(store, SplitParams(val=0, test=0.3))
    # Nothing but the sensor decides the action.
    store.array("tick/action")[:, [0, 1, 3]] = 0.5

    def statistics(name: str) -> ChannelStatistics:
        values = store.array(name).astype(np.float64)
        return ChannelStatistics(values.mean(0), values.std(0), len(values))

    names = ("tick/action", "vl/features", "sensor/values", "state/values")
    normalization = Normalization(*map(statistics, names))
    torch.manual_seed(0)
    shape = policy_shape(store, normalization)
    policy = Policy(wanted, shape, normalization)
    optimizer = torch.optim.Adam(policy.parameters(), lr=3e-3)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        batch = store.gather(rng.choice(split.train, 64), 1, 1, 1)
        loss, _ = policy.loss(batch, batch.action, batch.action_valid)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    parts = {"split": split_parts(store, split), "step": steps, "weights": policy.state_dict()}
    checkpoint = PolicyCheckpoint(wanted, shape, normalization, source_of(store), **parts)
    return checkpoint, policy.eval()


def studied(
    store: FeatureStore,
    ticks: np.ndarray | None = None,
    steps: int = 1,
    samples: int = 1,
    lacking: Sequence[int] = (),
    **params: Any,
) -> AblationStudy | None:
    """The study of such a policy on these ticks, else on the test ticks.

    The episodes `lacking` have no sensor once the policy is trained.
    """
    checkpoint, policy = trained(store, steps, **params)
    split = split_by_episode(store, SplitParams(val=0, test=0.3))
    start = store.array("episode/sensor_start")
    for episode in lacking:
        start[episode + 1] = start[episode]
    rules = Baselines(store, split.train, 1, None)
    here = split.test if ticks is None else ticks
    return evaluate_ablation(checkpoint, policy, store, here, rules, 64, samples)


@pytest.fixture(scope="module")
def trained_store(tiny_store: Make, tmp_path_factory: pytest.TempPathFactory) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path_factory.mktemp("study"), episodes=14))


@pytest.fixture(scope="module")
def study(trained_store: FeatureStore) -> AblationStudy:
    return studied(trained_store, steps=120)


def test_a_stream_that_decides_the_action_is_missed_and_others_are_not(study):
    assert rivalry(study.intact).ratio < 0.5
    for ablated in study.ablated:
        multiple = study.times_intact(ablated).value
        assert multiple > 2 if ablated.stream == "sensor" else multiple < 1.5, ablated.how


def test_the_ways_to_spoil_are_those_that_mean_something(study: AblationStudy) -> None:
    names = ("sensor", "state", "features")
    hows = {name: [s.how for s in study.ablated if s.stream == name] for name in names}
    assert tuple(dict.fromkeys(s.stream for s in study.ablated)) == names
    late = ["delayed 50 ms", "delayed 100 ms", "delayed 200 ms"]
    assert hows["sensor"] == hows["state"] == ["zeroed", *late]
    # A VL row serves 3 ticks of 100 ms: nothing shorter can be had.
    assert hows["features"] == ["zeroed", "delayed 300 ms"]
    assert study.notes[-1] == "features delayed: by whole VL rows, of 300 ms each"
    assert all(one.comparison.ticks == study.intact.ticks for one in study.ablated)


def test_the_first_ticks_of_an_episode_are_not_judged(tiny_store, tmp_path):
    """A delay would find nothing there."""
    store = FeatureStore.open(tiny_store(tmp_path, reuse=1))
    found = studied(store, np.arange(30, 60))
    assert found is not None and found.intact.ticks == 27
    assert found.notes[-1].endswith("of 100 ms each")
    assert studied(store, np.arange(30, 33)) is None


@pytest.mark.parametrize(("lacking", "judged"), [([1], 54), ([0, 1, 2], 0)])
def test_a_stream_is_ablated_where_the_episodes_have_it(tiny_store, tmp_path, lacking, judged):
    """Of three episodes with 27 ticks each, some lack the sensor."""
    store = FeatureStore.open(tiny_store(tmp_path))
    found = studied(store, np.arange(90), lacking=lacking)
    assert found is not None and found.intact.ticks == 81
    assert {one.comparison.ticks for one in found.ablated if one.stream == "state"} == {81}
    of_sensor = [one for one in found.ablated if one.stream == "sensor"]
    assert {one.comparison.ticks for one in of_sensor} == ({judged} if judged else set())
    assert all(one.intact.ticks == judged for one in of_sensor)
    assert f"sensor: judged on the {judged} of 81 ticks whose episode has it" in found.notes


def test_an_alteration_leaves_the_batch_and_the_other_streams_alone(store: FeatureStore) -> None:
    batch = store.gather(np.arange(40, 44), 2, 3, 3)
    before, mean = batch.sensor.clone(), np.arange(5.0)
    at_mean = zeroed("sensor", mean)(batch)
    assert torch.equal(at_mean.sensor, torch.tensor(mean).float().expand(4, 3, 5))
    assert torch.equal(batch.sensor, before)
    assert at_mean.features is batch.features and at_mean.action is batch.action


@pytest.mark.parametrize(("ticks", "how"), [(2, "delayed 330 ms"), (1, "delayed inf ms")])
def test_the_time_between_episodes_is_no_step_of_ticks(tiny_store, tmp_path, ticks, how):
    """Where recorded rows are the ticks, their median step says how long a delay is."""
    store = FeatureStore.open(tiny_store(tmp_path, ticks=ticks))
    store.attrs["action_hz"] = None
    time = store.array("tick/time")
    starts = 45.0 * np.arange(6)
    time[::ticks] = starts
    time[ticks - 1 :: ticks] = starts + (ticks - 1) * np.tile([0.1, 0.12], 3)
    assert list(delays(store, "features")) == [how]


def test_a_study_of_a_sampling_policy_is_of_few_samples(tiny_store: Make, tmp_path: Path) -> None:
    store = FeatureStore.open(tiny_store(tmp_path))
    many, few = (studied(store, model_type="flow_matching", samples=asked) for asked in (16, 4))
    assert many.samples == few.samples == 4
    assert few.intact.overall("policy") == many.intact.overall("policy")
