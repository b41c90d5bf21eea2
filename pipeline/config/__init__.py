"""params.yaml -> Params.

Every section is a frozen model that forbids unknown keys, so that a misspelt key is an error and
not a default; all errors are reported at once. `stage_one` has the sections of the demo,
the data and extraction, `stage_two` those of training and evaluation, `load` reads the file.
"""

from pipeline.config.load import load_params
from pipeline.config.sections import Params
from pipeline.config.stage_one import (
    DataParams,
    DemoParams,
    Dtype,
    ExtractParams,
    Pooling,
    RecordingFormat,
    Source,
    VLMParams,
)
from pipeline.config.stage_two import (
    EvaluateParams,
    ExpertParams,
    SensorEncoderParams,
    StateEncoderParams,
    TrainHeadParams,
)

__all__ = [
    "DataParams",
    "DemoParams",
    "Dtype",
    "EvaluateParams",
    "ExpertParams",
    "ExtractParams",
    "Params",
    "Pooling",
    "RecordingFormat",
    "SensorEncoderParams",
    "Source",
    "StateEncoderParams",
    "TrainHeadParams",
    "VLMParams",
    "load_params",
]
