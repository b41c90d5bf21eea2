"""Serve a policy to the benchmarks of vla-eval, as a model server of its own protocol.

Needs the extra `vla-eval`. The policy is that of serve.checkpoint, else of train_head.output, and
it plays its chunks by rollout.execute and rollout.chunking. OURS is images/<view> or a stream that
the policy looks at; THEIRS is images/<camera> or a field of the benchmark's observation. Without
OURS=THEIRS both have the same name. Actions are in the units of the recordings. vla-eval knows no
token, so only this machine can reach the server, at serve.port.

  python -m experiments.vla_eval_server [OURS=THEIRS ...] [--set section.key=value ...]
  python -m experiments.vla_eval_server images/View1=images/agentview state=states
"""

import logging
import sys
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import Any
from weakref import WeakKeyDictionary

from anyio import to_thread
from vla_eval.model_servers.base import ModelServer, SessionContext
from vla_eval.model_servers.serve import serve

from pipeline.base.config import Params
from pipeline.base.errors import ConfigError, ObservationError
from pipeline.robot.loop import Executor, Steps, check_chunking
from pipeline.robot.session import ServedPolicy, Session
from stages.command import run


class PolicyModelServer(ModelServer):
    """Answers each observation with the action (action,) of its tick.

    The benchmark waits for each answer, so an observation is a tick of 1 / `action_hz` seconds.
    """

    def __init__(self, served: ServedPolicy, params: Params, names: dict[str, str]) -> None:
        """`names`: what the benchmark calls our fields. Raises `ConfigError` for unknown ones."""
        about = served.metadata
        images = [f"images/{view}" for view in about["streams"]["views"]]
        own = [n for name in about["looks_at"] for n in (images if name == "features" else [name])]
        self._names = {name: name for name in own} | {"prompt": "task_description"} | names
        if unknown := sorted(self._names.keys() - {*own, "prompt"}):
            raise ConfigError(f"{', '.join(unknown)}: expected some of {', '.join(own)}, prompt")
        check_chunking(params.rollout.chunking, about["stochastic"])
        play = (params.rollout.chunking, params.rollout.execute, about["horizon"], about["moving"])
        self._executor = partial(Executor, *play)
        self._executor()  # It refuses more steps than a chunk has.
        self._served, self._seed, self._hz = served, params.serve.seed, about["action_hz"]
        self._episodes = WeakKeyDictionary[SessionContext, tuple[Session, Executor]]()

    def get_observation_params(self) -> dict[str, Any]:
        """Ask for what a benchmark leaves out otherwise."""
        images = sum(name.startswith("images/") for name in self._names)
        return {"send_state": "state" in self._names, "send_wrist_image": images > 1}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        """Begin an episode; its seed is `serve.seed` and its index within the task."""
        seed = self._seed + config.get("task", {}).get("episode_idx", 0)
        self._episodes[ctx] = self._served.session(seed=seed), self._executor()

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        """Send the action of this tick. An error fails the episode, and the client is told why."""
        await ctx.send_action({"actions": await to_thread.run_sync(self._act, obs, ctx)})

    def _act(self, given: dict[str, Any], ctx: SessionContext) -> Steps:
        session, executor = self._episodes[ctx]
        fields = given | {f"images/{name}": own for name, own in given.get("images", {}).items()}
        if missing := [f"{own}={name}" for own, name in self._names.items() if name not in fields]:
            raise ObservationError(f"expected {', '.join(missing)}, found {', '.join(fields)}")
        sent = {name: fields[theirs] for name, theirs in self._names.items()}
        observation = session.take(sent | {"time": ctx.step / self._hz})
        if executor.due:
            answer = session.answer(replace(observation, guide=executor.begin()))
            executor.plan(answer["actions"])
            for warning in answer.get("warnings", ()):
                logging.warning(warning)
        return executor.next_action()


def main(params: Params, names: dict[str, str]) -> None:
    """Serve until Ctrl-C."""
    folder = params.serve.checkpoint or params.train_head.output
    with closing(ServedPolicy.load(folder, params.vlm, params.serve.device, print)) as served:
        serve(PolicyModelServer(served, params, names), "127.0.0.1", params.serve.port)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    pairs = takewhile(lambda text: not text.startswith("-"), sys.argv[1:])
    work = partial(main, names=(names := dict(pair.partition("=")[::2] for pair in pairs)))
    raise SystemExit(run(__doc__ or "", work, sys.argv[1 + len(names) :], sections=("serve",)))
