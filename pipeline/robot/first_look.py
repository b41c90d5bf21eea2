"""The first look at a robot: do its frames and states mean the same as in training?

Golden rows cannot show errors of the robot's own code: two cameras swapped, red and blue exchanged,
joints in another order or unit. Each error is tried as another reading of the data. The data are
refused only if this wrong reading explains them clearly better than the right one does, and if the
training data can tell the two apart. Everything else that is unusual passes.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import linear_sum_assignment

from pipeline.base.errors import ObservationError
from pipeline.policy.checkpoint import PolicyCheckpoint
from pipeline.policy.robot_state import expand

Palette = NDArray[np.float64]
"""Sorted grey levels of a frame; they do not depend on where things stand in it."""
Frames = Mapping[str, NDArray[np.uint8]]

_PIXELS = (64, 48)
"""Width and height that frames are shrunk to."""
CLEARLY = 0.5
"""Data are refused if the wrong reading's distance from training is less than this share of the
right one's; `python -m experiments.first_look` measures it."""
_LEAST = 2.0
"""Two readings whose golden frames differ by fewer grey levels cannot be told apart."""
_ALIKE = 3.0
"""A wrong reading fits within this many times the distance between golden frames of one view."""
_STRANGE, _UNIT_FITS, _ORDER_FITS = 10.0, 8.0, 4.0
"""Training standard deviations: a channel beyond the first is strange; a state within the second
fits in another unit, within the third in another order. Right states of the demo reach 7.7. The
third is the strictest because there are many orders."""
_UNITS = (
    ("deg", "radians", 180 / math.pi),
    ("rad", "degrees", math.pi / 180),
    ("mm", "metres", 1e3),
    ("m", "millimetres", 1e-3),
)
"""A channel's unit, the unit that it may be sent in by mistake, and the factor between them."""


