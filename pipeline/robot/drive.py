"""Drive the robot that params name with a policy, in this process or behind a server."""

import os
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from pydantic import TypeAdapter, ValidationError
from tqdm import tqdm

from pipeline.base.config import DriveParams, Params
from pipeline.base.documents import problems
from pipeline.base.errors import ConfigError, RobotStopped
from pipeline.base.user_classes import make_named
from pipeline.robot.client import TOKEN_VARIABLE, PolicyClient, refuse_other_robot
from pipeline.robot.lerobot_arm import LeRobotArm
from pipeline.robot.limits import Limits
from pipeline.robot.loop import StopKind, check_chunking
from pipeline.robot.loop_process import ended_by_hand
from pipeline.robot.realtime import PolicySession, Robot, RunSettings, run_robot
from pipeline.robot.recorder import RunRecorder
from pipeline.robot.run_report import RunReport

_LEROBOT = "lerobot"
_NORMAL = (StopKind.ENDED, StopKind.TIME, StopKind.BY_HAND)


def drive(params: Params, say: Callable[[str], None] = print) -> RunReport:
    """Run the robot until something ends the run; returns the report of a normal end.

    Raises `RobotStopped` after a safe stop, `ConfigError` for a robot, settings or limits that
    cannot be used, `CheckpointMismatch` where robot and policy do not fit, and what
    `ServedPolicy.load` and `PolicyClient` raise. All but the first are raised before the first
    action.
    """
    wanted = params.drive
    settings = _settings(wanted)
    with ExitStack() as opened:
        robot = opened.enter_context(_left(make_robot(wanted.robot, wanted.robot_args), say))
        policy = opened.enter_context(_policy(params, say))
        settings = _with_instruction(settings, policy.metadata["instructions"])
        hz = settings.hz or policy.metadata["action_hz"]
        limits = None if wanted.limits is None else Limits.read(wanted.limits, policy.metadata, hz)
        if limits is None:
            say("warning: without drive.limits any action of the policy is sent to the robot")
        check_chunking(settings.chunking, policy.metadata["stochastic"], "drive.settings")
        arm = _connected(robot, wanted, policy.metadata)
        recorder = None
        if wanted.runs is not None:
            document = {**vars(settings), "robot": wanted.robot}
            recorder = RunRecorder(wanted.runs, policy.metadata, settings.instruction, document)
        say(f"driving {wanted.robot} at {hz:g} Hz: {settings.instruction}. Ctrl-C stops it")
        with tqdm(unit=" answers", disable=None) as bar:
            report = run_robot(arm, _Shown(policy, bar), settings, limits, recorder)
    _tell(report, say)
    return report


def make_robot(name: str, arguments: Mapping[str, Any]) -> Any:
    """The robot of `module:Class`, or of `lerobot:TYPE`; it is not connected yet.

    Raises `ConfigError` where there is no such robot, or where the arguments do not fit.
    """
    module, _, made = name.partition(":")
    if not made:
        raise ConfigError(f"drive.robot: expected module:Class or lerobot:TYPE, found {name!r}")
    if module == _LEROBOT:
        return _lerobot_robot(made, arguments)
    return make_named("drive.robot", name, arguments)


def _lerobot_robot(kind: str, config: Mapping[str, Any]) -> Any:
    """The arm of an installed LeRobot, from its own config class."""
    try:
        import draccus  # pyright: ignore[reportMissingImports]
        from lerobot import cameras, robots  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(
            f"drive.robot: lerobot:{kind}: {error}. Install LeRobot in this environment, or run "
            "the policy in another one (python -m stages.serve) and name it as drive.server"
        ) from error
    for package in (robots, cameras):  # Each registers its config when it is imported.
        for module in iter_modules(package.__path__):
            with suppress(Exception):  # Of another robot, whose drivers are missing or broken.
                import_module(f"{package.__name__}.{module.name}")
    try:
        chosen = draccus.decode(robots.RobotConfig, {"type": kind, **config})
    except draccus.utils.DecodingError as error:
        known = ", ".join(sorted(robots.RobotConfig.get_known_choices()))
        raise ConfigError(f"drive.robot: lerobot:{kind}: {error}. LeRobot has {known}") from None
    return import_module("lerobot.robots.utils").make_robot_from_config(chosen)


