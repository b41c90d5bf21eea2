"""The nine mistakes of the old code: what it did, in a few lines, fails what ours passes.

Ours is asked through the doors that training uses: the data set, the store, the expert, the policy.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from pipeline.base.config import Source, TrainHeadParams, VLMParams
from pipeline.base.digests import file_digest
from pipeline.base.errors import RecordingError
from pipeline.data import Recording, open_recordings
from pipeline.datasets import UnifiedVLADataset
from pipeline.policy.diffusion import NoiseSchedule
from pipeline.policy.policy import Policy
from pipeline.policy.regression import RegressionActionExpert
from pipeline.simulation.insertion_formats import ABUTTING, write_new
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.run import policy_shape
from pipeline.train.statistics import fit_normalization
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.pooling import batch_weights, pool
from pipeline.vlm.preparation import TokenLayout
from pipeline.vlm.slots import Slot

WINDOWS = Windows(8, 65, 100, 0.1, 1.0)
SMALL = {
    "sensor_encoder": {"channels": [16], "layers": 1, "heads": 2, "output_dim": 16},
    "state_encoder": {"dim": 16, "layers": 1, "heads": 2, "output_dim": 16},
    "expert": {"dim": 16, "layers": 1, "heads": 2, "dropout": 0.0},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One simulated recording of the new format, whose arm turns beyond 180 degrees."""
    root = tmp_path_factory.mktemp("recording")
    episode = simulate_episode(5, 1.767e9, crosses_180=True)
    write_new(root / "Red_point", episode, ABUTTING, robot_clock=True)
    return root


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    return open_recordings([Source(name="new", path=str(folder))]).recordings[0]


@pytest.fixture(scope="module")
def live(folder: Path) -> UnifiedVLADataset:
    """The recording with its frames."""
    return UnifiedVLADataset(folder)


@pytest.fixture
def store(tiny_store: Callable[..., Path], tmp_path: Path) -> FeatureStore:
    return FeatureStore.open(tiny_store(tmp_path))


def policy_of(store: FeatureStore) -> Policy:
    """A regression policy that learnt nothing yet, normalised as a training on this store does."""
    torch.manual_seed(0)
    normalization = fit_normalization(store, np.arange(store.ticks), WINDOWS)
    params = TrainHeadParams.model_validate(SMALL)
    return Policy(params, policy_shape(store, normalization), normalization).eval()


def test_1_a_feature_does_not_depend_on_its_batch_mates() -> None:
    hidden = torch.randn(1, 4, 8)
    padding = torch.randn(1, 3, 8)  # what the model says over padding is anything
    padded = torch.cat([hidden, padding], dim=1)
    layouts = [TokenLayout(4, (), (1, 1))]
    weights = batch_weights((Slot(-1, True, "mean"),), layouts, 7)
    real = torch.tensor([[True] * 4 + [False] * 3])

    alone = hidden.mean(dim=1)
    assert not torch.allclose(padded.mean(dim=1), alone)  # the old way
    torch.testing.assert_close(pool(padded, weights, real)[:, 0], alone)


def test_2_the_answer_is_not_an_input() -> None:
    torch.manual_seed(0)
    expert = RegressionActionExpert(horizon=8, action_dim=3, dim=16, layers=1, heads=2, dropout=0.0)
    context, valid = torch.randn(4, 2, 16), torch.ones(4, 8, dtype=torch.bool)
    said = expert.act(context).detach()
    assert said.std() > 0
    for _ in range(2):
        target = torch.randn(4, 8, 3, requires_grad=True)
        z_chunk = target
        assert not slope(F.smooth_l1_loss(z_chunk + said, target), target).any()  # the old way

        loss, _ = expert.loss(context, target, valid)
        expected = F.smooth_l1_loss(said, target)
        torch.testing.assert_close(loss, expected)
        torch.testing.assert_close(slope(loss, target), slope(expected, target))
    assert torch.equal(expert.act(context), said)


def slope(loss: Tensor, target: Tensor) -> Tensor:
    """How the loss moves with the target; a prediction that sees it would move along."""
    return torch.autograd.grad(loss, target)[0]


