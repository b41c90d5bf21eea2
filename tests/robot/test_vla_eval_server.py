"""The harness vla-eval, as it is, asks a policy of ours and gets what the policy answers here."""

import gc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from pipeline.base.config import load_params
from pipeline.base.errors import ConfigError
from pipeline.robot.loop import Executor
from pipeline.simulation.insertion import INSTRUCTION
from pipeline.simulation.rendering import VIEWS

pytestmark = pytest.mark.extra
api = pytest.importorskip("vla_eval.api", reason="needs the extra `vla-eval`")
from vla_eval.connection import Connection  # noqa: E402

from experiments.vla_eval_server import PolicyModelServer  # noqa: E402

PARAMS = Path(__file__).parents[2] / "params.yaml"
CAMERAS = dict(zip(VIEWS, ("agentview", "wrist", "side", "top", "back"), strict=False))
NAMES = {f"images/{view}": f"images/{camera}" for view, camera in CAMERAS.items()}
NAMES |= {"state": "states"}
HZ, REUSE, TICKS = 10.0, 3, 7


def seen(episode: int, tick: int) -> dict[str, Any]:
    """What a benchmark sends at a tick of an episode."""
    rng = np.random.default_rng([episode, tick])
    return {
        "images": {
            camera: rng.integers(0, 256, (32, 40, 3), dtype=np.uint8) for camera in CAMERAS.values()
        },
        "states": rng.normal(size=12),
        "controller_states": np.zeros(8),
        "task_description": INSTRUCTION,
    }


@pytest.fixture
def serving_to_vla_eval(served_policy) -> Any:
    """`serving_to_vla_eval(model_type, "key=value", ...)`: a policy without a sensor and its model
    server, with these params."""

    def made(model_type: str, *overrides: str) -> Any:
        served = served_policy(model_type, sensor_enabled=False)
        params = load_params(PARAMS, overrides)
        server = PolicyModelServer(served, params, NAMES)
        return SimpleNamespace(served=served, server=server, params=params)

    return made


def answered_here(made: Any, episode: int) -> list[np.ndarray]:
    """The actions of an episode, by a session in this process that is told the policy's names."""
    about, rollout = made.served.metadata, made.params.rollout
    session = made.served.session(seed=made.params.serve.seed + episode)
    executor = Executor(rollout.chunking, rollout.execute, about["horizon"], about["moving"])
    actions = list[np.ndarray]()
    for tick in range(TICKS):
        given = seen(episode, tick)
        own = {f"images/{view}": given["images"][camera] for view, camera in CAMERAS.items()}
        own |= {"state": given["states"], "time": tick / HZ, "prompt": INSTRUCTION}
        asked = tick % rollout.execute == 0
        if asked and (plan := executor.begin()) is not None:
            own |= {"guide/chunk": plan.chunk, "guide/weight": plan.weight}
        observation = session.take(own)
        if asked:
            executor.plan(session.answer(observation)["actions"])
        actions.append(executor.next_action())
    return actions


def ask(url: str, episodes: int, **changed: Any) -> list[list[np.ndarray]]:
    """The actions of each episode, by vla-eval's client; `changed` replaces what is sent."""

    async def converse() -> list[list[np.ndarray]]:
        async with Connection(url, timeout=20, max_retries=1) as client:
            played = list[list[np.ndarray]]()
            for episode in range(episodes):
                await client.start_episode({"task": {"name": "t", "episode_idx": episode}})
                sent = [seen(episode, tick) | changed for tick in range(TICKS)]
                played.append([(await client.act(own))["actions"] for own in sent])
                await client.end_episode({"metrics": {"success": True}})
            return played

    return anyio.run(converse)


@pytest.mark.parametrize(
    ("model_type", "execute", "chunking"),
    [("regression", 1, "temporal"), ("flow_matching", 3, "none"), ("diffusion", 1, "rtc")],
)
def test_its_client_gets_what_a_session_here_answers_bit_for_bit(
    serving_to_vla_eval, model_type: str, execute: int, chunking: str
) -> None:
    made = serving_to_vla_eval(
        model_type, f"rollout.execute={execute}", f"rollout.chunking={chunking}", "serve.seed=5"
    )
    with api.serve_background(made.server) as running:
        played = ask(running.url, 2)
    passes = [frames[0] for frames in made.served.glance.passes]
    # A pass of the model every third tick, at which the head is asked in all cases.
    assert len(passes) == 2 * len(range(0, TICKS, REUSE))
    np.testing.assert_array_equal(passes[-1]["View1"], seen(1, 6)["images"]["agentview"])
    np.testing.assert_array_equal(played, [answered_here(made, episode) for episode in range(2)])
    assert not np.array_equal(*played)
    gc.collect()
    assert not made.server._episodes  # What has ended is forgotten.


def test_what_does_not_fit_is_refused_by_name_and_the_next_episode_runs(
    serving_to_vla_eval, caplog
) -> None:
    made = serving_to_vla_eval("regression")
    with api.serve_background(made.server) as running:
        for changed, why in (
            ({"images": {}}, "expected images/View1=images/agentview, .*found images, states"),
            ({"states": np.zeros(3)}, r"state: expected shape \(reading, 12\), found \(3,\)"),
            ({"states": np.full(12, np.nan)}, "state: expected finite numbers"),
        ):
            with pytest.raises(RuntimeError, match=f"observation_failed: ObservationError: {why}"):
                ask(running.url, 1, **changed)
        assert len(ask(running.url, 1)[0]) == TICKS
        assert "never trained on" not in caplog.text
        ask(running.url, 1, task_description="go")
        assert "prompt: the policy was never trained on 'go'" in caplog.text
    for wrong in ("state:states", "images/Vew1", "sensor"):
        with pytest.raises(ConfigError, match=f"{wrong}: expected some of images/View1, .*prompt"):
            PolicyModelServer(made.served, made.params, {wrong: "x"})
    for override, why in (("execute=5", "expected 1 to 4"), ("chunking=rtc", "found rtc")):
        with pytest.raises(ConfigError, match=why):
            serving_to_vla_eval("regression", f"rollout.{override}")
