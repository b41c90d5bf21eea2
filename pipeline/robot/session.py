"""A served policy: one model and one head for several robots, and a memory for each of them."""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.base.config import VLMParams
from pipeline.base.device import resolve_device
from pipeline.base.errors import CheckpointMismatch, NumericsError, ObservationError
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.policy.observation import moving_channels
from pipeline.policy.policy import Policy
from pipeline.robot.chunking import PlanGuide
from pipeline.robot.features import LiveFeatures
from pipeline.robot.first_look import FirstLook
from pipeline.robot.guides import stack_guides
from pipeline.robot.memory import RobotMemory, SeenFeatures
from pipeline.robot.observation import ObservationReader, RobotObservation
from pipeline.robot.proof import prove

PROTOCOL = 1
"""Of observations, answers and metadata."""

Answer = dict[str, Any]


Slot = deque[tuple[RobotObservation, str]]
"""The newest observation whose frames the model is to look at, if any, and what it is told."""
Seen = tuple[SeenFeatures, bytes, float]
"""What a pass of the model gave, the key of it, and the seconds that it took."""


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
        look: FirstLook | None = None,
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
        if checkpoint.source["action_hz"] is None:
            raise CheckpointMismatch(
                f"{folder}: the policy was trained on ticks as they were recorded (data.action_hz "
                "null), by a store that does not say their rate. Run stages.extract again, which "
                "computes no row for it, and train it again."
            )
        target = resolve_device(device)
        policy = checkpoint.policy(target)
        features = None
        if "features" in policy.encoders:
            features = LiveFeatures(vlm, checkpoint.source["feature_spec"], str(target))
            prove(checkpoint, features, say)
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

    def begin_pass(self, slot: Slot) -> Future[Seen]:
        """Have the model look at the frames that are in `slot` when its turn comes."""
        return self._passes.submit(self._pass, slot)

    def chunk(
        self, fields: Mapping[str, NDArray[Any]], drawn: torch.Generator, guide: PlanGuide | None
    ) -> tuple[NDArray[np.float32], float]:
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
        known = ", ".join(map(repr, trained))
        if prompt is None and len(trained) != 1:
            raise ObservationError(
                f"prompt: expected what the robot is to do, found none. Trained on: {known}"
            )
        prompt = trained[0] if prompt is None else prompt
        if trained and prompt not in {*trained, *self._told} and len(self._told) < 100:
            self._told.add(prompt)
            self._say(f"warning: the policy was never trained on {prompt!r:.200}, but on {known}")
        return prompt

    def _pass(self, slot: Slot) -> Seen:
        assert self._features is not None
        (observation, instruction), began = slot.pop(), perf_counter()
        features, valid = self._features([observation.frames], instruction)
        seen = SeenFeatures(features[0].numpy(), valid[0].numpy(), observation.frame_time_s)
        key = self._features.key(observation.frames, instruction)
        return seen, key, perf_counter() - began

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
            "looks_at": list(self.policy.encoders),
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
        self._asked_s = perf_counter()
        observation = self._reader.read(given)
        if observation.reset:
            self._begin_episode()
            if observation.seed is not None:
                self._drawn.manual_seed(observation.seed)
        self._memory.sense(observation.readings)
        return observation

    def answer(self, observation: RobotObservation) -> Answer:
        """The answer to what `take` took."""
        self._look_first(observation)
        vlm_s = self._look(observation) if self.metadata["uses_features"] else 0.0
        fields = self._memory.observation()
        actions, head_s = self._served.chunk(fields, self._drawn, observation.guide)
        whole_s = perf_counter() - self._asked_s
        wait_s = max(0.0, whole_s - vlm_s - head_s)
        spent = {"infer_ms": whole_s, "vlm_ms": vlm_s, "head_ms": head_s, "wait_ms": wait_s}
        timing = {part: 1000 * seconds for part, seconds in spent.items()}
        answer: Answer = {"actions": actions, "server_timing": timing}
        if self._key is not None:
            key = np.frombuffer(self._key, np.uint8)
            answer |= {"feature_age_s": float(fields["feature_age"]), "feature_key": key}
        return answer

    def _begin_episode(self) -> None:
        self._memory = RobotMemory.of(self._served.policy)
        # A pass of the episode before keeps a slot of its own, and is never asked for its answer.
        self._slot: Slot = deque(maxlen=1)
        self._under_way: Future[Seen] | None = None
        self._began_s, self._instruction = -np.inf, ""
        self._key: bytes | None = None
        self._frames_known = self._state_known = False

    def _look_first(self, observation: RobotObservation) -> None:
        """Refuse another robot than the policy's by its first frames and states of an episode."""
        frames = {} if self._frames_known else observation.frames
        state = None if self._state_known else observation.readings.get("state")
        if self._served.look is not None and (frames or state is not None):
            self._served.look.check(frames, state)
        self._frames_known |= bool(frames)
        self._state_known |= state is not None

    def _look(self, observation: RobotObservation) -> float:
        """See to the newest features; the seconds of the pass that ended for this answer."""
        told = observation.prompt not in (None, self._instruction)
        if told and not observation.frames and self._memory.features is not None:
            raise ObservationError(
                f"prompt: expected frames beside another prompt than {self._instruction!r:.200}, "
                "for features are of both, found none"
            )
        spent = self._collect(wait=told)
        waited = observation.time_s - self._began_s >= self._between_s
        if observation.frames and (waited or told):
            instruction = self._served.instruction(observation.prompt)
            self._slot.append((observation, instruction))
            self._began_s, self._instruction = observation.time_s, instruction
        if self._slot and self._under_way is None:
            self._under_way = self._served.begin_pass(self._slot)
        spent = self._collect(self._fresh or told or self._memory.features is None) or spent
        if self._memory.features is None:
            views = ", ".join(f"images/{view}" for view in self.metadata["streams"]["views"])
            raise ObservationError(
                f"images: expected some of {views} with the first observation of an episode"
            )
        return spent

    def _collect(self, wait: bool) -> float:
        """Take the features of a pass that has ended; the seconds it took, 0 without one."""
        if self._under_way is None or not (wait or self._under_way.done()):
            return 0.0
        ended, self._under_way = self._under_way, None
        self._memory.features, self._key, spent = ended.result()
        return spent
