"""A session answers as a rollout does, remembers one robot, and refuses what it cannot use."""

from collections import deque
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.errors import NumericsError, ObservationError
from pipeline.simulation.insertion import INSTRUCTION
from pipeline.simulation.rendering import VIEWS
from tests.robot.conftest import Blocked, watch

BLIND: dict[str, Any] = {f"images/{view}": None for view in VIEWS}


def test_an_answer_says_what_it_was_made_of(served_policy, observe) -> None:
    """The model looks again after three ticks; what is older than in training is warned of once."""
    served = served_policy()
    session = served.session()
    first = session.infer(observe(0, **{"images_time/View1": 0.07, "images_time/View2": 0.09}))
    assert first["actions"].shape == (4, 7) and first["actions"].dtype == np.float32
    assert first["feature_age_s"] == pytest.approx(0.0, abs=1e-6)  # View5's, of now
    assert first["trained_age_s"] == pytest.approx(0.3)
    assert first["feature_key"].dtype == np.uint8 and first["feature_key"].shape == (16,)
    timing = first["server_timing"]
    assert set(timing) == {"infer_ms", "vlm_ms", "head_ms", "wait_ms"}
    assert timing["infer_ms"] >= timing["vlm_ms"] + timing["head_ms"] > 0
    second, _, fourth = (session.infer(observe(tick)) for tick in (1, 2, 3))
    assert second["feature_age_s"] == pytest.approx(0.1, abs=1e-6)
    np.testing.assert_array_equal(second["feature_key"], first["feature_key"])
    assert second["server_timing"]["vlm_ms"] == 0
    assert fourth["feature_age_s"] == pytest.approx(0.0, abs=1e-6)
    assert not np.array_equal(fourth["feature_key"], first["feature_key"])
    assert len(served.glance.passes) == 2
    later = [session.infer(observe(tick, **BLIND)) for tick in range(4, 10)]
    assert [tick for tick, answer in enumerate(later, 4) if "warnings" in answer] == [7]
    (warning,) = later[3]["warnings"]
    assert "features are 0.40 s old" in warning and "at most 0.30 s" in warning


def test_features_of_another_prompt_are_never_answered_with(served_policy, observe) -> None:
    served = served_policy(told=("touch", "leave"))
    session = served.session(fresh=False)
    session.infer(observe(0, prompt="touch"))
    with pytest.raises(ObservationError, match="frames beside another prompt than 'touch'"):
        session.infer(observe(1, prompt="leave", **BLIND))
    touched = session.infer(observe(3, prompt="touch"))["feature_key"]
    left = session.infer(observe(4, prompt="leave"))["feature_key"]
    assert served.glance.instructions == ["touch", "touch", "leave"]
    alone = served.session().infer(observe(4, prompt="leave"))["feature_key"]
    assert left.tobytes() == alone.tobytes() != touched.tobytes()


def test_prompts(served_policy, observe) -> None:
    one = served_policy()
    assert "warnings" not in one.session().infer(observe(0))
    assert one.glance.instructions == [INSTRUCTION]
    session = one.session()
    answers = [session.infer(observe(tick, prompt="fold the towel")) for tick in range(5)]
    (warning,) = answers[0]["warnings"]
    assert "'fold the towel'" in warning and INSTRUCTION in warning
    assert not any("warnings" in answer for answer in answers[1:])
    assert session.infer(observe(0, prompt="fold the towel", reset=True))["warnings"] == [warning]
    with pytest.raises(ObservationError, match="'touch', 'leave'"):
        served_policy(told=("touch", "leave")).session().infer(observe(0))
    unknown = served_policy(told=())
    with pytest.raises(ObservationError, match="prompt: expected what the robot is to do"):
        unknown.session().infer(observe(0))
    assert "warnings" not in unknown.session().infer(observe(0, prompt="anything"))


def test_a_missing_view_is_left_out_as_in_training(served_policy, observe, monkeypatch) -> None:
    served = served_policy()
    given = watch(monkeypatch, served.policy)
    served.session().infer(observe(0, **{f"images/{VIEWS[0]}": None}))
    assert tuple(served.glance.passes[0][0]) == VIEWS[1:]
    assert given[0]["slot_valid"].tolist() == [[False, True]]
    assert np.isnan(given[0]["view_age"][0]).tolist() == [True, False, False]