@contextmanager
def _left(robot: Any, say: Callable[[str], None]) -> Generator[Any]:
    """The robot; afterwards it is disconnected or closed, and a failure of that is only printed.

    Meanwhile Ctrl-C interrupts nothing, so that a second one does not leave the robot connected.
    """
    try:
        yield robot
    finally:
        leave = getattr(robot, "disconnect", None) or getattr(robot, "close", None)
        if leave is not None and getattr(robot, "is_connected", True):
            try:
                with ended_by_hand() as signals:
                    signals.append("")  # From here on a signal interrupts nothing.
                    leave()
            except Exception as error:  # What ended the run must still be told.
                say(f"warning: the robot was not disconnected ({error}): see that it stands still")


def _connected(robot: Any, wanted: DriveParams, metadata: Mapping[str, Any]) -> Robot:
    """The robot as the control loop drives it, connected."""
    refuse_other_robot(getattr(robot, "description", {}), metadata)
    if hasattr(robot, "connect"):
        robot.connect()
    if hasattr(robot, "get_observation"):
        names, latency_s = (wanted.cameras, wanted.motors), wanted.camera_latency_s
        return LeRobotArm(robot, metadata, *names, camera_latency_s=latency_s)
    return robot


@contextmanager
def _policy(params: Params, say: Callable[[str], None]) -> Generator[PolicySession]:
    """The policy of `drive.server`, or of a checkpoint in this process."""
    wanted = params.drive
    if wanted.server is not None:
        token = os.environ.get(TOKEN_VARIABLE)
        with PolicyClient(wanted.server, token, timeout_s=wanted.timeout_s) as client:
            yield client
        return
    from pipeline.robot.session import ServedPolicy  # It imports torch.

    folder = wanted.checkpoint or params.train_head.output
    with closing(ServedPolicy.load(folder, params.vlm, wanted.device, say)) as served:
        yield served.session(fresh=False)


def _settings(wanted: DriveParams) -> RunSettings:
    """The settings of the run, still without the policy's own instruction."""
    given = {"instruction": wanted.instruction or "", "seconds": wanted.seconds, **wanted.settings}
    fields = RunSettings.__dataclass_fields__
    if unknown := sorted(given.keys() - fields):
        raise ConfigError(f"drive.settings: expected {', '.join(fields)}, found {unknown}")
    try:
        return TypeAdapter(RunSettings).validate_python(given)
    except ValidationError as error:
        wrong = (f"drive.settings.{place}: {why}" for place, why in problems(error))
        raise ConfigError("; ".join(wrong)) from None


def _with_instruction(settings: RunSettings, known: Sequence[str]) -> RunSettings:
    """Without an instruction, the only one that the policy was trained on."""
    if settings.instruction:
        return settings
    if len(known) != 1:
        raise ConfigError(
            "drive.instruction: expected what the robot is to do, found none. The policy was "
            f"trained on {', '.join(map(repr, known)) or 'no instruction'}"
        )
    return replace(settings, instruction=known[0])


class _Shown:
    """A policy whose answers advance a progress bar; a warning in an answer is printed."""

    def __init__(self, policy: PolicySession, bar: Any) -> None:
        self._policy, self._bar = policy, bar
        self.metadata = policy.metadata

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        answer = self._policy.infer(observation)
        for warning in answer.get("warnings", ()):
            self._bar.write(f"warning: {warning}", sys.stderr)
        if (age_s := answer.get("feature_age_s")) is not None:
            self._bar.set_postfix_str(f"features {age_s:.2f} s old", refresh=False)
        self._bar.update()
        return answer


def _tell(report: RunReport, say: Callable[[str], None]) -> None:
    """Print how the run went; raise `RobotStopped` after a safe stop."""
    for timings in (report.tick_timings, report.answer_timings):
        for line in timings.table().text():
            say(line)
    counts = f"{report.ticks} ticks, {report.missed_ticks} late, {report.answers} answers"
    say(f"{counts}, {report.clipped} actions clipped")
    if report.recording is not None:
        say(f"recording: {report.recording} (python -m stages.inspect {report.recording})")
    if report.traceback:
        print(report.traceback, file=sys.stderr)
    ended = f"{report.kind}: {report.reason}"
    if report.kind not in _NORMAL:
        raise RobotStopped(f"{ended}. docs/robot.md says what to look at")
    say(ended)
