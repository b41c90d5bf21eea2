"""A served policy: one model and one head for several robots, and a memory for each of them."""

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.base.config import VLMParams
from pipeline.base.errors import CheckpointMismatch, NumericsError, ObservationError
from pipeline.base.hardware import resolve_device
from pipeline.policy.checkpoint import PolicyCheckpoint, find_policy, load_policy
from pipeline.policy.expert import Guide
from pipeline.policy.observation import moving_channels
from pipeline.policy.policy import Policy
from pipeline.robot.first_look import FirstLook
from pipeline.robot.live_features import LiveFeatures, prove
from pipeline.robot.loop import PlanGuide
from pipeline.robot.observation import Doubts, KeyMap, ObservationReader, RobotObservation
from pipeline.robot.readings import RobotMemory, SeenFeatures

PROTOCOL = 1
"""Version of observations, answers and metadata."""

Answer = dict[str, Any]
WaitingFrames = deque[tuple[RobotObservation, str]]
"""At most one entry: the newest observation with frames for the model, and its instruction."""
Pass = tuple[SeenFeatures, float]
"""The features of one pass of the model, and the seconds that the pass took."""


def policy_metadata(checkpoint: PolicyCheckpoint, policy: Policy, name: str) -> dict[str, Any]:
    """What a robot or a simulation has to know of a policy; `name` is where it was found."""
    source, params = checkpoint.source, policy.params
    action = source["streams"]["action"]
    period_s = source["vlm_reuse_count"] / (source["action_hz"] or np.inf)
    return {
        "protocol": PROTOCOL,
        "feature_spec": source["feature_spec"],
        "feature_spec_digest": source["feature_spec"].get("digest", ""),
        "streams": source["streams"],
        "action_hz": source["action_hz"],
        "vlm_reuse_count": source["vlm_reuse_count"],
        "horizon": params.horizon,
        "action_dim": policy.shape.action_dim,
        "anchored": policy.shape.anchored(action["names"]),
        "relative": policy.shape.relative_to_state(action["names"]),
        "moving": list(moving_channels(action)),
        "model_type": params.model_type,
        "stochastic": policy.stochastic,
        "uses_features": "features" in policy.encoders,
        "looks_at": list(policy.encoders),
        "instructions": list(checkpoint.instructions),
        "sensor_window": params.sensor_window,
        "state_window": params.state_readings,
        "trained_age_s": params.trained_age_s(period_s),
        "checkpoint": name,
        "step": checkpoint.step,
        "weights": checkpoint.digest,
    }


class ServedPolicy:
    """A policy and its live model, shared by sessions.

    The model runs one pass at a time, in the order of the requests, and so does the head.
    """

    def __init__(
        self,
        checkpoint: PolicyCheckpoint,
        policy: Policy,
        features: LiveFeatures | None,
        name: str = "",
        look: FirstLook | None = None,
    ) -> None:
        """`features` is the proved model, None where the policy looks at no features."""
        self.checkpoint, self.policy, self.look = checkpoint, policy, look
        self._features = features
        self._passes = ThreadPoolExecutor(1, "vlm")
        self._head = threading.Lock()
        self.metadata = policy_metadata(checkpoint, policy, name)

    @classmethod
    def load(
        cls, folder: Path, vlm: VLMParams, device: str, say: Callable[[str], None]
    ) -> "ServedPolicy":
        """The policy of `folder`, once the model of `vlm` is proved to give its features.

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
            trained = checkpoint.source["feature_spec"]
            features = LiveFeatures(vlm, trained, str(target), checkpoint.basis)
            prove(checkpoint, features, say)
        return cls(checkpoint, policy, features, str(folder), FirstLook(checkpoint))

    def session(
        self, fresh: bool = True, seed: int = 0, key_map: KeyMap | None = None
    ) -> "Session":
        """A session of one robot; `seed` seeds the samples that the policy draws for it.

        With `fresh` a chunk waits for the features of the frames of its own observation. Without,
        it takes the newest features, and waits only for the first of an episode. `key_map`
        translates the names of a known robot's client.
        """
        return Session(self, fresh, seed, key_map)

    def close(self) -> None:
        """Begin no more passes, and wait for the one that runs."""
        self._passes.shutdown(cancel_futures=True)

    def begin_pass(self, waiting: WaitingFrames) -> Future[Pass]:
        """Queue a pass of the model on the frames that `waiting` holds when its turn comes."""
        return self._passes.submit(self._pass, waiting)

    def chunk(
        self, fields: Mapping[str, NDArray[Any]], drawn: torch.Generator, guide: PlanGuide | None
    ) -> tuple[NDArray[np.float32], float]:
        """The head's chunk (horizon, action) for one robot, and the seconds that it took.

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

    def _pass(self, waiting: WaitingFrames) -> Pass:
        assert self._features is not None
        (observation, instruction), began = waiting.pop(), perf_counter()
        features, valid = self._features([observation.frames], instruction)
        key = self._features.key(observation.frames, instruction)
        seen = SeenFeatures(features[0].numpy(), valid[0].numpy(), observation.frame_time_s, key)
        return seen, perf_counter() - began


