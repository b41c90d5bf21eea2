"""Policies are rolled out in environments that are not the phantom, as the recipe shows."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.config import RolloutParams
from pipeline.base.errors import CheckpointMismatch, ConfigError
from pipeline.compat.unified import no_normalization
from pipeline.evaluate.rollout_driver import roll_out
from pipeline.evaluate.rollouts import Rollouts
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.simulation.environment import environment_maker
from pipeline.simulation.interface import RobotEnvironment
from tests.robot.conftest import DIM, SLOTS, Glance
from tests.robot.conftest import build_policy as made
from tests.simulation.environment_contract import EnvironmentContract

RECIPE = Path(__file__).parents[2] / "docs" / "recipes" / "environment.md"
VARIED = """

class Held(Slide):
    def expert_action(self):
        return np.sign([-self.x_mm])


class Silent(Slide):
    def step(self, action):
        return *super().step(action)[:4], {}
"""
TASK = "Move the cart to the middle"


@pytest.fixture(autouse=True)
def slide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module of the recipe, which another test may have imported from another folder."""
    (code,) = re.findall(r"^```python\n(.*?)^```$", RECIPE.read_text(), re.DOTALL | re.MULTILINE)
    (tmp_path / "slide.py").write_text(code + VARIED)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slide", raising=False)


def environment(name: str) -> RobotEnvironment:
    return environment_maker(name, "full", ("dx",))()


class TestTheRecipe(EnvironmentContract):
    @pytest.fixture
    def environment(self) -> RobotEnvironment:
        return environment("slide:Slide")


def driven(
    names: Any, act: Any = None, units: str = "mm", say: Any = print, **source: Any
) -> tuple[Rollouts, Glance]:
    """Rollouts of a policy for a cart, whose chunks `act` gives."""
    checkpoint, _, glance = made(views=1)
    shape = PolicyShape(SLOTS, DIM, 0, 1, 1, ("translation",), views=1)
    normal = replace(no_normalization(shape), sensor=None)
    torch.manual_seed(0)
    policy = Policy(checkpoint.params, shape, normal).eval()
    action = {"names": ["dx"], "units": [units], "kind": "delta"}
    streams = {"action": action, "views": ["View1"]}
    trained = {
        "feature_spec": {"views": ["View1"]}, "streams": streams, "action_hz": 10.0,
        "vlm_reuse_count": 3,
    }  # fmt: skip
    cart = replace(
        checkpoint, shape=shape, normalization=normal, source=trained | source, instructions=(TASK,)
    )
    wanted = RolloutParams.model_validate(
        {"environment": names, "episodes": 3, "chunking": "none", "ablations": ["features off"]}
    )
    if act is not None:
        policy.act = act
    return roll_out(cart, "models/cart", policy, lambda: glance, wanted, say), glance


def towards_the_middle(observation: Any, *_: Any) -> torch.Tensor:
    """Chunks (robot, 4, 1) that move each cart by at most 2 mm a step."""
    return torch.clip(-observation.state[:, -1:, :1], -2, 2).expand(-1, 4, 1)


def test_success_reasons_and_frames_are_the_environments_own() -> None:
    rollouts, glance = driven("slide:Slide", towards_the_middle)
    episodes = rollouts.of("policy")
    assert rollouts.controllers == ("policy", "features off")  # it has no demonstrator
    assert [e.success for e in episodes] == [True] * 3
    assert {(e.level, e.reason, e.trace) for e in episodes} == {("slide", "succeeded", None)}
    assert {*glance.instructions} == {TASK} == {rollouts.settings["instruction"]}
    head = rollouts.table(policy=True).csv().splitlines()[0]
    assert head == "seed,level,success,reason,time_s,ticks"
    for episode in episodes:
        # Played again, the last frame has the cart in the middle, and the first has not.
        first, last = (shots["View1"] for shots in episode.frames([0, episode.actions]))
        assert last[0] == episode.time_s == pytest.approx(episode.ticks / 10)
        columns = [int(frame[0, :, 0].argmax()) for _, frame in (first, last)]
        assert abs(columns[1] - 28) <= 1 < abs(columns[0] - 28)
    lazy, _ = driven("slide:Slide", lambda observation, *_: 0 * towards_the_middle(observation))
    assert {(e.success, e.reason, e.ticks) for e in lazy.of("policy")} == {
        (False, "time is up", 50)
    }


def test_a_list_is_rolled_out_one_after_another() -> None:
    rollouts, _ = driven(["slide:Slide", "slide:Held"], towards_the_middle)
    assert len(rollouts.of("policy")) == 6 and len(rollouts.of("expert")) == 3
    assert rollouts.rates()["expert"].rate == 1.0
    assert rollouts.document()["success"]["policy"]["episodes"] == 6


def test_what_cannot_be_rolled_out_is_refused_by_name() -> None:
    with pytest.raises(CheckpointMismatch, match=r"action_hz 30, of slide:Slide .*action_hz 10"):
        driven("slide:Slide", action_hz=30.0)
    with pytest.raises(CheckpointMismatch, match="another robot than phantom"):
        driven("phantom")
    with pytest.raises(ConfigError, match=r"environment: slide:Sled: expected Sled.*Name a class"):
        environment("slide:Sled")
    with pytest.raises(ConfigError, match=r"expected `success` in the info .* found nothing"):
        driven("slide:Silent", towards_the_middle)
    with pytest.raises(ConfigError, match="expected a RobotEnvironment"):
        environment("fractions:Fraction")
    with pytest.raises(ValueError, match=r"metaworld:TASK or module:name, found 'phantm'"):
        RolloutParams.model_validate({"environment": "phantm"})


def test_channels_of_other_units_are_warned_of() -> None:
    said: list[str] = []
    driven("slide:Slide", towards_the_middle, say=said.append)
    assert not any("warning" in line for line in said)
    driven("slide:Slide", towards_the_middle, units="m", say=said.append)
    (line,) = (line for line in said if "warning" in line)
    assert "slide:Slide has action channels dx mm; the policy was trained on dx m." in line
    driven("slide:Slide", towards_the_middle, units="", say=said.append)
    assert sum("warning" in line for line in said) == 1, "a recording may name no unit"


def test_absolute_actions_must_say_what_stands_still() -> None:
    cart = environment("slide:Slide")
    np.testing.assert_array_equal(cart.still(), [0.0])
    cart.robot = replace(cart.robot, action_kind="absolute")
    with pytest.raises(ConfigError, match=r"slide:Slide: its actions are absolute.*`still`"):
        cart.still()
