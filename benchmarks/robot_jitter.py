"""How well a robot's loop keeps its deadlines while the model runs beside it.

The simulated arm is run in real time at each rate: in one process with the policy, and in two, the
policy behind `stages.serve`. Each episode is a run, and runs follow one another. Every tick of one
is accounted for: the arm counts on its own how often it is observed, and when it was not, a tick
must be counted as left out. Safe stops are counted. Rates other than the policy's make the
simulated world faster, not the policy: what it does there is not what it was trained for, but costs
as much.
"""

import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.jitter_picture import jitter
from benchmarks.timing import arguments, at_least, at_most, report
from pipeline.base.config import (
    LimitsFile,
    Params,
    TrainHeadParams,
    VLMParams,
    load_params,
    load_section,
)
from pipeline.compat.unified import no_normalization
from pipeline.data.insertion import SENSOR, STATE
from pipeline.look.page.style import write
from pipeline.policy.checkpoint import PolicyCheckpoint, save_policy
from pipeline.policy.observation import PolicyShape
from pipeline.policy.policy import Policy
from pipeline.robot.client import PolicyClient
from pipeline.robot.limits import Limits
from pipeline.robot.loop import StopKind
from pipeline.robot.realtime import PolicySession, RunSettings, run_robot
from pipeline.robot.run_report import ANSWER_PARTS, TICK_PARTS, RunReport, Timings
from pipeline.robot.session import ServedPolicy
from pipeline.simulation.environment import SimulatedRobot
from pipeline.simulation.insertion import INSTRUCTION, TICK_HZ
from pipeline.simulation.rendering import VIEWS
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from pipeline.vlm.live import live_spec

LIMITS = Path(__file__).resolve().parents[1] / "examples" / "limits.yaml"
ACTION = {
    "names": ["dx", "dy", "dz", "rx", "ry", "rz", "gripper"],
    "units": ["mm"] * 3 + ["deg"] * 3 + [""],
    "kind": "delta",
}
SMALL = {
    "sensor_encoder": {"channels": [8], "layers": 0, "heads": 1, "output_dim": 8},
    "state_encoder": {"dim": 8, "layers": 0, "heads": 1, "output_dim": 8},
    "expert": {"dim": 8, "layers": 1, "heads": 1},
}
SERVING = "serving ws://"
_LONGEST_TICKS = 2**17


class CountedRobot(SimulatedRobot):
    """The arm, which counts on its own how often it is observed, and for how long it is run."""

    observed = 0
    _began_at_s = _observed_at_s = _stopped_at_s = math.nan

    def observe(self) -> dict[str, Any]:
        """As the arm does."""
        self._observed_at_s = self._clock()
        if not self.observed:
            self._began_at_s = self._observed_at_s
        self.observed += 1
        return super().observe()

    def stop(self, reason: str) -> None:
        """As the arm does."""
        self._stopped_at_s = self._clock()
        super().stop(reason)

    def unaccounted(self, left_out: int, safe_stop: bool) -> float:
        """Ticks of its time in which it was not observed and that were not `left_out`; below 0, how
        many were counted too often. A tick that a safe stop has cut short is not counted."""
        ended_s = self._observed_at_s if safe_stop else self._stopped_at_s
        ticks = self.observed - safe_stop + left_out
        return (ended_s - self._began_at_s) * self._hz - ticks


@dataclass
class Course:
    """All runs of the arm at one rate."""

    hz: float
    ticks: Timings = field(default_factory=lambda: Timings((*TICK_PARTS, "tick"), _LONGEST_TICKS))
    answers: Timings = field(default_factory=lambda: Timings(ANSWER_PARTS, _LONGEST_TICKS))
    stops: Counter[str] = field(default_factory=Counter[str])
    left_out: int = 0
    missed_ticks: int = 0
    unaccounted: float = 0.0
    """The most of a run."""
    episodes: Counter[str] = field(default_factory=Counter[str])

    def take(self, run: RunReport, robot: CountedRobot) -> None:
        """One more run."""
        for row in run.tick_timings.rows():
            self.ticks.note(row)
        for row in run.answer_timings.rows():
            self.answers.note(row)
        self.left_out += run.left_out
        self.missed_ticks += run.missed_ticks
        safe_stop = run.kind != StopKind.TIME
        unaccounted = robot.unaccounted(run.left_out, safe_stop)
        self.unaccounted = max(self.unaccounted, abs(unaccounted))
        if run.kind == StopKind.ENDED:
            self.episodes[run.reason] += 1
        elif safe_stop:
            self.stops[f"{run.kind.value}: {run.reason}"] += 1

    def document(self) -> dict[str, Any]:
        """What is told of it."""
        answers = self.answers.rows()
        passes = int((answers[:, ANSWER_PARTS.index("vlm_ms")] > 0).sum())
        return {
            "ticks": self.ticks.count,
            "missed_ticks": self.missed_ticks,
            "left_out": self.left_out,
            "unaccounted": self.unaccounted,
            "answers": len(answers),
            "model_passes": passes,
            "safe_stops": dict(self.stops),
            "episodes": dict(self.episodes),
            "tick_ms": self.ticks.document(),
            "answer_ms": self.answers.document(),
        }


