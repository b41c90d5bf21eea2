"""params.yaml -> Params.

Every section is a frozen model that forbids unknown keys, so that a misspelt key is an error and
not a default; all errors are reported at once. `stage_one` has the sections of the demo,
the data and extraction, `stage_two` those of training and evaluation, `policy` those of the
policy's parts, `finetune` that of tuning the model itself, `stores` those of what is done with
stores, `inspect` that of looking at both; `load` reads the file, `keys` describes it.
"""

from pipeline.base.config.finetune import FinetuneParams, TuningParams
from pipeline.base.config.inspect import InspectParams
from pipeline.base.config.keys import described_keys
from pipeline.base.config.load import load_params
from pipeline.base.config.policy import (
    DiffusionParams,
    ExpertParams,
    FlowMatchingParams,
    RegressionParams,
    SensorEncoderParams,
    StateEncoderParams,
)
from pipeline.base.config.sections import Params
from pipeline.base.config.stage_one import (
    AugmentationParams,
    DataParams,
    DemoParams,
    Dtype,
    ExtractParams,
    Pooling,
    RecordingFormat,
    Source,
    VLMParams,
)
from pipeline.base.config.stage_two import (
    CompareParams,
    EvaluateParams,
    FusionStrategy,
    ModelType,
    TrainHeadParams,
)
from pipeline.base.config.stores import (
    ArchiveParams,
    ProbeParams,
    StoresParams,
    VerifyParams,
    Workers,
)

__all__ = [
    "ArchiveParams",
    "AugmentationParams",
    "CompareParams",
    "DataParams",
    "DemoParams",
    "DiffusionParams",
    "Dtype",
    "EvaluateParams",
    "ExpertParams",
    "ExtractParams",
    "FinetuneParams",
    "FlowMatchingParams",
    "FusionStrategy",
    "InspectParams",
    "ModelType",
    "Params",
    "Pooling",
    "ProbeParams",
    "RecordingFormat",
    "RegressionParams",
    "SensorEncoderParams",
    "Source",
    "StateEncoderParams",
    "StoresParams",
    "TrainHeadParams",
    "TuningParams",
    "VLMParams",
    "VerifyParams",
    "Workers",
    "described_keys",
    "load_params",
]
