"""Meta-World's tasks as gymnasium environments (https://arxiv.org/abs/1910.10897, its v3 tasks).

A tick is one control step of Meta-World, 12.5 ms: its scripted experts decide at 80 Hz, so do our
policies, and `vlm_reuse_count` says how many ticks share one picture. Needs the extra `metaworld`.
"""

import atexit
import os
import warnings
from collections.abc import Mapping
from ctypes.util import find_library
from functools import cache
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from pipeline.base.errors import ConfigError
from pipeline.data.recording import Channels
from pipeline.simulation.interface import EnvironmentRobot, Readings, RobotEnvironment, Shots

HZ: Final = 80
MAX_TICKS: Final = 500
VIEW: Final = "corner2"
"""The camera; it hangs upside down, so its pictures are turned by 180 degrees."""
SUCCEEDED: Final = "succeeded"
TIME_IS_UP: Final = "the time of 500 steps is up"
STATE: Final = Channels(("x", "y", "z", "gripper_opening"), ("mm", "mm", "mm", ""))
"""The hand in the frame of the table, and how far the fingers are apart, 0 to 1 (0.1 m)."""
ACTION: Final = Channels(("dx", "dy", "dz", "gripper"), ("mm", "mm", "mm", ""))
"""What is added to the hand's setpoint, and the force of the fingers, -1 (open) to 1 (close)."""
INSTRUCTIONS: Final = {
    "assembly-v3": "Pick up the ring by its handle and put it over the peg.",
    "bin-picking-v3": "Pick up the cube from one bin and put it into the other.",
    "button-press-topdown-v3": "Press the button from above.",
    "drawer-open-v3": "Open the drawer.",
    "hammer-v3": "Pick up the hammer and drive the nail into the wall.",
}
"""The five tasks of CortexBench; the instruction of any other is made from its name."""

_STEP_MM: Final = 10.0
"""How far an action of 1 moves the setpoint of Meta-World."""
_BOUND: Final = np.array([_STEP_MM, _STEP_MM, _STEP_MM, 1.0])
_LARGEST: Final = 1e4


def full_name(task: str) -> str:
    """The name of a task with its version: `assembly` gives `assembly-v3`."""
    return task if task.endswith("-v3") else f"{task}-v3"


def instruction_of(task: str) -> str:
    """The instruction: one plain sentence."""
    name = full_name(task)
    words = name.removesuffix("-v3").replace("-", " ")
    return INSTRUCTIONS.get(name, f"{words.capitalize()}.")


