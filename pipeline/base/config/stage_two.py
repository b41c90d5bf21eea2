"""Sections of training, of tuning the vision-language model itself, and of evaluation."""

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
    """Which groups of episodes are trained on, choose the checkpoint and are reported.

    Episodes of one group are never apart: one recording in several formats or encoded again, or
    what the recordings or `groups` say.
    """

    seed: Seed = 0
    """Another one draws other sides."""
    val: Share = 0.15
    """Share of groups that choose the checkpoint and stop early."""
    test: Share = 0.15
    """Share of groups that `stages.evaluate` reports on; nothing is ever chosen on them."""
    train: int | None = Field(default=None, ge=1, le=10**9)
    """Train on at most so many groups, drawn by the same hash, and leave the others out: what would
    more recordings bring?"""
    folds: int | None = Field(default=None, ge=2, le=1_000_000)
    """Deal the groups into as many folds, of which one is test, whatever `test` says: with little
    data, train once a fold."""
    fold: int = Field(default=0, ge=0, le=1_000_000)
    """Which of the folds is test, from 0."""
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    """Episodes that belong together, as of one object or one day: patterns of `<source>/<id>` by
    the name of the group, such as `{monday: ["demo/2024-05-06*"]}`."""

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
    """Whether the policy feels the sensor."""
    robot_state_enabled: bool = True
    """Whether the policy knows the robot's state."""
    sensor_encoder: SensorEncoderParams = SensorEncoderParams()
    state_encoder: StateEncoderParams = StateEncoderParams()
    expert: ExpertParams = ExpertParams()
    regression: RegressionParams = RegressionParams()
    diffusion: DiffusionParams = DiffusionParams()
    flow_matching: FlowMatchingParams = FlowMatchingParams()
    drop_features: Fraction = 0.0
    """Share of training samples that see no features, so that a policy leans on the rest too."""
    drop_sensor: Fraction = 0.0
    """Share of training samples without the sensor."""
    drop_state: Fraction = 0.0
    """Share of training samples without the robot's state."""
    horizon: int = Field(default=8, ge=1, le=1000)
    """Ticks an action chunk."""
    sensor_window: int = Field(default=65, ge=1, le=20_000)
    """Most readings of the sensor before the tick, and the steps that the encoder makes of them."""
    sensor_window_s: float | None = Field(default=0.1, gt=0, le=3600)
    """Seconds before the tick that the sensor's window covers, whatever the rate of a recording.
    null takes readings of any age, and their order for their time."""
    state_window: int = Field(default=100, ge=1, le=20_000)
    """As `sensor_window`, of the robot's state."""
    state_window_s: float | None = Field(default=1.0, gt=0, le=3600)
    """As `sensor_window_s`, of the robot's state."""
    feature_lag: int = Field(default=0, ge=0, le=1000)
    """Most VL rows that features come late in training, drawn evenly for each sample: so a policy
    learns what a slow model does to it."""
    anchor: Literal["auto"] | tuple[str, ...] = "auto"
    """Action channels that count from where the arm was when the newest frame was taken, such as
    `[dx, dy]`: what vision tells stays true when the model is late. They are deltas whose motion
    the state tells. `auto` takes the translations among them; with a sensor, not those in which the
    training episodes advance one way, because the sensor sees how far. none: no channel."""
    anchor_s: float = Field(default=2.0, gt=0, le=3600)
    """Seconds back that the motion since a frame is known; a frame that is older counts as so old.
    """
    sensor_lag_s: float = Field(default=0.0, ge=0, le=3600)
    """Most seconds that the sensor comes late in training, likewise; its window then reaches back
    as much further."""
    terminal_stop: bool = False
    """Beyond an episode's end, train to stand still (zero deltas and velocities, the last absolute
    action) instead of leaving those steps of the chunk out of the loss."""
    batch_size: int = Field(default=64, ge=1, le=2**16)
    """Ticks a step, over all accumulated parts and all processes."""
    grad_accumulation: int = Field(default=1, ge=1, le=2**16)
    """Parts that a step's ticks are computed in on each process, one after the other."""
    max_steps: int = Field(default=500, ge=1, le=10**9)
    """Steps of the run; the learning rate's decay ends there."""
    lr_schedule: Literal["cosine", "trapezoid", "constant"] = "cosine"
    """After the warm-up: half a cosine to the floor, flat and then linear to it, or flat."""
    decay_fraction: Fraction = 0.2
    """Of `trapezoid`: the share of all steps that its final decay takes."""
    warmup_steps: int = Field(default=100, ge=0, le=10**9)
    """Steps of linear warm-up."""
    lr: float = Field(default=5e-4, gt=0, le=1e3)
    """Peak learning rate of AdamW."""
    sensor_lr: float | None = Field(default=None, gt=0, le=1e3)
    """Peak learning rate of the sensor encoder; `lr` where null."""
    min_lr_fraction: Fraction = 0.05
    """Of the peak, at the end of the decay."""
    weight_decay: float = Field(default=0.01, ge=0, le=1e3)
    """On matrices; norms, biases and embeddings are not decayed."""
    grad_clip: float = Field(default=1.0, gt=0, le=1e9)
    """Largest norm of the gradient."""
    ema_decay: float = Field(default=0.995, ge=0, lt=1)
    """Of the average of weights that is evaluated and kept."""
    amp: Literal["auto", "off", "bfloat16"] = "auto"
    """bfloat16 autocast; `auto` where a CUDA device has it."""
    compile: bool = False
    """Compile the policy with torch.compile: slow to begin, faster steps."""
    group_weights: dict[Literal["translation", "rotation", "gripper", "other"], Weight] = Field(
        default_factory=dict
    )
    """Weight of each action group in the loss, 1 where not named."""
    split: SplitParams = SplitParams()
    mixture: dict[str, Weight] = Field(default_factory=dict)
    """Weight of each tick of a source; 1 where not named.

    A source's share of the draws is its weight times its ticks: weight 3 shows one of its ticks
    three times as often. (The weights of `create_unified_dataloader` are shares, whatever the
    sizes.)
    """
    eval_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between evaluations on the ticks of val."""
    eval_samples: int = Field(default=4, ge=1, le=1000)
    """Chunks sampled a tick, over which the error of one is averaged; experts that do not sample
    give one."""
    early_stopping: int | None = Field(default=None, ge=1, le=10**9)
    """Stop after this many evaluations in a row without a better one; null never stops early."""
    checkpoint_every: int = Field(default=200, ge=1, le=10**9)
    """Steps between checkpoints."""
    seed: Seed = 0
    """Of weights, order and dropout."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    feed: Literal["auto", "mapped", "device"] = "auto"
    """How batches are made: gathered from the mapped store, or on the device, which holds the
    streams that fit. `auto` picks and says why."""
    check_store: bool = True
    """Read the store once before training or tuning, and refuse a chunk that does not give its
    checksum; false where that takes too long."""
    anew: bool = False
    """Train again where this very run is finished; one that was stopped goes on. `dvc repro` sets
    it: DVC runs the stage where code has changed, too."""
    store: Place | None = None
    """The store to train from; `extract.store` where null. Another one DVC does not watch."""
    output: Output = Path("models/head")
    """Folder of the best and the last checkpoint."""
    logs: Output = Path("reports/train_head")
    """Folder of the curves."""
    loggers: tuple[LoggerName, ...] = ()
    """Who shows the curves while it trains, beside the files that DVC plots: `tensorboard` event
    files in `<logs>.tensorboard`, `wandb` Weights & Biases."""
    wandb_project: str = "vla-feature-cache"
    """Where Weights & Biases puts the run; its own environment variables decide the rest."""

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
        """Whether channels may be anchored; which ones `auto` means, the policy's shape says."""
        return self.anchor != () and self.features_enabled and self.robot_state_enabled

    @property
    def sensor_reach_s(self) -> float | None:
        """Seconds before the tick of the oldest reading that the sensor's encoder looks at."""
        return None if self.sensor_window_s is None else self.sensor_window_s + self.sensor_lag_s

    @property
    def state_reach_s(self) -> float | None:
        """Seconds before the tick of the oldest state that is looked at."""
        if self.state_window_s is None or not self.anchored:
            return self.state_window_s
        return max(self.state_window_s, self.anchor_s)

    def trained_age_s(self, reuse_s: float) -> float:
        """The oldest age of features in training, where each row serves ticks for `reuse_s`."""
        return reuse_s * (1 + self.feature_lag)

    @property
    def state_readings(self) -> int:
        """Most readings of the state before the tick, as dense as those of `state_window`."""
        if self.state_window_s is None or self.state_reach_s is None:
            return self.state_window
        return math.ceil(self.state_window * self.state_reach_s / self.state_window_s)