def main() -> None:
    """Serve, run, draw, print."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--minutes", type=float, default=10.0, help="at each rate")
    parser.add_argument("--hz", type=float, nargs="+", default=[10.0, 30.0, 100.0])
    parser.add_argument("--processes", type=int, nargs="+", choices=(1, 2), default=[1, 2])
    parser.add_argument("--params", type=Path, default=Path("params.yaml"))
    parser.add_argument("--checkpoint", type=Path, help="a trained policy; else an untrained one")
    parser.add_argument("--fifo", type=int, default=0, help="priority of the loop, from 1")
    parser.add_argument("--results", type=Path, help="folder of the picture; else none is drawn")
    options = parser.parse_args()
    torch.set_num_threads(1)
    seconds = 1.5 if options.quick else 60 * options.minutes
    rates = [10.0] if options.quick else options.hz
    params, folder = load_params(options.params), Path(tempfile.mkdtemp(prefix="robot-jitter-"))
    courses: dict[str, Course] = {}
    if options.results is not None:
        options.results.mkdir(parents=True, exist_ok=True)  # before the hours that it waits for
    try:
        if options.checkpoint is None:
            params = untrained(params, folder, options.quick)
        else:
            params = with_checkpoint(params, options.checkpoint)
        for processes in options.processes:
            with (local if processes == 1 else remote)(params) as connect, first(options.fifo):
                for hz in rates:
                    name = f"{processes} process{'es' if processes > 1 else ''}, {hz:g} Hz"
                    settings = RunSettings(INSTRUCTION, hz=hz)
                    courses[name] = run(connect, settings, seconds)
                    tell(name, courses[name])
    finally:
        shutil.rmtree(folder)
    if options.results is not None:
        drawn = {name: (course.hz, course.ticks) for name, course in courses.items()}
        write(options.results, {"robot_jitter.png": lambda: jitter(drawn)})
    targets = [target for name, course in courses.items() for target in judged(name, course)]
    report(
        "robot_jitter",
        settings={"seconds": seconds, "hz": rates, "fifo": options.fifo,
                  "checkpoint": "trained" if options.checkpoint else "untrained"},
        results={name: course.document() for name, course in courses.items()},
        ratios={},
        targets=targets,
        quick=options.quick,
    )  # fmt: skip


def run(connect: Callable[[], PolicySession], settings: RunSettings, seconds: float) -> Course:
    """Run the arm for so many seconds, an episode a run."""
    hz = settings.hz or TICK_HZ
    course, seed = Course(hz), 0
    while (left := seconds - (course.ticks.count + course.left_out) / hz) > 0.5 / hz:
        policy = connect()
        limits = world_limits(policy.metadata, hz)
        with closing(CountedRobot(hz=hz, seed=seed)) as robot:
            # Late ticks are what is to be measured; they stop nothing here.
            patient = replace(settings, seconds=left, missed_in_a_row=10**9)
            course.take(run_robot(robot, policy, patient, limits), robot)
        seed += 1
    return course


def world_limits(metadata: Mapping[str, Any], hz: float) -> Limits:
    """The example's limits for the arm at `hz`, whose world goes `hz / TICK_HZ` times as fast as
    life: its speeds are so many times those of the file, its accelerations that squared."""
    file, faster = load_section(LIMITS, LimitsFile).model_dump(), hz / TICK_HZ
    for kind, times in (("speed", faster), ("acceleration", faster**2)):
        file[kind]["most"] = {name: times * most for name, most in file[kind]["most"].items()}
    return Limits(LimitsFile.model_validate(file), metadata, hz)


def judged(name: str, course: Course) -> list[dict[str, Any]]:
    """The targets of the report."""
    told, ran = course.ticks.document(), course.ticks.count
    return [
        at_least(f"{name}: share of ticks in time", 1 - course.left_out / max(1, ran), 0.999),
        at_most(f"{name}: p99 of how late a tick begins [ms]", told["late"]["p99"], 1.0),
        at_most(f"{name}: ticks of a run that are not accounted for", course.unaccounted, 1.0),
    ]


def tell(name: str, course: Course) -> None:
    """The tables of a rate, on stderr."""
    head = f"{name}: {course.ticks.count} ticks, {course.missed_ticks} missed, "
    print(head + f"{course.left_out} left out, {dict(course.stops)}", file=sys.stderr)
    for table in (course.ticks.table(), course.answers.table()):
        print("\n".join(table.text()), file=sys.stderr)


@contextmanager
def local(params: Params) -> Generator[Callable[[], PolicySession]]:
    """The policy in this process, its model on a thread beside the loop."""
    served = ServedPolicy.load(chosen(params), params.vlm, "cpu", say)
    with closing(served):
        yield lambda: served.session(fresh=False)


@contextmanager
def remote(params: Params) -> Generator[Callable[[], PolicySession]]:
    """The policy in a process of its own, behind `stages.serve`."""
    wanted = params.serve.model_copy(update={"port": 0, "fresh": False, "device": "cpu"})
    told = params.model_copy(update={"serve": wanted}).model_dump_json()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with ExitStack() as leaving:
        written = leaving.enter_context(tempfile.NamedTemporaryFile("w", suffix=".yaml"))
        written.write(told)
        written.flush()
        command = [sys.executable, "-m", "stages.serve", "--params", written.name]
        server = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        leaving.callback(server.communicate)
        leaving.callback(server.terminate)
        assert server.stdout is not None
        serving = next((line for line in server.stdout if line.startswith(SERVING)), None)
        if serving is None:
            raise RuntimeError(f"{' '.join(command)}: ended before it served")
        connection = leaving.enter_context(ExitStack())

        def connect() -> PolicyClient:
            connection.close()  # the server takes a few robots at a time
            return connection.enter_context(PolicyClient(serving.split()[1]))

        yield connect


@contextmanager
def first(priority: int) -> Generator[None]:
    """This thread, and those that begin within this, go before others, as under `chrt -f`."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


