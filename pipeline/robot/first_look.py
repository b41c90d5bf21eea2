"""The first look at a robot: are its frames and states what the policy was trained on?

Golden rows cannot see what a robot's own code does: two cameras plugged the other way round, red
and blue exchanged, joints in another order or unit. Each of these is a wrong reading of what came,
and it is refused only where that reading explains what came clearly better than the right one, and
the training data themselves tell both readings apart. Whatever else is unusual passes.
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
from pipeline.policy.state_channels import expand

Palette = NDArray[np.float64]
Frames = Mapping[str, NDArray[np.uint8]]

_PIXELS = (64, 48)
"""Width and height that frames are shrunk to."""
CLEARLY = 0.5
"""A wrong reading is refused where what is left unexplained is less than this share of what the
right one leaves; `python -m experiments.first_look` measures it."""
_LEAST = 2.0
"""Grey levels, by which golden frames must be apart for two readings to be told apart at all."""
_ALIKE = 3.0
"""And at most this many times what is left between the golden frames of a view."""
_STRANGE, _UNIT_FITS, _ORDER_FITS = 10.0, 8.0, 4.0
"""Training standard deviations: beyond the first a reading is strange, within the others a reading
in another unit or order fits. Right ones of the demo reach 7.7; of orders there are many."""
_UNITS = {
    "deg": (("radians", 180 / math.pi),),
    "rad": (("degrees", math.pi / 180),),
    "mm": (("metres", 1e3),),
    "m": (("millimetres", 1e-3),),
}


class FirstLook:
    """What training saw of frames and states, to hold an episode's first ones against."""

    def __init__(self, checkpoint: PolicyCheckpoint) -> None:
        """A checkpoint without golden rows tells nothing of frames."""
        golden = [{view: _shrink(f) for view, f in row.frames.items()} for row in checkpoint.golden]
        views = sorted({view for row in golden for view in row})
        self._golden = {view: [row[view] for row in golden if view in row] for view in views}
        state, streams = checkpoint.normalization.state, checkpoint.source["streams"]
        self._state = None if state is None else _StateLook(checkpoint, streams["state"])

    def check(self, frames: Frames, state: NDArray[np.floating] | None = None) -> None:
        """Raise `ObservationError` where frames or states are read wrongly, and say how to mend it.

        `frames` are RGB (height, width, 3) by view; `state` is (reading, channel), of which the
        last is looked at. Empty frames and a state of None or without readings pass.
        """
        seen = {view: _shrink(frames[view]) for view in self._golden if view in frames}
        self._check_views(seen)
        for view, pixels in seen.items():
            if self._is_reversed(view, pixels):
                raise ObservationError(
                    f"images/{view}: red and blue are exchanged: with its channels reversed, the "
                    "frame fits those that the policy was trained on, as it is it does not. Send "
                    "RGB: OpenCV reads BGR, which cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) turns."
                )
        if self._state is not None and state is not None and len(state):
            self._state.check(np.atleast_2d(state)[-1].astype(np.float64))

    def _check_views(self, seen: Mapping[str, NDArray[np.float64]]) -> None:
        """Refuse an exchange of views in which every view fits another's golden frames better."""
        told = {view: _light(pixels) for view, pixels in seen.items()}
        golden = {view: [_light(one) for one in self._golden[view]] for view in told}
        views = list(told)
        costs = np.zeros((len(views), len(views)))
        for (i, v), (j, w) in permutations(enumerate(views), 2):
            costs[i, j] = -1 if _better(told[v], golden[v], golden[w]) else len(views)
        pairs = zip(*linear_sum_assignment(costs), strict=True)
        shows = ", ".join(f"images/{views[i]} shows {views[j]}" for i, j in pairs if i != j)
        if shows:
            raise ObservationError(
                f"views are exchanged: {shows}, going by the frames that the policy was trained "
                "on. Name each camera's frames as training did, or plug the cameras as they were."
            )

    def _is_reversed(self, view: str, pixels: NDArray[np.float64]) -> bool:
        """Whether a frame's colours fit the golden ones better with red and blue exchanged.

        Both as they are and without their mean: the one does not take a lamp of another colour for
        an exchange, the other an object of another colour.
        """
        return all(
            _better(
                warmth(pixels),
                [warmth(one) for one in self._golden[view]],
                [warmth(one[..., ::-1]) for one in self._golden[view]],
            )
            for warmth in (_warmth, _own_warmth)
        )


