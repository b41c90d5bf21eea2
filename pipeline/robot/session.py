"""A served policy: one model and one head for several robots, and a memory for each of them."""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.base.config import VLMParams
from pipeline.base.device import resolve_device
from pipeline.base.errors import NumericsError, ObservationError
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.policy.observation import moving_channels
from pipeline.policy.policy import Policy
from pipeline.robot.features import LiveFeatures
from pipeline.robot.first_look import FirstLook
from pipeline.robot.guides import stack_guides
from pipeline.robot.memory import RobotMemory, SeenFeatures, WindowSize
from pipeline.robot.observation import ObservationReader, RobotObservation
from pipeline.robot.proof import prove

PROTOCOL = 1
"""Of observations, answers and metadata."""

Frames = Mapping[str, NDArray[np.uint8]]
Answer = dict[str, Any]


class Look(Protocol):
    """What looks at a robot before it moves (`pipeline.robot.proof.FirstLook`)."""

    def check(self, frames: Frames, state: NDArray[np.float32] | None) -> None:
        """Raise `ObservationError` where this is not the robot that the policy was trained on."""
        ...


@dataclass(frozen=True)
class _Glance:
    """Frames that a model is to look at, and what of the observation it takes with them."""

    frames: Frames
    frame_time_s: NDArray[np.float64]
    instruction: str


@dataclass(frozen=True)
class _Pass:
    """What a pass of the model gave, and how long it took."""

    seen: SeenFeatures
    key: bytes
    vlm_s: float