def untrained(params: Params, folder: Path, quick: bool) -> Params:
    """These params with the demo's model and a policy of random weights, written below `folder`.

    It moves by tenths of a millimetre and costs what a trained one of the same head does.
    """
    write_demo_checkpoint(folder / "vlm")
    vlm = params.vlm.model_copy(update={"checkpoint": str(folder / "vlm"), "adapter": None})
    head = params.train_head.model_dump() | (SMALL if quick else {})
    save_policy(folder / "policy", random_policy(TrainHeadParams.model_validate(head), vlm))
    return with_checkpoint(params.model_copy(update={"vlm": vlm}), folder / "policy")


def random_policy(head: TrainHeadParams, vlm: VLMParams) -> PolicyCheckpoint:
    """A policy of the phantom with random weights."""
    spec = live_spec(vlm, VIEWS)
    groups = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)
    sizes = (len(spec.slots), spec.dim, len(SENSOR.names), len(STATE.names), 7)
    shape = PolicyShape(*sizes, action_groups=groups, views=len(VIEWS))
    normal = no_normalization(shape)
    still = np.array([0, 0, -0.1, 0, 0, 0, 1.0])
    action = replace(normal.action, std=np.full(7, 0.05), mean=still)
    normal = replace(normal, action=action)
    streams = {
        "action": ACTION,
        "state": {"names": list(STATE.names), "units": list(STATE.units)},
        "sensor": {"names": list(SENSOR.names), "units": list(SENSOR.units)},
        "views": list(VIEWS),
    }
    source = {
        "feature_spec": spec.document | {"digest": spec.digest},
        "streams": streams,
        "action_hz": float(TICK_HZ),
        "vlm_reuse_count": 3,
    }
    torch.manual_seed(0)
    weights = Policy(head, shape, normal).state_dict()
    split: Any = {"train": {}, "val": {}, "test": {}}
    return PolicyCheckpoint(
        head, shape, normal, source, split, 0, weights, instructions=(INSTRUCTION,)
    )


def with_checkpoint(params: Params, folder: Path) -> Params:
    """These params, to serve the policy of `folder`."""
    return params.model_copy(
        update={"serve": params.serve.model_copy(update={"checkpoint": folder})}
    )


def chosen(params: Params) -> Path:
    """The policy that is served."""
    return params.serve.checkpoint or params.train_head.output


def say(line: str) -> None:
    """Progress goes to stderr."""
    print(line, file=sys.stderr)


if __name__ == "__main__":
    main()
