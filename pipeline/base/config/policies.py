"""Sections for the use of a trained policy: evaluate, roll out, serve, drive, export, push."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

from pipeline.base.config.section import Output, Place, Section, Seed

Level = Literal["depth", "full", "moved"]
Chunking = Literal["none", "temporal", "rtc"]
RolloutAblation = Literal["sensor off", "features off", "state off"]
ExportFormat = Literal["onnx", "torch"]
PHANTOM: Final = "phantom"


def _known_form(name: str) -> str:
    """A name that may be an environment's; whether there is such a one shows when it is opened."""
    kind, _, rest = name.partition(":")
    if name != PHANTOM and not (kind and rest):
        raise ValueError(f"expected {PHANTOM}, metaworld:TASK or module:name, found {name!r}")
    return name


Environment = Annotated[str, AfterValidator(_known_form)]
Environments = Annotated[tuple[Environment, ...], Field(min_length=1)]
Latency = Annotated[float, Field(ge=0, le=60_000)]


class EvaluateParams(Section):
    """Which policy is evaluated, and where the report is written."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; null: `train_head.output`. DVC does not
    watch another one."""
    output: Output = Path("reports/evaluate")
    """Folder of metrics, tables and pictures."""
    batch_size: int = Field(default=64, ge=1, le=2**16)
    """Ticks per forward pass."""
    samples: int = Field(default=16, ge=1, le=1000)
    """Chunks sampled per tick. The error is that of one chunk, averaged over them for less noise;
    the error of their mean, that of the best one and the energy score are reported beside it.
    Experts that do not sample give one."""
    execute: int = Field(default=1, ge=1, le=1000)
    """Steps of a chunk that the robot executes before it requests the next; their error comes
    first."""
    modalities: bool = True
    """Also evaluate with each stream at its training mean, and delayed."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    store: Place | None = None
    """The store to evaluate on; null: `train_head.store`, or else `extract.store`."""
    check_store: bool = True
    """Read the whole store once before the evaluation, and refuse a chunk that does not give its
    checksum; false skips this, where it takes too long."""


def environments(named: str | Sequence[str] | None) -> tuple[str, ...]:
    """Each environment of `rollout.environment` once, in the given order."""
    return tuple(dict.fromkeys((named,) if isinstance(named, str) else named or ()))


def latencies_ms(latency: float | Sequence[float]) -> tuple[float, ...]:
    """Each latency of `rollout.latency_ms` once, in the given order."""
    return tuple(dict.fromkeys(latency if isinstance(latency, Sequence) else (latency,)))


class RolloutParams(Section):
    """How a policy runs in closed loop in a simulation, and where the report is written."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    environment: Environment | Annotated[tuple[Environment, ...], Field(min_length=1)] | None = (
        PHANTOM
    )
    """phantom: the simulated needle insertion of the demo. metaworld:TASK: a task of Meta-World,
    such as metaworld:assembly-v3. module:name: what this class or function of yours makes
    (docs/recipes/environment.md). A list: one after another. null runs no rollout, for recordings
    of another robot; the stage then only says so."""
    level: Level = "full"
    """Of the phantom alone. depth: the needle begins above the target, and the sensor is enough.
    full: it begins anywhere. moved: as full, and target and tissue are pushed meanwhile."""
    episodes: int = Field(default=50, ge=1, le=1_000_000)
    """Episodes per controller."""
    seed: int = Field(default=1_000_000, ge=0, lt=2**53)
    """Seed of the first episode; later episodes have the next seeds."""
    execute: int = Field(default=1, ge=1, le=1000)
    """Steps of a chunk that are executed before the head computes the next."""
    chunking: Chunking = "temporal"
    """none: the newest chunk. temporal: the weighted mean of all chunks that reach the tick
    (temporal ensembling). rtc: each chunk is drawn to continue the last (real-time chunking), for
    experts that sample."""
    latency_ms: Latency | Annotated[tuple[Latency, ...], Field(min_length=1)] = 0.0
    """Simulated time in ms of one pass of the model; its features are older by this. The head takes
    no time. For several, such as `[0, 300, 600]`, the page plots success against latency;
    everything else uses the first."""
    ablations: tuple[RolloutAblation, ...] = ("sensor off", "features off")
    """Also run the policy with one stream at its training mean. Streams that the policy does not
    use, and its only stream, are skipped. []: none."""
    server: str | None = None
    """Address of a running `stages.serve`, such as ws://127.0.0.1:8000; its policy is run over the
    network in place of `checkpoint`. If it needs a token, set the environment variable
    VLA_SERVE_TOKEN."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    output: Output = Path("reports/rollout")
    """Folder of metrics, table and page."""


class ServeParams(Section):
    """How a policy is served to robots."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    host: str = "127.0.0.1"
    """Address to listen on. All but this machine's own (127.0.0.1, ::1) need a token."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port to listen on; 0 chooses a free one and prints it."""
    token_file: Place | None = None
    """File with the token that robots must send. null: the environment variable VLA_SERVE_TOKEN, or
    no token if that is not set."""
    fresh: bool = True
    """A chunk waits for the features of the frames in its observation. false: it uses the newest
    available features, and the model computes new ones meanwhile."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    seed: Seed = 0
    """Seed of a policy's draws for a robot that sends no seed."""
    max_connections: int = Field(default=8, ge=1, le=10_000)
    """Most robots at a time; each has one observation that is being answered or waits."""
    max_message_mb: int = Field(default=64, ge=1, le=1024)
    """Largest size of one observation, in MiB."""
    idle_s: float = Field(default=600.0, gt=0, le=1e6)
    """Seconds after which a connection without a complete message is closed."""
    transform: Literal["aloha", "droid", "libero"] | None = None
    """Take observations by the names that openpi's clients of this robot give. Their images are
    the policy's views in this order. aloha: `images/cam_high`, `cam_left_wrist`,
    `cam_right_wrist`, `cam_low`; `state`. droid: `observation/exterior_image_1_left`,
    `wrist_image_left`; the state is `joint_position` and `gripper_position`. libero:
    `observation/image`, `wrist_image`; `observation/state`."""
    log: Literal["text", "json"] = "text"
    """How the line of each connection, episode, slow answer, warning and refusal is written."""