class ServedPolicy:
    """A policy and its live model, shared by sessions.

    Passes of the model are made one at a time, in the order in which they were asked for, and so
    are those of the head.
    """

    def __init__(
        self,
        checkpoint: PolicyCheckpoint,
        policy: Policy,
        features: LiveFeatures | None,
        name: str = "",
        look: Look | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """`features` is the model where the policy looks at features, and has been proved."""
        self.checkpoint, self.policy, self.look = checkpoint, policy, look
        self._features, self._say, self._name = features, say, name
        self._passes = ThreadPoolExecutor(1, "vlm")
        self._head = threading.Lock()
        self._told: set[str] = set()
        self.metadata = self._metadata()

    @classmethod
    def load(
        cls, folder: Path, vlm: VLMParams, device: str, say: Callable[[str], None]
    ) -> "ServedPolicy":
        """The checkpoint that `folder` means, once the model of `vlm` is proved to be its own.

        Raises `CheckpointMismatch` where the model gives other features, `CheckpointIncomplete` as
        `find_policy`, and `VLMError` as `LiveVLM.load`.
        """
        checkpoint = load_policy(find_policy(folder))
        target = resolve_device(device)
        policy = checkpoint.policy(target)
        features = None
        if "features" in policy.encoders:
            features = LiveFeatures(vlm, checkpoint.source["feature_spec"], str(target))
            say(str(prove(checkpoint, features, say)))
        return cls(checkpoint, policy, features, str(folder), FirstLook(checkpoint), say)

    def session(self, fresh: bool = True, seed: int = 0) -> "Session":
        """The memory of one robot; `seed` is of what the policy draws for it.

        `fresh`: a chunk waits for the features of the frames that came with its observation. Else
        it takes the newest there are, and only the first of an episode are waited for.
        """
        return Session(self, fresh, seed)

    def close(self) -> None:
        """Begin no more passes, and wait for the one under way."""
        self._passes.shutdown(cancel_futures=True)

    def begin_pass(self, slot: deque[_Glance]) -> Future[_Pass]:
        """Have the model look at the frames that are in `slot` when its turn comes."""
        return self._passes.submit(self._pass, slot)

    def chunk(self, fields: Mapping[str, NDArray[Any]], drawn: torch.Generator,
              guide: Any) -> tuple[NDArray[np.float32], float]:  # fmt: skip
        """The head's chunk (horizon, action) for the fields of one robot, and the seconds it took.

        Raises `NumericsError` where it is not finite.
        """
        with self._head:
            began = perf_counter()
            observation = self.policy.observe({name: own[None] for name, own in fields.items()})
            guides = stack_guides([guide], observation.features.device)
            chunk = self.policy.act(observation, [drawn], guides).cpu().numpy()[0]
        if not np.isfinite(chunk).all():
            raise NumericsError("actions: the policy's answer is not a number; stop the robot")
        return chunk, perf_counter() - began

    def instruction(self, prompt: str | None) -> str:
        """What the model is told: the prompt, else the only words the policy was trained on.

        Raises `ObservationError` where there is no telling; words that training never saw are
        said once.
        """
        trained = self.checkpoint.instructions
        if prompt is None:
            if len(trained) != 1:
                known = f", one of: {', '.join(map(repr, trained))}" if trained else ""
                raise ObservationError(f"prompt: expected what the robot is to do{known}")
            return trained[0]
        if trained and prompt not in trained and prompt not in self._told and len(self._told) < 100:
            self._told.add(prompt)
            self._say(
                f"warning: the policy was never trained on the prompt {prompt!r:.200}, but on "
                f"{', '.join(map(repr, trained))}"
            )
        return prompt

    def _pass(self, slot: deque[_Glance]) -> _Pass:
        assert self._features is not None
        glance, began = slot.pop(), perf_counter()
        features, valid = self._features([glance.frames], glance.instruction)
        seen = SeenFeatures(features[0].numpy(), valid[0].numpy(), glance.frame_time_s)
        key = self._features.key(glance.frames, glance.instruction)
        return _Pass(seen, key, perf_counter() - began)

    def _metadata(self) -> dict[str, Any]:
        source, params = self.checkpoint.source, self.policy.params
        return {
            "protocol": PROTOCOL,
            "feature_spec": source["feature_spec"],
            "feature_spec_digest": source["feature_spec"].get("digest", ""),
            "streams": source["streams"],
            "action_hz": source["action_hz"],
            "vlm_reuse_count": source["vlm_reuse_count"],
            "horizon": params.horizon,
            "action_dim": self.policy.shape.action_dim,
            "moving": list(moving_channels(source["streams"]["action"])),
            "model_type": params.model_type,
            "stochastic": self.policy.stochastic,
            "uses_features": self._features is not None,
            "instructions": list(self.checkpoint.instructions),
            "sensor_window": params.sensor_window,
            "state_window": params.state_window,
            "checkpoint": self._name,
            "step": self.checkpoint.step,
        }


class Session:
    """What a served policy remembers of one robot: observation in, answer out.

    Not to be called by two threads at once; sessions of one policy may be.
    """

    def __init__(self, served: ServedPolicy, fresh: bool, seed: int) -> None:
        self.metadata = served.metadata
        self._served, self._fresh = served, fresh
        self._drawn = torch.Generator().manual_seed(seed)
        self._reader = ObservationReader(served.metadata)
        source = served.checkpoint.source
        # Half a tick less, for clocks are not exact.
        self._between_s = (source["vlm_reuse_count"] - 0.5) / source["action_hz"]
        self._begin_episode()

    def infer(self, observation: Mapping[str, Any]) -> Answer:
        """The answer to an observation: `actions` (horizon, action) in the units of the metadata.

        Beside it `server_timing` in ms, and where the policy looks at features `feature_age_s` and
        `feature_key` (16,). Raises `ObservationError`, `NumericsError` and `VLMError`.
        """
        return self.answer(self.take(observation))

    def take(self, given: Any) -> RobotObservation:
        """Check an observation and remember its readings; raises `ObservationError`."""
        observation = self._reader.read(given)
        if observation.reset:
            self._begin_episode()
            if observation.seed is not None:
                self._drawn.manual_seed(observation.seed)
        self._memory.sense(observation.readings)
        return observation

    def answer(self, observation: RobotObservation) -> Answer:
        """The answer to what `take` took."""
        began = perf_counter()
        self._look_first(observation)
        vlm_s = self._look(observation) if self.metadata["uses_features"] else 0.0
        fields = self._memory.observation()
        actions, head_s = self._served.chunk(fields, self._drawn, observation.guide)
        whole_s = perf_counter() - began
        parts = {"infer": whole_s, "vlm": vlm_s, "head": head_s, "wait": whole_s - vlm_s - head_s}
        timing = {f"{name}_ms": 1000 * max(0.0, spent) for name, spent in parts.items()}
        answer: Answer = {"actions": actions, "server_timing": timing}
        if self._key is not None:
            key = np.frombuffer(self._key, np.uint8)
            answer |= {"feature_age_s": float(fields["feature_age"]), "feature_key": key}
        return answer

    def _begin_episode(self) -> None:
        params, shape = self._served.policy.params, self._served.policy.shape
        self._memory = RobotMemory(
            WindowSize(params.sensor_window, shape.sensor_channels, params.sensor_reach_s),
            WindowSize(params.state_window, shape.state_dim, params.state_window_s),
        )
        # A pass of the episode before keeps a slot of its own, and is never asked for its answer.
        self._slot: deque[_Glance] = deque(maxlen=1)
        self._under_way: Future[_Pass] | None = None
        self._began_s, self._instruction = -np.inf, ""
        self._key: bytes | None = None
        self._new_to_us = {"frames", "state"}

    def _look_first(self, observation: RobotObservation) -> None:
        """Refuse another robot than the policy's by its first frames and states of an episode."""
        state = observation.readings.get("state")
        there = {"frames": bool(observation.frames), "state": state is not None and len(state) > 0}
        new = {name for name in self._new_to_us if there[name]}
        if self._served.look is not None and new:
            frames = observation.frames if "frames" in new else {}
            self._served.look.check(frames, state if "state" in new else None)
        self._new_to_us -= new

    def _look(self, observation: RobotObservation) -> float:
        """See to the newest features; the seconds of the pass that ended for this answer."""
        spent = self._collect()
        if self._due(observation):
            instruction = self._served.instruction(observation.prompt)
            self._slot.append(_Glance(observation.frames, observation.frame_time_s, instruction))
            self._began_s, self._instruction = observation.time_s, instruction
        if self._slot and self._under_way is None:
            self._under_way = self._served.begin_pass(self._slot)
        if self._under_way is not None and (self._fresh or self._memory.features is None):
            self._under_way.exception()  # waits
            spent = self._collect()
        if self._memory.features is None:
            views = ", ".join(f"images/{view}" for view in self.metadata["streams"]["views"])
            raise ObservationError(
                f"images: expected frames with the first observation of an episode ({views}), "
                "found none"
            )
        return spent

    def _due(self, observation: RobotObservation) -> bool:
        """Whether the model is to look at these frames: it may rest, unless it is told another
        thing."""
        waited = observation.time_s - self._began_s >= self._between_s
        told = observation.prompt not in (None, self._instruction)
        return bool(observation.frames) and (waited or told)

    def _collect(self) -> float:
        """Take the features of a pass that has ended; the seconds it took, 0 without one."""
        if self._under_way is None or not self._under_way.done():
            return 0.0
        ended, self._under_way = self._under_way.result(), None
        self._memory.features, self._key = ended.seen, ended.key
        return ended.vlm_s
