"""The sections `train_head` and `finetune` as the params of one training."""

from pydantic import ValidationError

from pipeline.base.config import FinetuneParams, Params, TrainHeadParams
from pipeline.base.errors import ConfigError


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
    # `lr` is of the model alone; rows are objects of many shapes, which torch.compile cannot take.
    given = {"lr": params.train_head.lr, "compile": False}
    shared = TrainHeadParams.model_fields.keys() & FinetuneParams.model_fields.keys()
    laid_over = {name: getattr(params.finetune, name) for name in shared} | given
    try:
        return TrainHeadParams.model_validate(params.train_head.model_dump() | laid_over)
    except ValidationError as error:
        problems = "; ".join(problem["msg"] for problem in error.errors())
        raise ConfigError(f"finetune: {problems}") from None
