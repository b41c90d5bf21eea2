"""A frame -> the same scene, a little different: rotated, cropped, in other light.

The change is drawn from a hash of the seed, the row's key, the view and the variant, not from a
generator's state: the same frames get the same variants in any batch, order or process, with any
version of numpy. Each camera has its own draw, because each is mounted, knocked and exposed
separately. A rotation shared by all cameras would look like a motion of the arm, to which the
action must respond.
"""

import hashlib
import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.base.config import AugmentationParams

_LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of ITU-R BT.601, as in Pillow's grey."""


@dataclass(frozen=True)
class Augmentation:
    """How one camera's frame is changed in one variant of a row."""

    rotation_deg: float
    """Rotation about the frame's centre, counter-clockwise in the image."""
    side: float
    """Side of the crop, as a share of the frame's side; the crop is stretched back to full size."""
    offset: tuple[float, float]
    """Shift of the crop's centre right and down, as shares of the frame's width and height."""
    brightness: float
    """Factor of every value."""
    contrast: float
    """Factor of the distance to the mean grey."""
    saturation: float
    """Factor of the distance to the pixel's own grey."""

    @classmethod
    def drawn(cls, params: AugmentationParams, key: bytes, view: str, variant: int) -> Self:
        """The change of a view in a variant of the row with this key, uniform within `params`."""
        drawn_for = f"{params.seed} {variant} {view}".encode()
        digest = hashlib.blake2b(drawn_for, key=key, digest_size=64).digest()
        # 53 bits per draw: every float64 step in [0, 1), never rounded up to 1.
        chances = (int(word) >> 11 for word in np.frombuffer(digest, "<u8"))
        draws = (chance * 2.0**-53 for chance in chances)

        def around(middle: float, reach: float) -> float:
            return middle + (2 * next(draws) - 1) * reach

        rotation_deg = around(0.0, params.rotation_deg)
        side = params.crop + (1 - params.crop) * next(draws)
        return cls(
            rotation_deg,
            side,
            (around(0.0, (1 - side) / 2), around(0.0, (1 - side) / 2)),
            around(1.0, params.brightness),
            around(1.0, params.contrast),
            around(1.0, params.saturation),
        )

    def apply(self, frame: NDArray[np.uint8], widened: float = 1.0) -> NDArray[np.uint8]:
        """The changed frame, of the same size; (height, width, 3) RGB.

        `widened` is how much more the frame was stretched in width than in height; the rotation is
        that of the scene before this stretch.
        """
        return np.asarray(self._coloured(self._moved(frame, widened)))

    def _moved(self, frame: NDArray[np.uint8], widened: float) -> Image.Image:
        """Rotated and cropped by one bicubic resampling; the frame is mirrored at its edges."""
        if self.rotation_deg == 0 and self.side == 1:
            return Image.fromarray(frame)
        height, width = frame.shape[:2]
        centre = np.array([width, height]) / 2
        angle = math.radians(self.rotation_deg)
        cos, sin = math.cos(angle), math.sin(angle)
        turn = np.array([[cos, -sin * widened], [sin / widened, cos]])
        # A point of the result lies in the frame at turn @ (point x side + shift) + centre.
        shift = np.array(self.offset) * [width, height] - centre * self.side
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]])
        reached = (corners * self.side + shift) @ turn.T + centre
        before = np.maximum(np.ceil(-reached.min(axis=0)), 0).astype(int)
        behind = np.maximum(np.ceil(reached.max(axis=0) - [width, height]), 0).astype(int)
        padded = np.pad(
            frame, ((before[1], behind[1]), (before[0], behind[0]), (0, 0)), mode="symmetric"
        )
        (a, b), (d, e) = turn * self.side
        c, f = turn @ shift + centre + before
        return Image.fromarray(padded).transform(
            (width, height), Image.Transform.AFFINE, (a, b, c, d, e, f), Image.Resampling.BICUBIC
        )

    def _coloured(self, image: Image.Image) -> Image.Image:
        """Brightness, contrast and saturation, by one matrix product and one rounding."""
        if (self.brightness, self.contrast, self.saturation) == (1, 1, 1):
            return image
        levels = np.array(image.convert("L").histogram())
        mean = float(levels @ np.arange(256) / levels.sum())
        mixed = self.saturation * np.eye(3) + (1 - self.saturation) * _LUMA
        constant = np.full((3, 1), self.brightness * (1 - self.contrast) * mean)
        matrix = np.hstack([self.brightness * self.contrast * mixed, constant])
        return image.convert("RGB", tuple(matrix.ravel().tolist()))