class EvaluateParams(Section):
    """Which policy is judged, and where the report goes."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null. Another one
    DVC does not watch."""
    output: Output = Path("reports/evaluate")
    """Folder of metrics, tables and pictures."""
    batch_size: int = Field(default=64, ge=1, le=2**16)
    """Ticks a forward pass."""
    samples: int = Field(default=16, ge=1, le=1000)
    """Chunks sampled a tick: the error is that of one, averaged over them for less noise; the error
    of their mean, of the best of them and the energy score stand beside it. Experts that do not
    sample give one."""
    execute: int = Field(default=1, ge=1, le=1000)
    """Steps of a chunk that the robot carries out before it asks for the next: their error stands
    first."""
    modalities: bool = True
    """Also judge with each stream zeroed, shuffled across episodes and delayed."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    store: Place | None = None
    """The store to evaluate on; `train_head.store`, else `extract.store`, where null."""
    check_store: bool = True
    """Read the store once before the evaluation, and refuse a chunk that does not give its
    checksum; false where that takes too long."""


def latencies_ms(given: float | Sequence[float]) -> tuple[float, ...]:
    """Each latency of `rollout.latency_ms` once, in the order given."""
    return tuple(dict.fromkeys(given if isinstance(given, Sequence) else (given,)))


class RolloutParams(Section):
    """How a policy runs closed loop in the simulation, and where the report goes."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    environment: Literal["phantom"] | None = "phantom"
    """The simulated needle insertion of the demo. null rolls nothing out, which suits recordings of
    another robot: the stage then only says so."""
    level: Level = "full"
    """depth: the needle begins above the target, so that the sensor suffices. full: it begins
    anywhere. moved: besides, target and tissue are pushed meanwhile."""
    episodes: int = Field(default=50, ge=1, le=1_000_000)
    """Episodes of each controller."""
    seed: int = Field(default=1_000_000, ge=0, lt=2**53)
    """Of the first episode; those that follow have the seeds that follow."""
    execute: int = Field(default=1, ge=1, le=1000)
    """Steps of a chunk that are carried out before the head is asked for the next."""
    chunking: Chunking = "temporal"
    """none: the newest chunk. temporal: the weighted mean of all chunks that reach the tick
    (temporal ensembling). rtc: each chunk is drawn to continue the last (real-time chunking), for
    experts that sample."""
    latency_ms: Latency | Annotated[tuple[Latency, ...], Field(min_length=1)] = 0.0
    """What a pass of the model takes, in simulated time: its features are so much older. The head
    answers at once. Of several, such as `[0, 300, 600]`, the page draws success against latency;
    the first is that of all else."""
    head: Place | None = None
    """Folder of `stages.export`, whose head.onnx answers in place of the checkpoint's own head."""
    ablations: tuple[RolloutAblation, ...] = ("sensor off", "features off")
    """Also run the policy with a stream spoilt. off: every value at its training mean. frozen: all
    as the stream was first, as if it were new. What a policy does not look at is passed over, and
    so is `off` of the only stream that it looks at. [] for none."""
    server: str | None = None
    """The address of a running `stages.serve`, such as ws://127.0.0.1:8000, whose policy is rolled
    out over the wire in place of `checkpoint`; its token, if it asks for one, is in the environment
    as VLA_SERVE_TOKEN."""
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
    """Address to listen on. Any but this machine's own (127.0.0.1, ::1) needs a token."""
    port: int = Field(default=8000, ge=0, le=65535)
    """0 picks a free one and prints it."""
    token_file: Place | None = None
    """File with the token that robots must send; the environment variable VLA_SERVE_TOKEN where
    null, and no token where that is not set either."""
    fresh: bool = True
    """A chunk waits for the features of the frames that came with its observation. false: it takes
    the newest there are, and the model looks meanwhile."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    seed: Seed = 0
    """Of what a policy draws for a robot that sends no seed."""
    max_connections: int = Field(default=8, ge=1, le=10_000)
    """Robots at a time."""
    max_waiting: int = Field(default=8, ge=1, le=10_000)
    """Observations that are answered or wait at a time; who sends one more is told: busy."""
    max_message_mb: int = Field(default=64, ge=1, le=1024)
    """Of one observation, in MiB."""
    idle_s: float = Field(default=600.0, gt=0, le=1e6)
    """A connection without a whole message for so long is closed."""
    transform: Literal["aloha", "droid", "libero"] | None = None
    """Take observations by the names that openpi's clients of this robot give. Their images are
    the policy's views in this order. aloha: `images/cam_high`, `cam_left_wrist`,
    `cam_right_wrist`, `cam_low`; `state`. droid: `observation/exterior_image_1_left`,
    `wrist_image_left`; the state is `joint_position` and `gripper_position`. libero:
    `observation/image`, `wrist_image`; `observation/state`."""
    log: Literal["text", "json"] = "text"
    """How the line of each connection, episode, slow answer, warning and refusal is written."""


class ExportParams(Section):
    """Which policy's head is written for other runtimes, and as what."""

    checkpoint: Place | None = None
    """A training run's folder, or one checkpoint in it; `train_head.output` where null."""
    output: Output = Path("models/export")
    """Folder of the files and their receipt."""
    formats: tuple[ExportFormat, ...] = Field(default=("onnx", "torch"), min_length=1)
    """onnx: `head.onnx`, for ONNX Runtime. torch: `head.pt2`, for `torch.export.load`."""
    opset: int = Field(default=20, ge=18, le=100)
    """Version of ONNX's operators."""


