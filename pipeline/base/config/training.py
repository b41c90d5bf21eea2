"""Sections for training a policy, its parts, and tuning of the vision-language model itself."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.base.config.section import Fraction, Output, Place, Section, Seed

ModelType = Literal["regression", "diffusion", "flow_matching"]
FusionStrategy = Literal["concat", "cross_attention", "gated", "none"]
LoggerName = Literal["tensorboard", "wandb"]
Weight = Annotated[float, Field(ge=0, le=1e6)]
Share = Annotated[float, Field(ge=0, lt=1)]


class FeatureEncoderParams(Section):
    """How the slots of a VL row become the policy's tokens."""

    kind: Literal["linear", "mean", "pooler"] = "linear"
    """linear: a token for each slot, by one projection. mean: a token for each layer, the mean of
    its slots. pooler: `queries` tokens that attend to all slots; its size does not depend on the
    number of slots."""
    queries: int = Field(default=8, ge=1, le=1024)
    """For `pooler`: learned queries, each of which gives a token."""
    dim: int = Field(default=128, ge=1, le=8192)
    """For `pooler`: width of queries and slots."""
    layers: int = Field(default=1, ge=1, le=16)
    """For `pooler`: transformer layers of the queries, each with attention to the slots."""
    heads: int = Field(default=4, ge=1, le=256)
    """For `pooler`: must divide `dim`."""
    state: bool = True
    """For `pooler`: the robot's state moves the queries, through a gate that is 0 at first, so that
    it directs where they look and never becomes what they find."""


class SensorEncoderParams(Section):
    """Sizes of the sensor encoder; its parameters are counted when training begins."""

    kind: Literal["joint", "force_aware"] = "joint"
    """joint: one branch for all channels. force_aware: force has its own and is not lost."""
    channels: tuple[Annotated[int, Field(ge=1, le=8192)], ...] = Field(
        default=(64, 128, 128, 128), min_length=1, max_length=16
    )
    """Width of each residual convolution block; every block halves the length."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers after the convolutions."""
    heads: int = Field(default=4, ge=1, le=256)
    """Attention heads; must divide the last of `channels`."""
    output_dim: int = Field(default=128, ge=1, le=8192)
    """Width of the encoded window."""


