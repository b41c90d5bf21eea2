"""Section of tuning the vision-language model itself."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipeline.base.config.section import Section


class TuningParams(Section):
    """What of the vision-language model learns; the seeds' LoRA defaults."""

    method: Literal["none", "lora", "full"] = "lora"
    """Nothing, low-rank adapters (Hu et al. 2021), or every weight."""
    lora_r: int = Field(default=16, ge=1)
    """Rank of an adapter."""
    lora_alpha: int = Field(default=32, ge=1)
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
    lr: float = Field(default=1e-4, gt=0)
    """Peak learning rate of the vision-language model; the policy has `train_head.lr`."""
    batch_size: int = Field(default=16, ge=1)
    """Ticks a step."""
    grad_accumulation: int = Field(default=1, ge=1)
    """Parts that a step's ticks are computed in, one after the other."""
    max_steps: int = Field(default=200, ge=1)
    """Steps of the run."""
    warmup_steps: int = Field(default=20, ge=0)
    """Steps of linear warm-up."""
    eval_every: int = Field(default=50, ge=1)
    """Steps between evaluations on held-out ticks."""
    eval_ticks: int = Field(default=100, ge=1)
    """Held-out ticks judged in them at most: each costs a pass through the whole model."""
    checkpoint_every: int = Field(default=50, ge=1)
    """Steps between checkpoints."""
    decode_threads: int = Field(default=2, ge=1)
    """Threads that decode and resize while the model works."""
    output: Path = Path("models/finetune")
    """Folder of the best and the last checkpoint; the adapter is `best/adapter`."""
    logs: Path = Path("reports/finetune")
    """Folder of the curves."""
