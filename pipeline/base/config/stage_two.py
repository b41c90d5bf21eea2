"""Sections for training, tuning of the vision-language model itself, and evaluation."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.base.config.policy import (
    DiffusionParams,
    ExpertParams,
    FlowMatchingParams,
    RegressionParams,
    SensorEncoderParams,
    StateEncoderParams,
)
from pipeline.base.config.section import Fraction, Output, Place, Section, Seed

ModelType = Literal["regression", "diffusion", "flow_matching"]
FusionStrategy = Literal["concat", "cross_attention", "gated", "none"]
Level = Literal["depth", "full", "moved"]
Chunking = Literal["none", "temporal", "rtc"]
RolloutAblation = Literal[
    "sensor off", "features off", "state off", "sensor frozen", "features frozen", "state frozen"
]
ExportFormat = Literal["onnx", "torch"]
LoggerName = Literal["tensorboard", "wandb"]
Weight = Annotated[float, Field(ge=0, le=1e6)]
Latency = Annotated[float, Field(ge=0, le=60_000)]
Share = Annotated[float, Field(ge=0, lt=1)]


class SplitParams(Section):
    """Which groups of episodes train the policy, choose the checkpoint and are reported on.

    Episodes of one group are always on one side. Episodes form a group if they are one recording in
    several formats or encoded again, or if the recordings or `groups` say so.
    """

    seed: Seed = 0
    """Seed of the split."""
    val: Share = 0.15
    """Share of groups that choose the checkpoint and stop early."""
    test: Share = 0.15
    """Share of groups that `stages.evaluate` reports on; no choice is ever made with them."""
    train: int | None = Field(default=None, ge=1, le=10**9)
    """Train on at most this many groups, drawn by the same hash, and leave the others out; shows
    how much more recordings would help."""
    folds: int | None = Field(default=None, ge=2, le=1_000_000)
    """Deal the groups into this many folds. One fold is the test side, and `test` is ignored. With
    little data, train once per fold."""
    fold: int = Field(default=0, ge=0, le=1_000_000)
    """Index of the fold that is the test side, from 0."""
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    """Episodes that belong together, such as those of one object or one day: for each group name,
    patterns of `<source>/<id>`, such as `{monday: ["demo/2024-05-06*"]}`."""

    @model_validator(mode="after")
    def _leaves_training_episodes(self) -> "SplitParams":
        test = self.test if self.folds is None else 1 / self.folds
        if self.val + test >= 1:
            raise ValueError(
                f"val {self.val:g} and test {test:g} leave nothing to train on; they must add up "
                "to less than 1"
            )
        if self.fold >= (self.folds or 1):
            raise ValueError(
                f"fold {self.fold} of folds {self.folds}: expected a fold from 0 that is smaller "
                "than folds; without folds, 0"
            )
        return self


class TrainHeadParams(Section):
    """What is trained from the store, and how."""

    model_type: ModelType = "regression"
    """The action expert."""
    fusion_strategy: FusionStrategy = "concat"
    """How the encoded streams become the expert's context."""
    features_enabled: bool = True
    """Whether the policy sees the model's features."""
    sensor_enabled: bool = True
    """Whether the policy sees the sensor."""
    robot_state_enabled: bool = True
    """Whether the policy sees the robot's state."""
    sensor_encoder: SensorEncoderParams = SensorEncoderParams()
    state_encoder: StateEncoderParams = StateEncoderParams()
    expert: ExpertParams = ExpertParams()
    regression: RegressionParams = RegressionParams()
    diffusion: DiffusionParams = DiffusionParams()
    flow_matching: FlowMatchingParams = FlowMatchingParams()
    drop_features: Fraction = 0.0
    """Share of training samples without features, so that the policy learns to use the rest too."""
    drop_sensor: Fraction = 0.0
    """Share of training samples without the sensor."""
    drop_state: Fraction = 0.0
    """Share of training samples without the robot's state."""
    horizon: int = Field(default=8, ge=1, le=1000)
    """Ticks per action chunk."""
    sensor_window: int = Field(default=65, ge=1, le=20_000)
    """Most readings of the sensor before the tick, and the steps that the encoder makes of them."""
    sensor_window_s: float | None = Field(default=0.1, gt=0, le=3600)
    """Seconds before the tick that the sensor's window covers, at any rate of a recording. null
    uses readings of any age, and only their order, not their times."""
    state_window: int = Field(default=100, ge=1, le=20_000)
    """Like `sensor_window`, for the robot's state."""
    state_window_s: float | None = Field(default=1.0, gt=0, le=3600)
    """Like `sensor_window_s`, for the robot's state."""
    feature_lag: int = Field(default=0, ge=0, le=1000)
    """Most VL rows that features are late in training, drawn uniformly for each sample, so that a
    policy learns to work with a slow model."""
    anchor: Literal["auto"] | tuple[str, ...] = "auto"
    """Action channels that count from the arm's position at the time of the newest frame, such as
    `[dx, dy]`, so that what vision shows stays true when the model is late. They must be deltas
    whose motion is in the state. `auto` uses the translations among them; with a sensor, not
    those that always advance in one direction in the training episodes, because the sensor sees
    how far. none: no channel."""
    anchor_s: float = Field(default=2.0, gt=0, le=3600)
    """Most seconds that the motion since a frame is known; an older frame counts as this old."""
    sensor_lag_s: float = Field(default=0.0, ge=0, le=3600)
    """Most seconds that the sensor is late in training, drawn in the same way; its window then
    reaches back by so much more."""
    terminal_stop: bool = False
    """After an episode's end, train the policy to stand still (zero deltas and velocities, the last
    absolute action). Otherwise those steps of the chunk are left out of the loss."""
    batch_size: int = Field(default=64, ge=1, le=2**16)
    """Ticks per step, over all accumulated parts and all processes."""
    grad_accumulation: int = Field(default=1, ge=1, le=2**16)
    """Parts of a step's ticks that each process computes one after the other."""
    max_steps: int = Field(default=500, ge=1, le=10**9)
    """Steps of the run; the learning rate's decay ends there."""
    lr_schedule: Literal["cosine", "trapezoid", "constant"] = "cosine"
    """After the warm-up: half a cosine to the floor; flat, then linear to it; or flat."""
    decay_fraction: Fraction = 0.2
    """For `trapezoid`: share of all steps that its final decay takes."""
    warmup_steps: int = Field(default=100, ge=0, le=10**9)
    """Steps of linear warm-up."""
    lr: float = Field(default=5e-4, gt=0, le=1e3)
    """Peak learning rate of AdamW."""
    sensor_lr: float | None = Field(default=None, gt=0, le=1e3)
    """Peak learning rate of the sensor encoder; null: `lr`."""
    min_lr_fraction: Fraction = 0.05
    """Learning rate at the end of the decay, as a share of the peak."""
    weight_decay: float = Field(default=0.01, ge=0, le=1e3)
    """Weight decay of matrices; norms, biases and embeddings have none."""
    grad_clip: float = Field(default=1.0, gt=0, le=1e9)
    """Largest norm of the gradient."""
    ema_decay: float = Field(default=0.995, ge=0, lt=1)
    """Decay of the moving average of weights, which is evaluated and kept."""
    amp: Literal["auto", "off", "bfloat16"] = "auto"
    """bfloat16 autocast; `auto` uses it if a CUDA device supports it."""
    compile: bool = False
    """Compile the policy with torch.compile: slow to start, then faster steps."""
    group_weights: dict[Literal["translation", "rotation", "gripper", "other"], Weight] = Field(
        default_factory=dict
    )
    """Weight of each action group in the loss; 1 if not named."""
    split: SplitParams = SplitParams()
    mixture: dict[str, Weight] = Field(default_factory=dict)
    """Weight of each tick of a source; 1 if not named.

    A source's share of the draws is its weight times its ticks: with weight 3 each of its ticks is
    drawn three times as often. (The weights of `create_unified_dataloader` are shares instead, at
    any size.)
    """
    eval_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between evaluations on the ticks of val."""
    eval_samples: int = Field(default=1, ge=1, le=1000)
    """Chunks sampled per tick; the error of one chunk is averaged over them. Experts that do not
    sample give one."""
    early_stopping: int | None = Field(default=None, ge=1, le=10**9)
    """Stop after this many evaluations in a row without a better one; null never stops early."""
    checkpoint_every: int = Field(default=200, ge=1, le=10**9)
    """Steps between checkpoints."""
    seed: Seed = 0
    """Seed of weights, order and dropout."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    feed: Literal["auto", "mapped", "device"] = "auto"
    """How batches are made. mapped: gathered from the mapped store. device: gathered on the device,
    which holds the streams that fit. `auto` chooses and prints why."""
    check_store: bool = True
    """Read the whole store once before training or tuning, and refuse a chunk that does not give
    its checksum; false skips this, where it takes too long."""
    anew: bool = False
    """Train again if this same run is already finished; a stopped run continues. `dvc repro` sets
    it, because DVC also runs the stage after a code change."""
    store: Place | None = None
    """The store to train from; null: `extract.store`. DVC does not watch another store."""
    output: Output = Path("models/head")
    """Folder of the best and the last checkpoint."""
    logs: Output = Path("reports/train_head")
    """Folder of the curves."""
    loggers: tuple[LoggerName, ...] = ()
    """Tools that show the curves during training, besides the files that DVC plots. tensorboard:
    event files in `<logs>.tensorboard`. wandb: Weights & Biases."""
    wandb_project: str = "vla-feature-cache"
    """Project of the run in Weights & Biases; its own environment variables decide the rest."""

    @field_validator("anchor", mode="before")
    @classmethod
    def _no_anchor(cls, value: Any) -> Any:
        return () if value == "none" else value

    @model_validator(mode="after")
    def _anchor_has_what_it_needs(self) -> "TrainHeadParams":
        if self.anchor not in ("auto", ()) and not self.anchored:
            raise ValueError(
                "anchor counts from the newest frame by the state's motion: enable features and "
                "robot state, or set anchor to none"
            )
        return self

    @property
    def anchored(self) -> bool:
        """Whether channels may be anchored; the policy's shape says which ones `auto` means."""
        return self.anchor != () and self.features_enabled and self.robot_state_enabled

    @property
    def sensor_reach_s(self) -> float | None:
        """Age in s of the oldest reading that the sensor's encoder sees; None: any age."""
        return None if self.sensor_window_s is None else self.sensor_window_s + self.sensor_lag_s

    @property
    def state_reach_s(self) -> float | None:
        """Age in s of the oldest state reading that the policy sees; None: any age."""
        if self.state_window_s is None or not self.anchored:
            return self.state_window_s
        return max(self.state_window_s, self.anchor_s)

    def trained_age_s(self, reuse_s: float) -> float:
        """The oldest age in s of features in training, if the ticks of each row last `reuse_s`."""
        return reuse_s * (1 + self.feature_lag)

    @property
    def state_readings(self) -> int:
        """Most state readings before the tick, at the density of `state_window`."""
        if self.state_window_s is None or self.state_reach_s is None:
            return self.state_window
        return math.ceil(self.state_window * self.state_reach_s / self.state_window_s)


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
    """Also evaluate with each stream zeroed, shuffled across episodes and delayed."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    store: Place | None = None
    """The store to evaluate on; null: `train_head.store`, or else `extract.store`."""
    check_store: bool = True
    """Read the whole store once before the evaluation, and refuse a chunk that does not give its
    checksum; false skips this, where it takes too long."""


def latencies_ms(given: float | Sequence[float]) -> tuple[float, ...]:
    """Each latency of `rollout.latency_ms` once, in the given order."""
    return tuple(dict.fromkeys(given if isinstance(given, Sequence) else (given,)))


class RolloutParams(Section):
    """How a policy runs in closed loop in the simulation, and where the report is written."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    environment: Literal["phantom"] | None = "phantom"
    """The simulated needle insertion of the demo. null runs no rollout, for recordings of another
    robot; the stage then only says so."""
    level: Level = "full"
    """depth: the needle begins above the target, so that the sensor is enough. full: it begins
    anywhere. moved: like full, and target and tissue are pushed during the insertion."""
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
    head: Place | None = None
    """Folder of `stages.export`; its head.onnx replaces the checkpoint's own head."""
    ablations: tuple[RolloutAblation, ...] = ("sensor off", "features off")
    """Also run the policy with one stream disturbed. off: every value is its training mean. frozen:
    the stream stays as it was first, as if it were new. Streams that the policy does not use are
    skipped, and so is `off` for its only stream. []: none."""
    server: str | None = None
    """Address of a running `stages.serve`, such as ws://127.0.0.1:8000; its policy is run over the
    network in place of `checkpoint`. If it needs a token, set the environment variable
    VLA_SERVE_TOKEN."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    output: Output = Path("reports/rollout")
    """Folder of metrics, table and page."""

    @model_validator(mode="after")
    def _one_answers(self) -> "RolloutParams":
        if self.head is not None and self.server is not None:
            raise ValueError("head and server: either an exported head answers or a server does")
        if self.head is not None and self.chunking == "rtc":
            raise ValueError("head: an exported head cannot be guided: set chunking to temporal")
        return self


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
    """Most robots at a time."""
    max_waiting: int = Field(default=8, ge=1, le=10_000)
    """Most observations that are being answered or wait; one more is refused as busy."""
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

    robot: str = "pipeline.simulation.realtime:SimulatedRobot"
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


class ExportParams(Section):
    """Which policy's head is exported for other runtimes, and in which formats."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    output: Output = Path("models/export")
    """Folder of the files and their receipt."""
    formats: tuple[ExportFormat, ...] = Field(default=("onnx", "torch"), min_length=1)
    """onnx: `head.onnx`, for ONNX Runtime. torch: `head.pt2`, for `torch.export.load`."""
    opset: int = Field(default=20, ge=18, le=100)
    """ONNX operator set version."""


