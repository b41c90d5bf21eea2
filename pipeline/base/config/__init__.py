"""params.yaml -> Params.

Every section is a frozen model that forbids unknown keys, so that a misspelt key is an error and
not a default; all errors are reported at once. `stage_one` has the sections for the demo, the data,
extraction, inspection and stores, `training` those for training and tuning, `policy_use` those for
what is done with a trained policy and a robot's limits. `params` has all of them, describes their
keys and reads files.
"""
# ruff: noqa: F401
# pyright: reportUnusedImport=false

from pipeline.base.config.extraction import (
    AugmentationParams,
    DataParams,
    ExtractParams,
    GridPooling,
    InspectParams,
    Layer,
    MediaLimits,
    Pooling,
    ProbeParams,
    Source,
    StoresParams,
    VLMParams,
)
from pipeline.base.config.params import Params, described_keys, load_params, load_section, setting
from pipeline.base.config.policies import (
    PHANTOM,
    Chunking,
    DriveParams,
    EvaluateParams,
    ExportParams,
    Level,
    LimitsFile,
    MotionLimit,
    RolloutAblation,
    RolloutParams,
    ServeParams,
    environments,
    latencies_ms,
)
from pipeline.base.config.training import (
    DiffusionParams,
    FeatureEncoderParams,
    FinetuneParams,
    FlowMatchingParams,
    FusionStrategy,
    ModelType,
    SensorEncoderParams,
    SplitParams,
    TrainHeadParams,
    TuningParams,
)