class DriveParams(Section):
    """Which robot is driven, by which policy, and what ends the run."""

    robot: str = "pipeline.simulation.environment:SimulatedRobot"
    """`module:Class` of a class with `observe`, `frames`, `act` and `stop`, or with LeRobot's
    interface; or `lerobot:TYPE`, an arm of an installed LeRobot, such as `lerobot:so101_follower`.
    """
    robot_args: dict[str, Any] = Field(default_factory=dict)
    """The arguments of the class, or the config of LeRobot's arm (`port`, `cameras`, …)."""
    cameras: dict[str, str] = Field(default_factory=dict)
    """Cameras of a LeRobot arm by the policy's view; a view has the camera of its own name."""
    motors: dict[str, str] = Field(default_factory=dict)
    """Motors of a LeRobot arm by the policy's channel; a channel has the motor of its own name."""
    camera_latency_s: float = Field(default=0.0, ge=0, le=10)
    """How long an image of a LeRobot arm is on its way, for LeRobot gives no times."""
    server: str | None = None
    """Address of a running stages.serve, such as ws://192.168.1.5:8000. null: the policy runs in
    this process. A token is taken from the environment variable VLA_SERVE_TOKEN."""
    timeout_s: float = Field(default=10.0, gt=0, le=600)
    """How long the server may take to connect, and to answer."""
    checkpoint: Place | None = None
    """Without a server: a training run's folder, or a checkpoint; `train_head.output` where null.
    """
    device: str = "auto"
    """Without a server: auto, cpu, cuda or cuda:N."""
    instruction: str | None = None
    """What the robot is to do. null: the only instruction that the policy was trained on."""
    limits: Place | None = None
    """YAML file with the limits of motion, workspace and force. null: nothing is limited."""
    runs: Output | None = Path("runs")
    """Each run becomes a LeRobot data set `run_NNNNNN` in this folder. null: nothing is recorded.
    """
    seconds: float | None = Field(default=None, gt=0, le=1e6)
    """How long the robot is driven. null: until something ends the run."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Other fields of `RunSettings` (`pipeline.robot.realtime`), such as `old_features_s`."""


class PushParams(Section):
    """Which policy or store is uploaded to the Hugging Face Hub, and where to."""

    repo: str = ""
    """The repository, as owner/name. It is made if there is none."""
    folder: Place | None = None
    """A trained policy or a finished store. null: `train_head.output`."""
    private: bool = True
    """Whether a new repository is private. A policy carries a few camera frames (golden rows), a
    store all streams: look at them before you publish."""
    card_only: bool = False
    """Print the card, upload nothing."""


class ExportParams(Section):
    """Which policy's head is exported for other runtimes, and in which formats."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    output: Output = Path("models/export")
    """Folder of the files and their receipt."""
    formats: tuple[ExportFormat, ...] = Field(default=("onnx", "torch"), min_length=1)
    """onnx: `head.onnx`, for ONNX Runtime. torch: `head.pt2`, for `torch.export.load`."""


class CompareParams(Section):
    """Which evaluations are compared in one table."""

    reports: Place = Path("reports/experiments")
    """Folder of evaluation folders, each named after its experiment."""
    output: Output = Path("reports/comparison")
    """Folder of the table and the picture."""


Most = dict[str, Annotated[float, Field(gt=0, le=1e12)]]


class MotionLimit(Section):
    """The largest motion, and the reaction to a larger one."""

    most: Most
    """Largest length of all `translation` or all `rotation` channels together, or largest absolute
    value of the action channel with this name."""
    on_exceed: Literal["stop", "clip"] = "stop"
    """stop: a safe stop. clip: send the longest allowed motion in the same direction."""


class Workspace(Section):
    """The space in which the robot may be."""

    box: dict[str, tuple[float, float]]
    """Lowest and highest reading for each named state channel."""


class Force(Section):
    """The largest force of the robot."""

    most: Most
    """Largest absolute reading for each named sensor channel."""


class LimitsFile(Section):
    """The content of a limits file; a missing entry is no limit."""

    step: MotionLimit | None = None
    """Limit of one action, in the units of the action."""
    speed: MotionLimit | None = None
    """Limit in units per s."""
    acceleration: MotionLimit | None = None
    """Limit in units per s²."""
    workspace: Workspace | None = None
    force: Force | None = None