class CompareParams(Section):
    """Which evaluations are compared in one table."""

    reports: Place = Path("reports/experiments")
    """Folder of evaluation folders, each named after its experiment."""
    output: Output = Path("reports/comparison")
    """Folder of the table and the picture."""


class TuningParams(Section):
    """Which weights of the vision-language model learn; with the seeds' LoRA defaults."""

    method: Literal["none", "lora", "full"] = "lora"
    """none: nothing learns. lora: low-rank adapters (Hu et al. 2021). full: every weight."""
    lora_r: int = Field(default=16, ge=1, le=4096)
    """Rank of an adapter."""
    lora_alpha: int = Field(default=32, ge=1, le=1_000_000)
    """An adapter's update is scaled by alpha / r."""
    lora_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Dropout before an adapter, during training."""
    towers: tuple[Literal["language", "vision"], ...] = Field(
        default=("language", "vision"), min_length=1
    )
    """Which of the model's two towers learn."""
    gradient_checkpointing: bool = True
    """Recompute activations in the backward pass: about a third more time, far less memory."""


class FinetuneParams(Section):
    """How the model is tuned end to end; the policy on top is that of `train_head`.

    A key here replaces the same key of `train_head`. Ticks, streams, split and normalisation come
    from the store, frames from the recordings.
    """

    tuning: TuningParams = TuningParams()
    lr: float = Field(default=1e-4, gt=0, le=1e3)
    """Peak learning rate of the vision-language model; the policy has `train_head.lr`."""
    batch_size: int = Field(default=16, ge=1, le=2**16)
    """Ticks per step."""
    grad_accumulation: int = Field(default=1, ge=1, le=2**16)
    """Parts into which a step's ticks are split; they are computed one after the other."""
    max_steps: int = Field(default=200, ge=1, le=10**9)
    """Steps of the run."""
    warmup_steps: int = Field(default=20, ge=0, le=10**9)
    """Steps of linear warm-up."""
    eval_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between evaluations on the ticks of val."""
    eval_ticks: int = Field(default=100, ge=1, le=1_000_000)
    """Most val ticks per evaluation; each costs a pass through the whole model."""
    checkpoint_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between checkpoints."""
    decode_threads: int = Field(default=2, ge=1, le=256)
    """Threads that decode and resize while the model works."""
    output: Output = Path("models/finetune")
    """Folder of the best and the last checkpoint; the adapter is `best/adapter`."""
    logs: Output = Path("reports/finetune")
    """Folder of the curves."""