class StateEncoderParams(Section):
    """Sizes of the robot-state encoder."""

    dim: int = Field(default=64, ge=1, le=8192)
    """Width of its transformer."""
    layers: int = Field(default=1, ge=0, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    output_dim: int = Field(default=64, ge=1, le=8192)
    """Width of the encoded window."""
    patch: int = Field(default=10, ge=1, le=10_000)
    """Readings per token."""


class ExpertParams(Section):
    """Sizes of the action expert, of any kind."""

    dim: int = Field(default=128, ge=1, le=8192)
    """Width of its transformer and of its context."""
    layers: int = Field(default=2, ge=1, le=128)
    """Transformer layers."""
    heads: int = Field(default=4, ge=1, le=256)
    """Must divide `dim`."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Dropout during training."""


class DiffusionParams(Section):
    """Params of the diffusion expert only."""

    draws: int = Field(default=3, ge=1, le=1000)
    """Draws of noise and schedule step per chunk in a training step. The context, which costs most,
    is computed once for all of them."""
    timesteps: int = Field(default=100, ge=2, le=10_000)
    """Steps of the noise schedule."""
    prediction: Literal["epsilon", "sample", "v"] = "sample"
    """What the network predicts: the noise, the clean chunk, or the velocity between them."""
    sampler: Literal["ddpm", "ddim"] = "ddim"
    """`ddpm` takes every step of the schedule, `ddim` takes `sampling_steps`."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Steps of `ddim`; at most `timesteps`."""
    eta: float = Field(default=0.0, ge=0, le=1)
    """Randomness of `ddim`: 0 is deterministic after the first noise, 1 is as random as `ddpm`."""
    clip: float | None = Field(default=5.0, gt=0, le=1e6)
    """The clean chunk is clipped to this many standard deviations in every sampling step."""

    @model_validator(mode="after")
    def _steps_are_of_the_schedule(self) -> "DiffusionParams":
        if self.sampler == "ddim" and self.sampling_steps > self.timesteps:
            raise ValueError(
                f"sampling_steps {self.sampling_steps} is above timesteps {self.timesteps}"
            )
        return self


class FlowMatchingParams(Section):
    """Params of the flow-matching expert only."""

    draws: int = Field(default=3, ge=1, le=1000)
    """Draws of noise and time per chunk in a training step, as in `diffusion.draws`."""
    sampling_steps: int = Field(default=4, ge=1, le=10_000)
    """Steps of the ODE solver."""
    solver: Literal["euler", "rk4"] = "euler"
    """ODE solver: one or four evaluations of the network per step."""


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
    feature_encoder: FeatureEncoderParams = FeatureEncoderParams()
    sensor_encoder: SensorEncoderParams = SensorEncoderParams()
    state_encoder: StateEncoderParams = StateEncoderParams()
    expert: ExpertParams = ExpertParams()
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
    feature_history: int = Field(default=1, ge=1, le=64)
    """VL rows that the policy sees, the newest and those before it in the episode; the first one
    stands for those before it."""
    anchor: Literal["auto"] | tuple[str, ...] = "auto"
    """Action channels that count from the arm's position at the time of the newest frame, such as
    `[dx, dy]`, so that what vision shows stays true when the model is late. They must be deltas
    whose motion is in the state. `auto` uses the translations among them; with a sensor, not
    those that always advance in one direction in the training episodes, because the sensor sees
    how far. none: no channel."""
    action_form: Literal["recorded", "relative"] = "recorded"
    """relative: absolute actions that the state measures too (`joint_1`, `x` or `pose_x`, in the
    same unit) are learned as differences from the state at the tick, with statistics of their own,
    all but the angles of a pose. The store and the policy's answers stay absolute. Every episode
    needs a state."""
    anchor_s: float = Field(default=2.0, gt=0, le=3600)
    """Most seconds that the motion since a frame is known; an older frame counts as this old."""
    sensor_lag_s: float = Field(default=0.0, ge=0, le=3600)
    """Most seconds that the sensor is late in training, drawn in the same way; its window then
    reaches back by so much more."""
    batch_size: int = Field(default=64, ge=1, le=2**16)
    """Ticks per step, over all accumulated parts."""
    grad_accumulation: int = Field(default=1, ge=1, le=2**16)
    """Parts of a step's ticks that are computed one after the other."""
    max_steps: int = Field(default=500, ge=1, le=10**9)
    """Steps of the run, over which the learning rate falls along half a cosine."""
    warmup_steps: int = Field(default=100, ge=0, le=10**9)
    """Steps of linear warm-up."""
    lr: float = Field(default=5e-4, gt=0, le=1e3)
    """Peak learning rate of AdamW."""
    min_lr_fraction: Fraction = 0.05
    """Learning rate at the last step, as a share of the peak; 1 keeps the peak."""
    weight_decay: float = Field(default=0.01, ge=0, le=1e3)
    """Weight decay of matrices; norms, biases and embeddings have none."""
    grad_clip: float = Field(default=1.0, gt=0, le=1e9)
    """Largest norm of the gradient."""
    ema_decay: float = Field(default=0.995, ge=0, lt=1)
    """Decay of the moving average of weights, which is evaluated and kept."""
    amp: Literal["auto", "off", "bfloat16"] = "auto"
    """bfloat16 autocast; `auto` uses it if a CUDA device supports it."""
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
    early_stopping: int | None = Field(default=None, ge=1, le=10**9)
    """Stop after this many evaluations in a row without a better one; null never stops early."""
    checkpoint_every: int = Field(default=200, ge=1, le=10**9)
    """Steps between checkpoints."""
    keep_every: int | None = Field(default=None, ge=1, le=10**9)
    """Steps between checkpoints that stay, in `<output>/steps/STEP`, for a choice by rollouts; null
    keeps the best and the last alone. It does nothing to a finished run, and not in fine-tuning."""
    seed: Seed = 0
    """Seed of weights, order and dropout."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
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
    event files in `<logs>.tensorboard`. wandb: Weights & Biases, whose own environment variables,
    such as WANDB_PROJECT, decide the rest."""

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

    @model_validator(mode="after")
    def _relative_to_a_state(self) -> "TrainHeadParams":
        if self.action_form == "relative" and not self.robot_state_enabled:
            raise ValueError(
                "action_form relative counts from the robot's state: enable it, or set recorded"
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
