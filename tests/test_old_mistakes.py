"""The nine mistakes of the old code: what it did, in a few lines, fails what ours passes.

Ours is asked through the doors that training uses: the data set, the store, the expert, the policy.
"""

import pickle
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.base.config import Params, Source, SplitParams, TrainHeadParams, VLMParams
from pipeline.base.digests import ContentDigests
from pipeline.base.errors import RecordingError
from pipeline.data import Recording, open_recordings
from pipeline.datasets import UnifiedVLADataset
from pipeline.extract import extract
from pipeline.policy.diffusion import DiffusionActionExpert, NoiseSchedule
from pipeline.policy.policy import Policy
from pipeline.policy.regression import RegressionActionExpert
from pipeline.simulation.insertion_formats import ABUTTING, write_new
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import FeatureStore
from pipeline.train.batches import Windows
from pipeline.train.run import policy_shape
from pipeline.train.split import split_by_episode
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


@pytest.fixture(scope="module")
def cached(
    folder: Path, demo_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory
) -> UnifiedVLADataset:
    """The recording as it was extracted."""
    target = tmp_path_factory.mktemp("store") / "one.zarr"
    document = {
        "data": {"root": str(folder), "sources": [{"name": "new", "path": "."}]},
        "vlm": {
            "checkpoint": str(demo_checkpoint),
            "image_resize_height": 28,
            "image_resize_width": 28,
        },
        "extract": {"store": str(target)},
    }
    extract(Params.model_validate(document), say=lambda _: None)
    return UnifiedVLADataset(store=target)


@pytest.fixture(params=["live", "cached"])
def dataset(request: pytest.FixtureRequest) -> UnifiedVLADataset:
    return request.getfixturevalue(request.param)


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


class TestMistake2:
    @pytest.mark.parametrize("refinements", [1, 3])
    def test_the_answer_is_not_an_input(self, refinements: int) -> None:
        torch.manual_seed(0)
        expert = RegressionActionExpert(
            horizon=8, action_dim=3, dim=16, layers=1, heads=2, dropout=0.0, refinements=refinements
        )
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

    def test_nor_does_the_policy_see_it(self, store: FeatureStore) -> None:
        policy = policy_of(store)
        batch = store.gather(np.arange(5, 9))
        said = policy.action_normalizer.normalize(policy.act(batch))
        for _ in range(2):
            batch.action = torch.randn_like(batch.action)
            loss, _ = policy.loss(batch, batch.action, batch.action_valid)
            target = policy.action_normalizer.normalize(batch.action)
            parts = [F.smooth_l1_loss(said[..., at], target[..., at]) for at in GROUPS]
            torch.testing.assert_close(loss, torch.stack(parts).mean())


GROUPS = (slice(0, 3), slice(3, 4), slice(4, 5))
"""Translation, rotation and gripper among the tiny store's action channels."""


def slope(loss: Tensor, target: Tensor) -> Tensor:
    """How the loss moves with the target; a prediction that sees it would move along."""
    return torch.autograd.grad(loss, target)[0]


