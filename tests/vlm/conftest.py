"""What the tests of the frozen model share."""

import hashlib
import shutil
from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.base.config import VLMParams
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.qwen import FrozenVLM

VIEWS = ("View1", "View2", "View3")


@dataclass(frozen=True)
class Extractor:
    """All that turns instructions and frames into features."""

    vlm: VLMParams
    spec: FeatureSpec
    preparer: Preparer
    model: FrozenVLM


@pytest.fixture
def copy(demo_checkpoint, tmp_path):
    """The folder of the demo's checkpoint, to be changed by a test."""
    return shutil.copytree(demo_checkpoint, tmp_path / "copy")


@pytest.fixture(scope="session")
def digest_file():
    def digest(path):
        return hashlib.sha256(path.read_bytes()).hexdigest()

    return digest


@pytest.fixture(scope="session")
def vlm_params(demo_checkpoint):
    """Params of a small float32 extraction; keywords replace what they name."""

    def params(**changes):
        small = {
            "checkpoint": str(demo_checkpoint),
            "dtype": "float32",
            "image_resize_height": 112,
            "image_resize_width": 140,
            "pooling": ["mean"],
        }
        return VLMParams.model_validate(small | changes)

    return params


@pytest.fixture(scope="session")
def extractor(vlm_params, digest_file):
    """An extractor on the CPU; `storage_dtype` and `views` beside the params.

    Made once each, except `anew` and for a folder that a test may change.
    """
    made: dict[str, Extractor] = {}

    def build(storage_dtype="float32", views=VIEWS, anew=False, **changes):
        key = repr((storage_dtype, views, changes))
        if anew or key not in made or {"checkpoint", "adapter"} & changes.keys():
            vlm = vlm_params(**changes)
            spec = feature_spec(vlm, storage_dtype, views, digest_file)
            model = FrozenVLM.load(vlm, spec, "cpu")
            made[key] = Extractor(vlm, spec, Preparer(vlm, spec), model)
            if anew:
                return made.pop(key)
        return made[key]

    return build


@pytest.fixture(scope="session")
def make_frame():
    """A smooth random frame: noise alone would vanish in the resize."""

    def frame(seed, height=180, width=240):
        generator = np.random.default_rng(seed)
        y, x = np.mgrid[0:height, 0:width]
        waves = generator.uniform(0.01, 0.08, (3, 2))
        phase = generator.uniform(0, 6, 3)
        planes = [np.sin(a * x + b * y + c) for (a, b), c in zip(waves, phase, strict=True)]
        return (127 + 120 * np.stack(planes, axis=-1)).astype(np.uint8)

    return frame