class CompareParams(Section):
    """Which evaluations stand side by side in one table."""

    reports: Place = Path("reports/experiments")
    """Folder of evaluation folders, each named after its experiment."""
    output: Output = Path("reports/comparison")
    """Folder of the table and the picture."""


class TuningParams(Section):
    """What of the vision-language model learns; the seeds' LoRA defaults."""

    method: Literal["none", "lora", "full"] = "lora"
    """Nothing, low-rank adapters (Hu et al. 2021), or every weight."""
    lora_r: int = Field(default=16, ge=1, le=4096)
    """Rank of an adapter."""
    lora_alpha: int = Field(default=32, ge=1, le=1_000_000)
    """An adapter's update is scaled by alpha / r."""
    lora_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.05
    """Before an adapter, while training."""
    towers: tuple[Literal["language", "vision"], ...] = Field(
        default=("language", "vision"), min_length=1
    )
    """Which of the model's two towers learn."""
    gradient_checkpointing: bool = True
    """Recompute activations in the backward pass: about a third more time, far less memory."""


class FinetuneParams(Section):
    """How the model is tuned end to end; the policy on top is that of `train_head`.

    What stands here replaces the same key of `train_head`; ticks, streams, split and normalisation
    come from the store, frames from the recordings.
    """

    tuning: TuningParams = TuningParams()
    lr: float = Field(default=1e-4, gt=0, le=1e3)
    """Peak learning rate of the vision-language model; the policy has `train_head.lr`."""
    batch_size: int = Field(default=16, ge=1, le=2**16)
    """Ticks a step."""
    grad_accumulation: int = Field(default=1, ge=1, le=2**16)
    """Parts that a step's ticks are computed in, one after the other."""
    max_steps: int = Field(default=200, ge=1, le=10**9)
    """Steps of the run."""
    warmup_steps: int = Field(default=20, ge=0, le=10**9)
    """Steps of linear warm-up."""
    eval_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between evaluations on the ticks of val."""
    eval_ticks: int = Field(default=100, ge=1, le=1_000_000)
    """Ticks of val judged in them at most: each costs a pass through the whole model."""
    checkpoint_every: int = Field(default=50, ge=1, le=10**9)
    """Steps between checkpoints."""
    decode_threads: int = Field(default=2, ge=1, le=256)
    """Threads that decode and resize while the model works."""
    output: Output = Path("models/finetune")
    """Folder of the best and the last checkpoint; the adapter is `best/adapter`."""
    logs: Output = Path("reports/finetune")
    """Folder of the curves."""