def test_without_frames_the_first_observation_is_refused_and_leaves_a_session_that_works(
    served_policy, observe
):
    session = served_policy().session()
    with pytest.raises(ObservationError, match="images/View1"):
        session.infer(observe(0, **BLIND))
    assert session.infer(observe(1))["actions"].shape == (4, 7)
    assert session.infer(observe(9, **BLIND))["feature_age_s"] == pytest.approx(0.8, abs=1e-6)


def test_a_policy_without_features_needs_no_frames(served_policy, observe) -> None:
    served = served_policy(features_enabled=False)
    answer = served.session().infer(observe(0, **BLIND))
    assert set(answer) == {"actions", "server_timing"}
    assert served.metadata["uses_features"] is False
    assert served.session().infer(observe(0))["actions"].shape == (4, 7)


def test_reset_forgets_and_a_seed_draws_the_same_again(served_policy, observe) -> None:
    session = served_policy("flow_matching").session()

    def episode(reset: Any) -> list[np.ndarray]:
        told = [{"reset": reset}, {}, {}, {}]
        return [session.infer(observe(k) | told[k])["actions"] for k in range(4)]

    first, again, other, going_on = episode(7), episode(7), episode(8), episode(True)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(other, going_on)
    with pytest.raises(ObservationError, match="time: expected"):
        session.infer(observe(0))


def test_what_is_not_fresh_is_answered_while_the_model_looks(served_policy, observe) -> None:
    served = served_policy()
    session = served.session(fresh=False)
    session.infer(observe(0))  # the first is waited for
    blocked = Blocked(served)
    for tick in range(1, 10):
        age_s = session.infer(observe(tick))["feature_age_s"]
        assert age_s == pytest.approx(tick / 10, abs=1e-6)
        assert tick != 3 or blocked.looking.wait(60), "the pass has frames of tick 3, none newer"
    blocked.go.set()
    served.begin_pass(deque()).exception()  # passes are in order: that one has ended
    later = Blocked(served)  # the next pass does not end at once
    answer = session.infer(observe(10))
    assert answer["feature_age_s"] == pytest.approx(0.7, abs=1e-6)
    assert answer["server_timing"]["vlm_ms"] > 0
    later.go.set()
    served.begin_pass(deque()).exception()
    # Frames of tick 9 waited in the place of those of tick 6.
    assert session.infer(observe(11))["feature_age_s"] == pytest.approx(0.2, abs=1e-6)


def test_a_pass_of_the_episode_before_is_not_taken(served_policy, observe) -> None:
    served = served_policy()
    session = served.session(fresh=False)
    session.infer(observe(0))
    blocked = Blocked(served)
    session.infer(observe(3))  # begins a pass that does not end
    assert blocked.looking.wait(60)
    served.glance.before = lambda: None
    begin = served.begin_pass

    def begin_and_end_the_other(waiting: Any) -> Any:
        begun = begin(waiting)
        blocked.go.set()
        return begun

    served.begin_pass = begin_and_end_the_other
    answer = session.infer(observe(50, reset=True))
    assert answer["feature_age_s"] == pytest.approx(0.0, abs=1e-6)
    alone = served.session().infer(observe(50))
    np.testing.assert_array_equal(answer["actions"], alone["actions"])


def test_an_answer_that_is_no_number_is_refused(served_policy, observe, monkeypatch) -> None:
    served = served_policy()
    monkeypatch.setattr(served.policy, "act", lambda *_: torch.full((1, 4, 7), torch.nan))
    with pytest.raises(NumericsError, match="not a number"):
        served.session().infer(observe(0))


def test_the_first_frames_and_states_of_each_episode_are_looked_at_before_the_model_looks(
    served_policy, observe
):
    class Suspicious:
        """A first look that remembers what it saw, and refuses at last."""

        def __init__(self) -> None:
            self.seen: list[tuple[tuple[str, ...], bool]] = []

        def check(self, frames: Any, state: Any) -> None:
            self.seen.append((tuple(frames), state is not None))
            if len(self.seen) == 4:
                raise ObservationError("views swapped")

    look = Suspicious()
    served = served_policy(look=look)
    session = served.session()
    without = {"state": None, "state_time": None}
    for tick, told in enumerate([without, {}, {}, {"reset": True}, {}]):
        session.infer(observe(tick, **told))
    assert look.seen == [(VIEWS, False), ((), True), (VIEWS, True)]
    served.glance.passes.clear()
    with pytest.raises(ObservationError, match="swapped"):
        session.infer(observe(5, reset=True))
    assert served.glance.passes == []
