"""The sections `train_head` and `finetune` as the params of one training."""

from pydantic import ValidationError

from pipeline.base.config import Params, TrainHeadParams
from pipeline.base.errors import ConfigError

_REPLACED = (
    "batch_size",
    "grad_accumulation",
    "max_steps",
    "warmup_steps",
    "eval_every",
    "checkpoint_every",
    "output",
    "logs",
)
"""Keys of `train_head` that `finetune` has too."""


def left_out(params: Params) -> list[str]:
    """Lines on what `train_head` asks for and a tuning does not do."""
    if not params.train_head.compile:
        return []
    return [
        "train_head.compile is true, but a tuning runs uncompiled: torch.compile cannot take its "
        "batches of rows"
    ]


def head_params(params: Params) -> TrainHeadParams:
    """`train_head` with what stands in `finetune` laid over it, and nothing compiled.

    Raises `ConfigError` where that leaves nothing of the model to learn, or nothing to learn from.
    """
    if params.finetune.tuning.method == "none":
        raise ConfigError(
            "finetune.tuning.method is none, so nothing of the vision-language model would learn. "
            "Set it to lora or full; a policy on the model as it is comes from the store alone: "
            "python -m stages.train_head"
        )
    if not params.train_head.features_enabled:
        raise ConfigError(
            "train_head.features_enabled is false, so the policy would not see the model that is "
            "tuned. Set it to true."
        )
    given = params.train_head.model_dump()
    laid_over = {name: getattr(params.finetune, name) for name in _REPLACED}
    try:
        # Batches of rows are Python objects of many shapes, which torch.compile cannot take.
        return TrainHeadParams.model_validate(given | laid_over | {"compile": False})
    except ValidationError as error:
        problems = "; ".join(problem["msg"] for problem in error.errors())
        raise ConfigError(f"finetune: {problems}") from None
