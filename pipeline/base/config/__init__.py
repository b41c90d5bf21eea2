"""params.yaml -> Params.

Every section is a frozen model that forbids unknown keys, so that a misspelt key is an error and
not a default; all errors are reported at once. `stage_one` has the sections for the demo, the data,
extraction and inspection, `stage_two` those for training, tuning and evaluation, `policy` those for
the policy's parts, `stores` those for work on stores. `sections` has all of them and describes
their keys; `limits` has the sections of a separate limits file; `load` reads files.
"""
# ruff: noqa: F401
# pyright: reportUnusedImport=false

from pipeline.base.config.limits import LimitsFile, MotionLimit
from pipeline.base.config.load import load_params, load_section, setting
from pipeline.base.config.policy import DiffusionParams, FlowMatchingParams, SensorEncoderParams
from pipeline.base.config.sections import Params, described_keys
from pipeline.base.config.stage_one import (
    AugmentationParams,
    DataParams,
    ExtractParams,
    InspectParams,
    MediaLimits,
    Pooling,
    Source,
    VLMParams,
)
from pipeline.base.config.stage_two import (
    Chunking,
    DriveParams,
    EvaluateParams,
    ExportParams,
    FinetuneParams,
    FusionStrategy,
    Level,
    ModelType,
    RolloutAblation,
    RolloutParams,
    ServeParams,
    SplitParams,
    TrainHeadParams,
    TuningParams,
    latencies_ms,
)
from pipeline.base.config.stores import ProbeParams, StoresParams
