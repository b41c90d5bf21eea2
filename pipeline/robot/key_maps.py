"""The names that openpi's clients of known robots give to what they send."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.base.errors import ConfigError, ObservationError


@dataclass(frozen=True)
class KeyMap:
    """Names of the images, in the order of the policy's views, and of the parts of the state."""

    images: tuple[str, ...]
    state: tuple[str, ...]

    def refuse_more(self, views: Sequence[str]) -> None:
        """Raise `ConfigError` for a policy with more views than there are images."""
        if len(views) > len(self.images):
            raise ConfigError(
                f"serve.transform: expected a policy of at most {len(self.images)} views "
                f"({', '.join(self.images)}), found {', '.join(views)}"
            )

    def apply(self, given: Mapping[str, Any], views: Sequence[str]) -> dict[str, Any]:
        """The fields under the policy's names; what is not known keeps its name.

        An image whose name is that of a view stays that view; the others are the views in order,
        and those beyond the views are left out. An image may have its channels first. Raises
        `ObservationError` where a part of the state is missing, or is no number.
        """
        fields = {name: value for name, value in given.items() if name not in self.images}
        own = [f"images/{view}" for view in views]
        named = not {*own}.isdisjoint(self.images)
        places = {n: n for n in own} if named else dict(zip(self.images, own, strict=False))
        for name, place in places.items():
            if name in given:
                fields[place] = _channels_last(given[name])
        parts = [name for name in self.state if name in fields]
        if parts and len(parts) < len(self.state):
            missing = ", ".join(name for name in self.state if name not in parts)
            raise ObservationError(f"{missing}: expected it beside {parts[0]}, found none")
        if parts:
            try:
                joined = np.concatenate([np.atleast_1d(fields.pop(name)) for name in parts], -1)
            except ValueError as error:
                raise ObservationError(
                    f"{' + '.join(parts)}: expected numbers of one reading, found {error}"
                ) from None
            fields["state"] = joined
        return fields


KEY_MAPS: Mapping[str, KeyMap] = {
    "aloha": KeyMap(
        images=(
            "images/cam_high", "images/cam_left_wrist", "images/cam_right_wrist", "images/cam_low",
        ),
        state=("state",),
    ),
    "droid": KeyMap(
        images=("observation/exterior_image_1_left", "observation/wrist_image_left"),
        state=("observation/joint_position", "observation/gripper_position"),
    ),
    "libero": KeyMap(
        images=("observation/image", "observation/wrist_image"), state=("observation/state",)
    ),
}  # fmt: skip
"""By the names of `serve.transform`; as openpi's examples of these robots have them."""


def _channels_last(image: Any) -> Any:
    first = isinstance(image, np.ndarray) and image.ndim == 3 and image.shape[0] == 3
    return np.moveaxis(image, 0, -1) if first and image.shape[-1] != 3 else image
