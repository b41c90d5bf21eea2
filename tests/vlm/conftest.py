"""What the tests of the frozen model share."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

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


@pytest.fixture(scope="session")
def digest_file() -> Callable[[Path], str]:
    def digest(path: Path) -> str:
        return hashlib.sha256(path.read_bytes()).hexdigest()

    return digest


@pytest.fixture(scope="session")
def vlm_params(demo_checkpoint: Path) -> Callable[..., VLMParams]:
    """Params of a small float32 extraction; keywords replace what they name."""

    def params(**changes: object) -> VLMParams:
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
def extractor(
    vlm_params: Callable[..., VLMParams], digest_file: Callable[[Path], str]
) -> Callable[..., Extractor]:
    """An extractor on the CPU; `storage_dtype` and `views` beside the params."""

    def build(
        storage_dtype: str = "float32", views: tuple[str, ...] = VIEWS, **changes: object
    ) -> Extractor:
        vlm = vlm_params(**changes)
        spec = feature_spec(vlm, storage_dtype, views, digest_file)
        return Extractor(vlm, spec, Preparer(vlm, spec), FrozenVLM.load(vlm, spec, "cpu"))

    return build


@pytest.fixture(scope="session")
def make_frame() -> Callable[..., NDArray[np.uint8]]:
    """A smooth random frame: noise alone would vanish in the resize."""

    def frame(seed: int, height: int = 180, width: int = 240) -> NDArray[np.uint8]:
        generator = np.random.default_rng(seed)
        y, x = np.mgrid[0:height, 0:width]
        waves = generator.uniform(0.01, 0.08, (3, 2))
        phase = generator.uniform(0, 6, 3)
        planes = [np.sin(a * x + b * y + c) for (a, b), c in zip(waves, phase, strict=True)]
        return (127 + 120 * np.stack(planes, axis=-1)).astype(np.uint8)

    return frame