class FirstLook:
    """Compares an episode's first frames and states with those of training."""

    def __init__(self, checkpoint: PolicyCheckpoint) -> None:
        """Without golden rows no frame is ever refused."""
        golden = [{view: _shrink(f) for view, f in row.frames.items()} for row in checkpoint.golden]
        views = sorted({view for row in golden for view in row})
        self._golden = {view: [row[view] for row in golden if view in row] for view in views}
        self._state = checkpoint.normalization.state
        stream = checkpoint.source["streams"]["state"] if self._state is not None else {}
        self._names: Sequence[str] = stream.get("names", ())
        self._units = np.array([unit.lower() for unit in stream.get("units", ())], np.str_)
        self._kinds = checkpoint.shape.kinds

    def check(self, frames: Frames, state: NDArray[np.floating] | None = None) -> None:
        """Raise `ObservationError` where frames or states are read wrongly, and say how to mend it.

        `frames` are RGB (height, width, 3) by view. Only the last reading of `state` (reading,
        channel) is checked. Missing frames, a missing state and an empty state pass.
        """
        seen = {view: _shrink(frames[view]) for view in self._golden if view in frames}
        if shows := self._exchanged_views(seen):
            raise ObservationError(
                f"views are exchanged: {shows}, going by the frames that the policy was trained "
                "on. Name each camera's frames as training did, or plug the cameras as they were."
            )
        for view, pixels in seen.items():
            if self._is_reversed(view, pixels):
                raise ObservationError(
                    f"images/{view}: red and blue are exchanged: with its channels reversed, the "
                    "frame fits those that the policy was trained on, as it is it does not. Send "
                    "RGB: OpenCV reads BGR, which cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) turns."
                )
        if self._state is not None and state is not None and len(state):
            self._check_state(np.atleast_2d(state)[-1].astype(np.float64))

    def _exchanged_views(self, seen: Mapping[str, NDArray[np.float64]]) -> str:
        """Which view shows which other one, going by the golden frames; empty if none does."""
        light = {view: _light(pixels) for view, pixels in seen.items()}
        golden = {view: [_light(pixels) for pixels in self._golden[view]] for view in seen}
        views = list(seen)
        costs = np.zeros((len(views), len(views)))
        for (i, v), (j, w) in permutations(enumerate(views), 2):
            costs[i, j] = -1 if _fits_better(light[v], golden[v], golden[w]) else len(views)
        pairs = zip(*linear_sum_assignment(costs), strict=True)
        return ", ".join(f"images/{views[i]} shows {views[j]}" for i, j in pairs if i != j)

    def _is_reversed(self, view: str, pixels: NDArray[np.float64]) -> bool:
        """Whether a frame's colours fit the golden ones better with red and blue exchanged.

        Two tests have to agree: one of the colours as they are, which a lamp of another colour
        changes, and one of the colours minus their median, which an object of another colour
        changes.
        """
        golden = self._golden[view]
        return all(
            _fits_better(
                warmth(pixels),
                [warmth(right) for right in golden],
                [warmth(right[..., ::-1]) for right in golden],
            )
            for warmth in (_warmth, _relative_warmth)
        )

    def _check_state(self, reading: NDArray[np.float64]) -> None:
        """Refuse a reading (channel,) that another unit or another order explains."""
        away = self._deviations(reading[None])[0]
        strange = np.flatnonzero(away > _STRANGE)
        if not len(strange):
            return
        far = ", ".join(f"{self._names[c]} {reading[c]:.4g} ({away[c]:.0f})" for c in strange[:6])
        far_off = f"state: far from what the policy was trained on (standard deviations): {far}"
        for unit, name, factor in _UNITS:
            of_unit = self._units == unit
            scaled = np.where(of_unit, reading * factor, reading)
            if of_unit[strange].all() and (self._deviations(scaled[None]) <= _UNIT_FITS).all():
                raise ObservationError(
                    f"{far_off}. Read as {name}, they fit: send {unit}, {factor:.6g} times as much."
                )
        if len(strange) > 1 and (order := self._other_order(reading)):
            raise ObservationError(
                f"{far_off}. In another order they fit: {order}. Send the channels in the order "
                f"{', '.join(self._names)}."
            )

    def _other_order(self, reading: NDArray[np.float64]) -> str:
        """Which channel holds which other one, if the values fit in that order; else empty."""
        as_channel = self._deviations(np.repeat(reading[:, None], len(reading), axis=1))
        places, channels = linear_sum_assignment(np.minimum(as_channel, _STRANGE) ** 2)
        if not (as_channel[places, channels] <= _ORDER_FITS).all():
            return ""
        pairs = zip(places.tolist(), channels.tolist(), strict=True)
        return ", ".join(f"{self._names[at]} holds {self._names[c]}" for at, c in pairs if at != c)

    def _deviations(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Training standard deviations from the mean, (reading, channel).

        It is 0 for a pose's rotation, because training keeps only the change of that.
        """
        assert self._state is not None
        values = torch.from_numpy(readings.astype(np.float32))[:, None]
        expanded = expand(values, self._kinds)[:, 0].numpy()
        away = np.abs(expanded - self._state.mean) / self._state.scale
        plain, angles = (np.isin(self._kinds, kinds) for kinds in ("plain", ("deg", "rad")))
        sines, cosines = plain.sum(), plain.sum() + angles.sum()
        deviations = np.zeros_like(readings)
        deviations[:, plain] = away[:, :sines]
        deviations[:, angles] = np.maximum(
            away[:, sines:cosines], away[:, cosines : cosines + angles.sum()]
        )
        return deviations


def _fits_better(seen: Palette, own: Sequence[Palette], other: Sequence[Palette]) -> bool:
    """Whether a palette is clearly of the other kind, and both kinds can be told apart.

    They can if each golden palette, compared with the rest of its kind, is as clearly of its own.
    """
    if len(own) < 2 or len(other) < 2:
        return False
    own_left, other_left = (
        [_distance(golden, [rest for rest in kind if rest is not golden]) for golden in kind]
        for kind in (own, other)
    )
    across = [_distance(golden, other) for golden in own]
    across += [_distance(golden, own) for golden in other]
    told_apart = min(across) >= _LEAST and all(
        left <= CLEARLY * apart for left, apart in zip(own_left + other_left, across, strict=True)
    )
    as_other = _distance(seen, other)
    clearly = as_other < CLEARLY * _distance(seen, own)
    return told_apart and clearly and as_other <= _ALIKE * max(_LEAST, *other_left)


def _distance(palette: Palette, kind: Sequence[Palette]) -> float:
    """Root mean square distance, in grey levels, to the nearest palette of a kind.

    With squares, a small object of a strong colour counts.
    """
    return min(float(np.sqrt(np.square(palette - golden).mean())) for golden in kind)


def _shrink(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(Image.fromarray(frame).resize(_PIXELS, Image.Resampling.BOX), np.float64)


def _light(pixels: NDArray[np.float64]) -> Palette:
    """How bright and how colourful a frame is; the same for RGB and BGR."""
    grey, colour = pixels.mean(axis=-1), np.ptp(pixels, axis=-1)
    return np.concatenate([np.sort(grey, axis=None), np.sort(colour, axis=None)])


def _warmth(pixels: NDArray[np.float64]) -> Palette:
    """How much redder than blue a frame is."""
    return np.sort(pixels[..., 0] - pixels[..., 2], axis=None)


def _relative_warmth(pixels: NDArray[np.float64]) -> Palette:
    """How much warmer a frame is than its own median."""
    warmth = _warmth(pixels)
    return warmth - np.median(warmth)