class TestMistake3:
    def test_a_window_does_not_show_the_future(
        self, recording: Recording, dataset: UnifiedVLADataset
    ) -> None:
        for name, stream in (("sensor", recording.sensor()), ("state", recording.state())):
            assert stream is not None
            for index in range(0, len(dataset), 7):
                item = dataset[index]
                now, window = float(item["time"]), len(item[name])
                middle = int(np.abs(stream.time - now).argmin())
                future = stream.time[middle : middle + window // 2]
                assert len(future) < 2 or future[-1] > now  # the old way

                known = stream.values[stream.time <= now][-window:]
                assert item[f"{name}_valid"] == len(known)
                assert np.array_equal(item[name][window - len(known) :], known)

    def test_no_gathered_reading_is_later_than_its_tick(self, dataset: UnifiedVLADataset) -> None:
        """Whatever the window, in a store whose readings say when they were taken."""
        store = stamped(dataset)
        ticks = np.arange(store.ticks)
        now = torch.from_numpy(store.array("tick/time") - store.array("tick/time")[0])
        for window in (1, 7, 400):
            batch = store.gather(ticks, sensor_window=window, state_window=window)
            for taken, valid in (
                (batch.sensor, batch.sensor_valid),
                (batch.state, batch.state_valid),
            ):
                assert (valid > 0).all()
                assert (taken[:, -1, 0] <= now + 1e-5).all()
                assert (taken.amax(dim=(1, 2)) <= now + 1e-5).all()


def stamped(dataset: UnifiedVLADataset) -> FeatureStore:
    """A copy of its store: for values, the time of each reading in s since the first tick."""
    store = pickle.loads(pickle.dumps(dataset)).store
    for name in ("sensor", "state"):
        since = store.array(f"{name}/time") - store.array("tick/time")[0]
        store.array(f"{name}/values")[:] = since[:, None]
    return store


class TestMistake4:
    def test_frames_are_picked_by_time(self, recording: Recording, live: UnifiedVLADataset) -> None:
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

    def test_nor_is_a_feature_of_a_later_frame(
        self, recording: Recording, cached: UnifiedVLADataset
    ) -> None:
        asked = cached.store.array("vl/time")
        for column, view in enumerate(cached.store.streams["views"]):
            clock = recording.cameras()[view].time
            newest = clock[np.searchsorted(clock, asked, side="right") - 1]
            assert np.array_equal(cached.store.array("vl/frame_time")[:, column], newest)


def old_key(spec: FeatureSpec, prompt: str, frames: object, index: int = 7) -> str:
    """It knew nothing of the model and of the frames."""
    return f"insertion_{index}_{hash(prompt)}"


FRAME = {"View1": np.zeros((8, 8, 3), np.uint8)}


class TestMistake5:
    def test_other_frames_are_another_key(self, spec_of: Callable[..., FeatureSpec]) -> None:
        spec = spec_of()
        rng = np.random.default_rng(0)
        before, after = rng.integers(0, 255, (2, 8, 8, 3), np.uint8)

        assert len({old_key(spec, "go", {"View1": frame}) for frame in (before, after)}) == 1
        assert len({spec.row_key("go", {"View1": frame}) for frame in (before, after)}) == 2

    @pytest.mark.parametrize(
        "changed",
        [
            {"image_resize_height": 112},
            {"pooling": ("mean", "last")},
            {"layers": (0,)},
            {"dtype": "float16"},
            {"prompt": "{images} {instruction}"},
        ],
    )
    def test_another_setting_is_another_key(
        self, spec_of: Callable[..., FeatureSpec], changed: dict[str, Any]
    ) -> None:
        check_other_keys(spec_of(), spec_of(**changed))

    def test_one_byte_of_the_weights_is_another_key(
        self, spec_of: Callable[..., FeatureSpec], demo_checkpoint: Path, tmp_path: Path
    ) -> None:
        copy = Path(shutil.copytree(demo_checkpoint, tmp_path / "checkpoint"))
        before = spec_of(checkpoint=str(copy))
        assert before.row_key("go", FRAME) == spec_of().row_key("go", FRAME)  # wherever it lies
        (weights,) = copy.glob("*.safetensors")
        content = bytearray(weights.read_bytes())
        content[-1] ^= 1
        weights.write_bytes(content)
        check_other_keys(before, spec_of(checkpoint=str(copy)))


def check_other_keys(before: FeatureSpec, after: FeatureSpec) -> None:
    assert old_key(before, "go", FRAME) == old_key(after, "go", FRAME)  # the old way
    assert before.digest != after.digest
    assert before.row_key("go", FRAME) != after.row_key("go", FRAME)


@pytest.fixture
def spec_of(demo_checkpoint: Path, tmp_path: Path) -> Callable[..., FeatureSpec]:
    """As extraction has it: digests of files come from the ledger beside the store."""

    def spec(**changed: Any) -> FeatureSpec:
        small = {"checkpoint": str(demo_checkpoint), "image_resize_height": 56}
        params = VLMParams.model_validate(small | {"image_resize_width": 56} | changed)
        with closing(ContentDigests(tmp_path / "files.sqlite")) as digests:
            return feature_spec(params, "float32", ["View1"], digests.of)

    return spec


class TestMistake6:
    def test_the_mean_follows_the_clamped_sample(self) -> None:
        schedule = NoiseSchedule(100, "cosine")
        step, noisy = 90, torch.full((1, 1, 1), 2.0)
        epsilon = torch.full((1, 1, 1), -1.0)  # stands for a sample far beyond the clamp
        at = torch.tensor([step])
        clamped = schedule.sample_of("epsilon", epsilon, noisy, at).clamp(-1, 1)
        before, now = schedule.alpha_bar[step - 1], schedule.alpha_bar[step]
        alpha, beta = now / before, 1 - now / before
        expected = (before.sqrt() * beta * clamped + alpha.sqrt() * (1 - before) * noisy) / (
            1 - now
        )

        old = (noisy - beta / (1 - now).sqrt() * epsilon) / alpha.sqrt()  # clamped is not in it
        assert (old - expected).abs() > 0.05
        torch.testing.assert_close(schedule.posterior(clamped, noisy, step)[0], expected)

    @pytest.mark.parametrize("prediction", ["epsilon", "sample", "v"])
    def test_a_wild_network_is_held_at_every_step(self, prediction: Any) -> None:
        torch.manual_seed(0)
        expert = DiffusionActionExpert(
            horizon=4, action_dim=2, dim=16, layers=1, heads=2, sampler="ddpm", clip=1.0,
            prediction=prediction,
        )  # fmt: skip
        wild = 1e4 * torch.ones(8, 4, 2).bernoulli().sub(0.5)
        visited: list[Tensor] = []

        def shout(_: nn.Module, asked: tuple[Tensor, ...], __: Tensor) -> Tensor:
            visited.append(asked[0])
            return wild

        expert.denoiser.register_forward_hook(shout)
        chunk = expert.act(torch.randn(8, 2, 16))
        assert len(visited) == 100
        assert max(float(noisy.abs().max()) for noisy in visited) < 6.0  # noise beside +-1
        assert chunk.abs().max() <= 1.0

    def test_the_schedule_moves_and_is_kept_with_the_weights(self) -> None:
        class Old(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.alpha_bar = torch.linspace(1, 0, 101)

        def holds(module: nn.Module) -> bool:
            kept = any("alpha_bar" in name for name in module.state_dict())
            moved = module.to("meta")
            at = [m.alpha_bar for m in moved.modules() if hasattr(m, "alpha_bar")]
            return kept and all(isinstance(x, torch.Tensor) and x.is_meta for x in at)

        assert not holds(Old())
        assert holds(DiffusionActionExpert(horizon=4, action_dim=2, dim=16, layers=1, heads=2))


class TestMistake7:
    def test_a_damaged_file_is_an_error_that_names_it(self, folder: Path, tmp_path: Path) -> None:
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

    def test_a_damaged_frame_is_an_error_that_names_it(self, folder: Path, tmp_path: Path) -> None:
        copy = Path(shutil.copytree(folder, tmp_path / "damaged"))
        data = UnifiedVLADataset(copy)
        for frame in copy.glob("**/View1/*"):
            frame.write_bytes(frame.read_bytes()[:100])
        with pytest.raises(RecordingError, match="View1"):
            data[0]

    def test_a_missing_stream_is_known_to_be_missing(self, folder: Path, tmp_path: Path) -> None:
        copy = Path(shutil.copytree(folder, tmp_path / "without"))
        (sensor,) = copy.glob("**/sensor_data.npz")
        sensor.unlink()
        item = UnifiedVLADataset(copy)[5]
        assert item["sensor"].shape == (65, 0) and item["sensor_valid"] == 0


class TestMistake8:
    def test_the_unit_of_a_channel_is_nothing_to_the_loss(self, store: FeatureStore) -> None:
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

    def test_every_channel_weighs_the_same_in_the_loss(self, store: FeatureStore) -> None:
        store.array("tick/action")[:, 0] *= 1000.0
        batch = store.gather(np.arange(store.ticks), horizon=1)
        policy = policy_of(store)

        def share(actions: Tensor) -> float:
            """Of the squared spread of the first three channels: that of the first."""
            spread = (actions - actions.mean(dim=0))[:, 0, :3].square().sum(dim=0)
            return float(spread[0] / spread.sum())

        assert share(batch.action) > 0.999  # the old way
        assert share(policy.action_normalizer.normalize(batch.action)) == pytest.approx(1 / 3)

    def test_no_episode_is_on_both_sides(self, store: FeatureStore) -> None:
        def shared(train: Any, held_out: Any) -> set[int]:
            starts = store.array("episode/tick_start")
            sides = [np.searchsorted(starts, side, side="right") for side in (train, held_out)]
            return set(sides[0].tolist()) & set(sides[1].tolist())

        shuffled = np.random.default_rng(0).permutation(store.ticks)
        assert shared(shuffled[20:], shuffled[:20])  # the old way
        split = split_by_episode(store, SplitParams(val=0, test=0.3))
        assert len(split.test) and not shared(split.train, split.test)
        train, held_out = UnifiedVLADataset(store=store).split(0.3)
        assert held_out.indices and not shared(train.indices, held_out.indices)


def raw_loss(batch: Any) -> float:
    """Of always saying nothing, in physical units."""
    return float(F.smooth_l1_loss(torch.zeros_like(batch.action), batch.action))


@pytest.mark.parametrize("kind", ["rotvec", "euler_delta"])
def test_9_a_turn_through_180_degrees_is_small(
    recording: Recording, folder: Path, kind: Any
) -> None:
    poses = recording.poses()
    assert poses is not None
    data = UnifiedVLADataset(folder, action_rotation=kind)
    ours = data.__getitems__(range(len(data))).action[..., 3:6]

    old = np.diff(poses.values[::10, 3:], axis=0)
    assert np.abs(old).max() > 300
    assert ours.abs().max() < 20