class Session:
    """A served policy with the memory of one robot: observation in, answer out.

    One thread at a time may call a session; sessions of one policy may run at once.
    """

    def __init__(
        self, served: ServedPolicy, fresh: bool, seed: int, key_map: KeyMap | None = None
    ) -> None:
        self.metadata = served.metadata
        self._served, self._fresh = served, fresh
        self._drawn = torch.Generator().manual_seed(seed)
        self._reader = ObservationReader(served.metadata, key_map)
        source = served.checkpoint.source
        # Half a tick less, because clocks are not exact.
        self._between_s = (source["vlm_reuse_count"] - 0.5) / source["action_hz"]
        self._begin_episode()

    def infer(self, observation: Mapping[str, Any]) -> Answer:
        """The answer to an observation: `actions` (horizon, action) in the units of the metadata.

        It also has `server_timing` in ms and, where the policy looks at features, `feature_age_s`,
        `trained_age_s`, the oldest age in training, and `feature_key` (16,). `warnings` lists what
        is hardly right, each once an episode (`Doubts`; an instruction or an age of features that
        training never saw). Raises `ObservationError`,
        `NumericsError` and `VLMError`.
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
        """The answer to the observation that `take` returned."""
        self._look_first(observation)
        vlm_s = self._look(observation) if self.metadata["uses_features"] else 0.0
        fields = self._memory.observation()
        if self.metadata["relative"] and not fields["state_valid"]:
            raise ObservationError(
                "state: expected a reading, from which the policy's actions count, found none"
            )
        actions, head_s = self._served.chunk(fields, self._drawn, observation.guide)
        whole_s = perf_counter() - self._asked_s
        wait_s = max(0.0, whole_s - vlm_s - head_s)
        spent = {"infer_ms": whole_s, "vlm_ms": vlm_s, "head_ms": head_s, "wait_ms": wait_s}
        timing = {part: 1000 * seconds for part, seconds in spent.items()}
        answer: Answer = {"actions": actions, "server_timing": timing}
        if (seen := self._memory.features) is not None:
            key, age_s = np.frombuffer(seen.key, np.uint8), float(fields["feature_age"])
            trained_s = self.metadata["trained_age_s"]
            answer |= {"feature_age_s": age_s, "trained_age_s": trained_s, "feature_key": key}
            if age_s > 1.1 * trained_s:  # clocks are not exact
                self._doubts.add(
                    "age",
                    f"features are {age_s:.2f} s old, and the policy was trained on at most "
                    f"{trained_s:.2f} s. rollout.latency_ms simulates what that does to it; a "
                    "faster model helps.",
                )
        self._doubts.look(observation)
        if warnings := self._doubts.take():
            answer["warnings"] = warnings
        return answer

    def _begin_episode(self) -> None:
        self._memory, self._doubts = RobotMemory.of(self._served.policy), Doubts()
        # A pass of the episode before has its own deque, and nobody takes its result.
        self._waiting: WaitingFrames = deque(maxlen=1)
        self._running: Future[Pass] | None = None
        self._began_s, self._instruction = -np.inf, ""
        self._frames_known = self._state_known = False

    def _look_first(self, observation: RobotObservation) -> None:
        """Refuse another robot than the policy's by the first frames and states of an episode."""
        frames = {} if self._frames_known else observation.frames
        state = None if self._state_known else observation.readings.get("state")
        if self._served.look is not None and (frames or state is not None):
            self._served.look.check(frames, state)
        self._frames_known |= bool(frames)
        self._state_known |= state is not None

    def _look(self, observation: RobotObservation) -> float:
        """Bring the features up to date; the seconds of a pass that ended for this answer, else 0.

        A pass begins at another prompt, and `vlm_reuse_count` ticks after the one before.
        """
        new_prompt = observation.prompt not in (None, self._instruction)
        if new_prompt and not observation.frames and self._memory.features is not None:
            raise ObservationError(
                f"prompt: expected frames beside another prompt than {self._instruction!r:.200}, "
                "for features are of both, found none"
            )
        spent = self._collect(wait=new_prompt)
        due = new_prompt or observation.time_s - self._began_s >= self._between_s
        if observation.frames and due:
            self._instruction = self._instructed(observation.prompt)
            if new_prompt:
                self._memory.forget_features()
            self._waiting.append((observation, self._instruction))
            self._began_s = observation.time_s
        if self._waiting and self._running is None:
            self._running = self._served.begin_pass(self._waiting)
        spent = self._collect(self._fresh or new_prompt or self._memory.features is None) or spent
        if self._memory.features is None:
            views = ", ".join(f"images/{view}" for view in self.metadata["streams"]["views"])
            raise ObservationError(
                f"images: expected some of {views} with the first observation of an episode"
            )
        return spent

    def _instructed(self, prompt: str | None) -> str:
        """The prompt, or without one the only instruction that the policy was trained on.

        Raises `ObservationError` without a prompt where training saw none or several.
        """
        trained = self._served.checkpoint.instructions
        known = ", ".join(map(repr, trained))
        if prompt is None and len(trained) != 1:
            raise ObservationError(
                f"prompt: expected what the robot is to do, found none. Trained on: {known}"
            )
        instruction = trained[0] if prompt is None else prompt
        if trained and instruction not in trained:
            why = f"prompt: the policy was never trained on {instruction!r:.200}, but on {known}"
            self._doubts.add("prompt", why)
        return instruction

    def _collect(self, wait: bool) -> float:
        """Take the features of a pass that has ended; the seconds it took, 0 without one."""
        if self._running is None or not (wait or self._running.done()):
            return 0.0
        ended, self._running = self._running, None
        self._memory.features, spent = ended.result()
        return spent


def stack_guides(guides: Sequence[PlanGuide | None], device: torch.device) -> Guide | None:
    """The guides of a batch of robots, in this order, on `device`; None where no robot has one.

    A robot without a plan gets weight 0, so that its chunk is drawn freely.
    """
    given = next((guide for guide in guides if guide is not None), None)
    if given is None:
        return None
    free = PlanGuide(np.zeros_like(given.chunk), np.zeros_like(given.weight))
    rows = [guide or free for guide in guides]
    chunk, weight = np.stack([row.chunk for row in rows]), np.stack([row.weight for row in rows])
    return Guide(torch.from_numpy(chunk).to(device), torch.from_numpy(weight).to(device))
