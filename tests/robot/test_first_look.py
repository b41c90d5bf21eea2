"""What a robot sends first is what training saw, or the wrong reading of it is named."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.base.errors import ObservationError
from pipeline.base.provenance import GoldenRow
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.normalization import ChannelStatistics
from pipeline.robot.first_look import FirstLook
from pipeline.simulation.environment import InsertionEnvironment

Frames = dict[str, np.ndarray]
NAMES = ("joint_1", "joint_2", "joint_3", "x", "y")
UNITS = ("deg", "deg", "deg", "mm", "mm")
REST = np.array([20.0, -70.0, 110.0, 300.0, -40.0])


def seen(seed: int) -> Frames:
    """The cameras of the phantom at the beginning of an episode."""
    robot = InsertionEnvironment()
    robot.reset(seed=seed)
    return {view: frame for view, (_, frame) in robot.frames().items()}


def look_of(
    rows: Sequence[Frames], kinds: Sequence[str] = ("deg",) * 3 + ("plain",) * 2
) -> FirstLook:
    """A first look with these golden frames, and a state around `REST`."""
    none = np.zeros((1, 1), np.float32)
    golden = [GoldenRow(b"", "", "", frames, none, none[0] > 0) for frames in rows]
    rest, angles = REST, np.deg2rad(REST[:3])
    mean = np.concatenate([rest[3:], np.sin(angles), np.cos(angles)])
    std = np.array([5.0, 5.0, *[0.03] * 6])
    checkpoint: Any = SimpleNamespace(
        golden=golden,
        normalization=SimpleNamespace(state=ChannelStatistics(mean, std, 100)),
        shape=SimpleNamespace(kinds=tuple(kinds)),
        source={"streams": {"state": {"names": list(NAMES), "units": list(UNITS)}}},
    )
    return FirstLook(checkpoint)


@pytest.fixture(scope="module")
def look() -> FirstLook:
    return look_of([seen(seed) for seed in range(4)])


def swapped(frames: Frames, first: str, second: str) -> Frames:
    return frames | {first: frames[second], second: frames[first]}


class TestFrames:
    @pytest.mark.parametrize("gains", [(0.5, 0.5, 0.5), (1.2, 1, 0.8)])
    def test_right_ones_pass_under_another_lamp_too(self, look, gains):
        for seed in range(50, 52):
            lit = {v: (f * gains).clip(0, 255).astype("u1") for v, f in seen(seed).items()}
            look.check(lit)

    def test_three_views_exchanged(self, look):
        frames = seen(70)
        turned = {"View1": frames["View2"], "View2": frames["View5"], "View5": frames["View1"]}
        with pytest.raises(ObservationError, match="View1 shows View2, images/View2 shows View5"):
            look.check(turned)

    @pytest.mark.parametrize("views", [("View1", "View2", "View5"), ("View2",)])
    def test_bgr(self, look, views):
        frames = seen(71)
        reversed_ = {view: frames[view][..., ::-1] for view in views}
        with pytest.raises(ObservationError, match=rf"images/{views[0]}: red and .*COLOR_BGR2RGB"):
            look.check(frames | reversed_)

    def test_missing_views_other_sizes_and_what_resembles_nothing_pass(self, look):
        look.check({"View2": seen(74)["View2"]})
        look.check({})
        look.check({v: f.repeat(2, 0).repeat(2, 1) for v, f in seen(75).items()})
        noise = np.random.default_rng(0).integers(0, 256, (126, 224, 3), np.uint8)
        look.check(dict.fromkeys(("View1", "View2", "View5"), noise))
        look.check(dict.fromkeys(("View1", "View2", "View5"), np.zeros_like(noise)))

    def test_views_that_look_alike_are_never_refused(self):
        def alike(seed: int) -> Frames:
            frame, rng = seen(seed)["View2"], np.random.default_rng(seed)
            return {
                view: (frame + rng.integers(0, 3, frame.shape)).clip(0, 255).astype("u1")
                for view in ("View1", "View2")
            }

        look = look_of([alike(seed) for seed in range(4)])
        for seed in range(80, 85):
            look.check(swapped(alike(seed), "View1", "View2"))

    def test_a_grey_camera_is_never_refused(self):
        def grey(seed: int) -> Frames:
            return {
                view: np.repeat(frame.mean(-1, keepdims=True), 3, -1).astype("u1")
                for view, frame in seen(seed).items()
            }

        look = look_of([grey(seed) for seed in range(4)])
        for seed in range(80, 85):
            look.check({view: frame[..., ::-1] for view, frame in grey(seed).items()})

    def test_without_golden_rows_or_with_one_all_pass(self):
        frames = swapped(seen(76), "View1", "View5")
        for rows in ([], [seen(0)]):
            look_of(rows).check({view: frame[..., ::-1] for view, frame in frames.items()})

    def test_many_views_are_exchanged_in_pairs(self):
        views = [f"View{number}" for number in range(8)]

        def eight(seed: int) -> Frames:
            noise = np.random.default_rng(seed).integers(0, 6, (24, 32, 3))
            return {v: (noise + 30 * n).astype("u1") for n, v in enumerate(views)}

        look = look_of([eight(seed) for seed in range(3)])
        look.check(eight(9))
        with pytest.raises(ObservationError, match="images/View2 shows View6, images/View6 shows"):
            look.check(swapped(eight(9), "View2", "View6"))


class TestState:
    def around(self, seed: int = 0) -> np.ndarray:
        near = REST + np.random.default_rng(seed).normal(size=5) * [1.0, 1.0, 1.0, 4.0, 4.0]
        return np.tile(near, (7, 1)).astype(np.float32)

    def test_right_ones_and_none_pass(self, look):
        look.check({}, self.around(0))
        look.check({}, self.around(1) + np.array([360, -360, 0, 0, 0], np.float32))
        look.check({}, None)
        look.check({}, np.zeros((0, 5), np.float32))

    @pytest.mark.parametrize(
        ("channels", "factor", "said"),
        [
            (slice(3), np.pi / 180, "joint_1 .*Read as radians, they fit: send deg, 57.2958 times"),
            (slice(3, 5), 1e-3, r"x 0\.3.*Read as metres, they fit: send mm"),
        ],
    )
    def test_another_unit(self, look, channels, factor, said):
        state = self.around()
        state[:, channels] *= factor
        with pytest.raises(ObservationError, match=rf"state: far from .*{said}"):
            look.check({}, state)

    def test_another_order(self, look):
        said = (
            "In another order they fit: joint_1 holds joint_2, joint_2 holds joint_3, joint_3 "
            "holds joint_1. Send the channels in the order joint_1, joint_2, joint_3, x, y"
        )
        with pytest.raises(ObservationError, match=said):
            look.check({}, self.around()[:, [1, 2, 0, 3, 4]])

    def test_what_is_far_and_explained_by_nothing_passes(self, look):
        look.check({}, self.around() + np.array([90, 0, 0, 500, 0], np.float32))

    def test_of_a_rotation_training_keeps_nothing_to_compare(self):
        look = look_of([], kinds=("rotation",) * 3 + ("plain",) * 2)
        look._state = ChannelStatistics(np.zeros(8), np.ones(8), 100)
        look.check({}, np.array([[170.0, 20.0, -90.0, 0.0, 0.0]], np.float32))


def test_of_a_trained_policy(checkpoint: PolicyCheckpoint) -> None:
    look, golden = FirstLook(checkpoint), checkpoint.golden[0]
    look.check(golden.frames, checkpoint.typical("state")[None])
    with pytest.raises(ObservationError, match="red and blue are exchanged"):
        look.check({view: frame[..., ::-1] for view, frame in golden.frames.items()})