def test_3_a_window_does_not_show_the_future(recording: Recording, live: UnifiedVLADataset) -> None:
    for name, stream in (("sensor", recording.sensor()), ("state", recording.state())):
        assert stream is not None
        for index in range(0, len(live), 7):
            item = live[index]
            now, window = float(item["time"]), len(item[name])
            middle = int(np.abs(stream.time - now).argmin())
            future = stream.time[middle : middle + window // 2]
            assert len(future) < 2 or future[-1] > now  # the old way

            known = stream.values[stream.time <= now][-window:]
            assert item[f"{name}_valid"] == len(known)
            assert np.array_equal(item[name][window - len(known) :], known)


def test_4_frames_are_picked_by_time(recording: Recording, live: UnifiedVLADataset) -> None:
    stream = recording.state()
    assert stream is not None
    stale_s: list[float] = []
    for index in range(0, len(live), 12):
        item = live[index]
        for view, camera in recording.cameras().items():
            now = float(item["time"])
            row = int(np.searchsorted(stream.time, now, side="right")) - 1
            old = min(row, len(camera.time) - 1)  # a pose row's number for a frame's
            stale_s.append(now - camera.time[old])
            (shown,) = camera.read([int(np.flatnonzero(camera.time <= now)[-1])])
            assert np.array_equal(item["images"][view], shown)
    assert min(stale_s) < -1.0


def old_key(spec: FeatureSpec, prompt: str, frames: object, index: int = 7) -> str:
    """It knew nothing of the model and of the frames."""
    return f"insertion_{index}_{hash(prompt)}"


def test_5_other_frames_are_another_key(demo_checkpoint: Path) -> None:
    params = VLMParams.model_validate({"checkpoint": str(demo_checkpoint)})
    spec = feature_spec(params, "float32", ["View1"], file_digest)
    rng = np.random.default_rng(0)
    before, after = rng.integers(0, 255, (2, 8, 8, 3), np.uint8)

    assert len({old_key(spec, "go", {"View1": frame}) for frame in (before, after)}) == 1
    assert len({spec.row_key("go", {"View1": frame}) for frame in (before, after)}) == 2


def test_6_the_mean_follows_the_clamped_sample() -> None:
    schedule = NoiseSchedule(100)
    step, noisy = 90, torch.full((1, 1, 1), 2.0)
    epsilon = torch.full((1, 1, 1), -1.0)  # stands for a sample far beyond the clamp
    at = torch.tensor([step])
    clamped = schedule.sample_of("epsilon", epsilon, noisy, at).clamp(-1, 1)
    before, now = schedule.alpha_bar[step - 1], schedule.alpha_bar[step]
    alpha, beta = now / before, 1 - now / before
    expected = (before.sqrt() * beta * clamped + alpha.sqrt() * (1 - before) * noisy) / (1 - now)

    old = (noisy - beta / (1 - now).sqrt() * epsilon) / alpha.sqrt()  # clamped is not in it
    assert (old - expected).abs() > 0.05
    torch.testing.assert_close(schedule.posterior(clamped, noisy, step)[0], expected)


def test_7_a_damaged_file_is_an_error_that_names_it(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "damaged"))
    (sensor,) = copy.glob("**/sensor_data.npz")
    sensor.write_bytes(sensor.read_bytes()[:1000])

    def old(path: Path) -> np.ndarray:
        try:
            with path.open("rb") as file:
                return np.load(file)["data"]
        except Exception:
            return np.zeros((65, 1026))

    assert not old(sensor).any()  # trained on, as if the needle had felt nothing
    with pytest.raises(RecordingError, match=r"sensor_data\.npz"):
        UnifiedVLADataset(copy)


def test_8_the_unit_of_a_channel_is_nothing_to_the_loss(store: FeatureStore) -> None:
    ticks = np.arange(0, store.ticks, 7)
    batch = store.gather(ticks)
    policy = policy_of(store)
    loss, parts = policy.loss(batch, batch.action, batch.action_valid)

    factor = torch.tensor([1024.0, 1 / 64, 8.0, 0.5, 1.0])  # the gripper has no unit
    for name in ("tick/action", "vl/features", "sensor/values", "state/values"):
        values = store.array(name)
        values *= factor.numpy() if name == "tick/action" else np.float32(256.0)
    scaled = store.gather(ticks)
    assert torch.equal(scaled.action, batch.action * factor)
    assert raw_loss(scaled) > 100 * raw_loss(batch)  # the old way: only the largest is learnt
    rescaled = policy_of(store)
    torch.testing.assert_close(
        rescaled.loss(scaled, scaled.action, scaled.action_valid), (loss, parts)
    )
    torch.testing.assert_close(rescaled.act(scaled), policy.act(batch) * factor)


def raw_loss(batch: Any) -> float:
    """Of always saying nothing, in physical units."""
    return float(F.smooth_l1_loss(torch.zeros_like(batch.action), batch.action))


@pytest.mark.parametrize("kind", ["rotvec", "euler_delta"])
def test_9_a_turn_through_180_degrees_is_small(recording, folder, kind):
    poses = recording.poses()
    assert poses is not None
    data = UnifiedVLADataset(folder, action_rotation=kind)
    ours = data.__getitems__(range(len(data))).action[..., 3:6]

    old = np.diff(poses.values[::10, 3:], axis=0)
    assert np.abs(old).max() > 300
    assert ours.abs().max() < 20