def _better(seen: Palette, own: Sequence[Palette], other: Sequence[Palette]) -> bool:
    """Whether what was seen is clearly of the other kind, and both kinds can be told apart.

    Each golden palette, held against the rest of its kind, has to be as clearly of its own.
    """
    if len(own) < 2 or len(other) < 2:
        return False
    own_left, other_left = (
        [_apart(one, [rest for rest in kind if rest is not one]) for one in kind]
        for kind in (own, other)
    )
    across = [_apart(one, other) for one in own] + [_apart(one, own) for one in other]
    told_apart = min(across) >= _LEAST and all(
        left <= CLEARLY * apart for left, apart in zip(own_left + other_left, across, strict=True)
    )
    as_other = _apart(seen, other)
    clearly = as_other < CLEARLY * _apart(seen, own)
    return told_apart and clearly and as_other <= _ALIKE * max(_LEAST, *other_left)


def _apart(palette: Palette, kind: Sequence[Palette]) -> float:
    """How far a palette is from the nearest of a kind: root mean square, in grey levels.

    Squares, so that what is small and of strong colour counts.
    """
    return min(float(np.sqrt(np.square(palette - one).mean())) for one in kind)


def _shrink(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(Image.fromarray(frame).resize(_PIXELS, Image.Resampling.BOX), np.float64)


def _light(pixels: NDArray[np.float64]) -> Palette:
    """How bright and how colourful a frame is, whatever stands where; the same for RGB and BGR."""
    grey, colour = pixels.mean(axis=-1), np.ptp(pixels, axis=-1)
    return np.concatenate([np.sort(grey, axis=None), np.sort(colour, axis=None)])


def _warmth(pixels: NDArray[np.float64]) -> Palette:
    """How much redder than blue a frame is, whatever stands where."""
    return np.sort(pixels[..., 0] - pixels[..., 2], axis=None)


def _own_warmth(pixels: NDArray[np.float64]) -> Palette:
    """`_warmth` beside that of the frame as a whole."""
    warmth = _warmth(pixels)
    return warmth - np.median(warmth)


class _StateLook:
    """What training saw of the robot state."""

    def __init__(self, checkpoint: PolicyCheckpoint, stream: Mapping[str, Sequence[str]]) -> None:
        statistics = checkpoint.normalization.state
        assert statistics is not None
        self._mean, self._scale = statistics.mean, statistics.scale
        self._kinds = checkpoint.shape.kinds
        self._names, self._units = stream["names"], [unit.lower() for unit in stream["units"]]

    def check(self, reading: NDArray[np.float64]) -> None:
        """Refuse a reading (channel,) that another unit, or another order, explains."""
        away = self._away(reading[None])[0]
        strange = np.flatnonzero(away > _STRANGE)
        if not len(strange):
            return
        far = ", ".join(f"{self._names[c]} {reading[c]:.4g} ({away[c]:.0f})" for c in strange[:6])
        found = f"state: far from what the policy was trained on (standard deviations): {far}"
        for unit, (name, factor) in ((u, way) for u in _UNITS for way in _UNITS[u]):
            of_unit = np.array([one == unit for one in self._units])
            scaled = np.where(of_unit, reading * factor, reading)
            if of_unit[strange].all() and (self._away(scaled[None]) <= _UNIT_FITS).all():
                raise ObservationError(
                    f"{found}. Read as {name}, they fit: send {unit}, {factor:.6g} times as much."
                )
        if len(strange) > 1 and (order := self._order(reading)) is not None:
            shown = (
                f"{self._names[at]} holds {self._names[c]}"
                for c, at in sorted(order.items(), key=lambda pair: pair[1])
            )
            raise ObservationError(
                f"{found}. In another order they fit: {', '.join(shown)}. Send the channels in the "
                f"order {', '.join(self._names)}."
            )

    def _order(self, reading: NDArray[np.float64]) -> dict[int, int] | None:
        """Channel -> the place that its value came in, those that moved; None where none fits."""
        taken_as = self._away(np.repeat(reading[:, None], len(reading), axis=1))
        places, channels = linear_sum_assignment(np.minimum(taken_as, _STRANGE) ** 2)
        if not (taken_as[places, channels] <= _ORDER_FITS).all():
            return None
        pairs = zip(channels.tolist(), places.tolist(), strict=True)
        return {channel: place for channel, place in pairs if channel != place}

    def _away(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations from the training mean, (reading, channel).

        0 for the angles of a pose, of which training keeps how they change alone.
        """
        given = torch.from_numpy(readings.astype(np.float32))[:, None]
        expanded = expand(given, self._kinds)[:, 0].numpy()
        wide = np.abs(expanded - self._mean) / self._scale
        away = np.zeros_like(readings)
        plain = [place for place, kind in enumerate(self._kinds) if kind == "plain"]
        angles = [place for place, kind in enumerate(self._kinds) if kind in ("deg", "rad")]
        away[:, plain] = wide[:, : len(plain)]
        waves = wide[:, len(plain) : len(plain) + 2 * len(angles)]
        away[:, angles] = waves.reshape(len(readings), 2, len(angles)).max(axis=1)
        return away