class MetaWorldEnvironment(RobotEnvironment):
    """One episode of a task for each seed, which draws the places of object and goal.

    An action (4,) is dx dy dz in mm, added to the hand's setpoint, and the force of the fingers;
    what is beyond 10 mm or 1 is cut off. An observation has `state` (1, 4), `state_time` (1,) and
    `time` (1,) in s. An episode ends with the first step that the task counts as success, or after
    500 steps. Reward 1 for success; `info` has `success` and, at the end, its `reason`. Meta-World
    draws from its own generator, seeded with the episode's seed before each reset, so the same
    seed gives the same episode, bit for bit on one machine, whatever was played before.
    """

    def __init__(self, task: str, image: int = 224, shadows: bool = False) -> None:
        """Frames are (`image`, `image`, 3); with `shadows` they have reflections, too.

        Raises `ConfigError` for an unknown task, and where Meta-World is not installed.
        """
        name = full_name(task)
        self.robot = EnvironmentRobot(
            name=f"metaworld:{name}",
            level=name,
            instruction=instruction_of(name),
            hz=HZ,
            action=ACTION,
            action_kind="delta",
            views=(VIEW,),
            state=STATE,
        )
        self._simulator, self._expert = _simulator(name), _expert(name)
        self._task, self._image, self._shadows = name, image, shadows
        self._seen: NDArray[np.float64] | None = None
        self.ticks, self.outcome = 0, None
        self.action_space = Box(
            -_BOUND.astype(np.float32), _BOUND.astype(np.float32), dtype=np.float32
        )
        self.observation_space = Dict(
            {
                "state": Box(-_LARGEST, _LARGEST, (1, len(STATE.names)), np.float32),
                "state_time": Box(0, _LARGEST, (1,), np.float64),
                "time": Box(0, _LARGEST, (1,), np.float64),
            }
        )

    ticks: int
    """Steps since the beginning of the episode."""
    outcome: str | None
    """How the episode ended; None while it goes on."""

    @property
    def finished(self) -> bool:
        """Whether the episode has ended."""
        return self.outcome is not None

    @property
    def success(self) -> bool:
        """Whether the task is done, as Meta-World judges it."""
        return self.outcome == SUCCEEDED

    @property
    def time_s(self) -> float:
        """Time since the beginning of the episode."""
        return self.ticks / HZ

    @property
    def drawn_mm(self) -> NDArray[np.float64]:
        """What the episode's seed drew, (3,) or (6,): the place of the object, the goal, or both.

        In the frame of the table. No policy is shown it.
        """
        return self._simulator._last_rand_vec * 1000

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Readings, dict[str, Any]]:
        """Begin the episode of `seed`, or of a random seed if None."""
        super().reset(seed=seed)
        import mujoco

        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        simulator = self._simulator
        simulator.seed(drawn)
        seen, _ = simulator.reset()
        # Meta-World moves peg and drawer last, without telling MuJoCo: frames and expert would see
        # them elsewhere.
        forward: Any = mujoco.mj_forward  # pyright: ignore[reportAttributeAccessIssue]
        forward(simulator.model, simulator.data)
        now = simulator._prev_obs = simulator._get_curr_obs_combined_no_goal()
        self._seen = np.concatenate([now, now, seen[2 * len(now) :]])
        self.ticks, self.outcome = 0, None
        return self._readings(), {"success": False}

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Readings, float, bool, bool, dict[str, Any]]:
        """Carry out one tick.

        Raises `ResetNeeded` before the first episode and after the end of one, and `ValueError` for
        an action that is not four finite numbers.
        """
        if self._seen is None or self.finished:
            raise gymnasium.error.ResetNeeded("the episode has not begun, or has ended: call reset")
        wanted = np.asarray(action, np.float64)
        if wanted.shape != _BOUND.shape or not np.isfinite(wanted).all():
            raise ValueError(f"expected four finite numbers as an action, found {action!r}")
        self._seen, _, _, _, judged = self._simulator.step(np.clip(wanted / _BOUND, -1, 1))
        self.ticks += 1
        if judged["success"]:
            self.outcome = SUCCEEDED
        elif self.ticks == MAX_TICKS:
            self.outcome = TIME_IS_UP
        info: dict[str, Any] = {"success": self.success}
        info |= {"reason": self.outcome} if self.finished else {}
        late = self.outcome == TIME_IS_UP
        return self._readings(), float(self.success), self.success, late, info

    def _readings(self) -> Readings:
        assert self._seen is not None
        time = np.array([self.time_s])
        hand = np.append(self._simulator.get_endeff_pos() * 1000, self._seen[3])
        return {"state": hand.astype(np.float32)[None], "state_time": time, "time": time.copy()}

    def expert_action(self) -> NDArray[np.float32]:
        """The action (4,) of the task's scripted expert, which knows where everything is."""
        with warnings.catch_warnings():
            # It warns that its actions are cut off, in nearly every step.
            warnings.filterwarnings("ignore", "Constant", UserWarning)
            action = self._expert.get_action(self._seen)
        return (np.clip(action, -1, 1) * _BOUND).astype(np.float32)

    def frames(self) -> Shots:
        """The frame of now, drawn when this is called."""
        import mujoco

        renderer = _renderer(self._task, self._image)
        renderer.update_scene(self._simulator.data, VIEW)
        flags: Any = mujoco.mjtRndFlag  # pyright: ignore[reportAttributeAccessIssue]
        for flag in (flags.mjRND_SHADOW, flags.mjRND_REFLECTION):
            renderer.scene.flags[flag] = self._shadows
        return {VIEW: (self.time_s, np.ascontiguousarray(renderer.render()[::-1, ::-1]))}

    def frame_times(self) -> Mapping[str, float]:
        """Now: nothing is drawn."""
        return {VIEW: self.time_s}


def _meta_world() -> Any:
    """The package's tables of tasks and experts.

    Raises `ConfigError` where it is not installed, or where nothing draws that MuJoCo could load.
    """
    if not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
        gpu = any(map(os.path.exists, ("/dev/dri", "/dev/nvidiactl")))
        drawing = "egl" if gpu and find_library("EGL") else "osmesa"
        os.environ["MUJOCO_GL"] = drawing  # MuJoCo reads it when it is imported
    try:
        from metaworld import env_dict, policies
    except ImportError as error:
        raise ConfigError(
            f"Meta-World is not installed ({error}): expected the package metaworld 3.1.1 or "
            "later. Install the extra: pip install 'vla-feature-cache[metaworld]'"
        ) from error
    except Exception as error:  # MuJoCo loads what draws; each of its ways has errors of its own
        raise _cannot_draw("Meta-World", error) from error
    return env_dict.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE, policies.ENV_POLICY_MAP


def _simulator(name: str) -> Any:
    """Meta-World's own environment, which draws anew at each reset and shows its expert the goal.

    Raises `ConfigError` for an unknown task.
    """
    tasks, experts = _meta_world()
    if name not in experts:
        known = ", ".join(sorted(experts))
        raise ConfigError(f"metaworld:{name}: expected a task of Meta-World, which are {known}")
    simulator = tasks[f"{name}-goal-observable"](seed=0)
    simulator.seeded_rand_vec, simulator._freeze_rand_vec = True, False
    return simulator


def _expert(name: str) -> Any:
    return _meta_world()[1][name]()


@cache
def _renderer(name: str, image: int) -> Any:
    """Draws all environments of a task: MuJoCo mixes up contexts that are freed and made anew.

    Raises `ConfigError` where MuJoCo cannot draw on this machine.
    """
    import mujoco

    try:
        return mujoco.Renderer(_simulator(name).model, image, image)
    except Exception as error:  # each of its ways to draw has errors of its own
        raise _cannot_draw(f"metaworld:{name}", error) from error


def _cannot_draw(what: str, error: Exception) -> ConfigError:
    return ConfigError(
        f"{what}: MuJoCo cannot draw frames with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}: "
        f"{error}. Without a display it needs osmesa (Debian: libosmesa6) or egl; set MUJOCO_GL "
        "before mujoco is imported"
    )


atexit.register(_renderer.cache_clear)  # before the modules that a renderer needs to close
