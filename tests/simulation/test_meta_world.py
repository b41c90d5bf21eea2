"""Meta-World's tasks as environments; most tests need the extra `metaworld`."""

import sys
from types import ModuleType

import gymnasium
import numpy as np
import pytest

from pipeline.base.errors import ConfigError
from pipeline.simulation.meta_world import (
    MAX_TICKS,
    SUCCEEDED,
    TIME_IS_UP,
    VIEW,
    MetaWorldEnvironment,
    instruction_of,
)
from tests.simulation.environment_contract import EnvironmentContract


def play(environment: MetaWorldEnvironment, seed: int) -> np.ndarray:
    """The states (tick, 4) of the scripted expert's episode."""
    readings, _ = environment.reset(seed=seed)
    states = [readings["state"][0]]
    while not environment.finished:
        states.append(environment.step(environment.expert_action())[0]["state"][0])
    return np.stack(states)


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "metaworld", None)
    with pytest.raises(ConfigError, match=r"vla-feature-cache\[metaworld\]"):
        MetaWorldEnvironment("assembly")


def test_nothing_that_draws_is_a_refusal_that_says_what_to_install(monkeypatch):
    class Undrawn(ModuleType):
        def __getattr__(self, name):
            raise RuntimeError("no library")

    monkeypatch.setitem(sys.modules, "metaworld", Undrawn("metaworld"))
    with pytest.raises(ConfigError, match=r"cannot draw frames .*no library.* libosmesa6"):
        MetaWorldEnvironment("assembly")


def test_any_task_has_an_instruction():
    assert instruction_of("drawer-open") == instruction_of("drawer-open-v3") == "Open the drawer."
    assert instruction_of("window-close") == "Window close."


@pytest.mark.usefixtures("meta_world")
@pytest.mark.extra
class TestMetaWorld(EnvironmentContract):
    @pytest.fixture
    def environment(self) -> MetaWorldEnvironment:
        return MetaWorldEnvironment("hammer", image=64)

    def test_the_same_seed_is_the_same_episode_and_ends_as_the_task_says(self):
        environment = MetaWorldEnvironment("button-press-topdown")
        states = play(environment, 4)
        assert environment.outcome == SUCCEEDED and environment.success
        assert environment.time_s == (len(states) - 1) / 80 < MAX_TICKS / 80
        np.testing.assert_array_equal(play(environment, 4), states)
        with pytest.raises(gymnasium.error.ResetNeeded):
            environment.step(np.zeros(4))
        environment.reset(seed=4)
        for _ in range(MAX_TICKS):
            *_, terminated, truncated, info = environment.step(np.zeros(4))
        assert (terminated, truncated, info["reason"]) == (False, True, TIME_IS_UP)

    def test_an_action_is_in_millimetres_and_only_finite_ones_are_taken(self):
        environment = MetaWorldEnvironment("drawer-open")
        (before,) = environment.reset(seed=0)[0]["state"]
        for _ in range(10):
            (after,) = environment.step(np.array([5.0, 0.0, 0.0, -1.0]))[0]["state"]
        # The hand lags behind its setpoint, which has gone 50 mm along x.
        assert 20 < after[0] - before[0] < 60
        np.testing.assert_allclose(after[1:3], before[1:3], atol=5)
        with pytest.raises(ValueError, match="four finite numbers"):
            environment.step(np.full(4, np.nan))

    def test_an_unknown_task_lists_those_that_are_there(self):
        with pytest.raises(ConfigError, match=r"metaworld:knitting-v3: .*assembly-v3, "):
            MetaWorldEnvironment("knitting")

    def test_frames_show_the_arm_upright(self):
        environment = MetaWorldEnvironment("drawer-open", image=64)
        environment.reset(seed=0)
        ((view, (time_s, frame)),) = environment.frames().items()
        assert (view, time_s, frame.shape, frame.dtype) == (VIEW, 0.0, (64, 64, 3), np.uint8)
        rows, _ = np.nonzero(frame[..., 0].astype(int) - frame[..., 1:].max(axis=-1) > 60)
        assert rows.mean() > 24, "the red arm stands on the floor, below the grey background"
        assert np.ptp(frame[:8].astype(int)) < 40, "above it there is nothing"

    def test_frame_and_expert_begin_with_the_scene_that_was_drawn(self):
        environment = MetaWorldEnvironment("drawer-open", image=64)
        environment.reset(seed=2)
        simulator = environment._simulator
        drawer = simulator.data.body("drawer").xpos * 1000
        np.testing.assert_allclose(drawer[:2], environment.drawn_mm[:2], atol=1)
        assert environment._seen is not None
        handle = simulator._get_pos_objects()
        np.testing.assert_array_equal(environment._seen[[4, 22]], handle[0])
