"""What a store's model has seen in its own tuning must not judge the policies on top of it."""

from collections.abc import Iterable, Mapping

from pipeline.base.errors import ConfigError
from pipeline.base.tuned_on import EpisodePart, TunedPart, of_store
from pipeline.store import FeatureStore
from pipeline.train.split import Split, split_parts

_SHOWN = 5


def refuse_tuned_episodes(store: FeatureStore, split: Split) -> list[str]:
    """What cannot be told of the store's model, as lines for the user.

    Raises `ConfigError` where test has what it was tuned or chosen on, or val what it was tuned on.
    """
    tuned = of_store(store.attrs, store.path)
    if tuned is None:
        if not store.spec.get("adapter"):
            return []
        return [
            f"the adapter of {store.path} does not say what it was tuned on, so nobody can tell "
            "whether the held-out episodes are new to it"
        ]
    parts = split_parts(store, split)
    seen = {
        "test": _seen(parts["test"], (*tuned.train, *tuned.val)),
        "val": _seen(parts["val"], tuned.train),
    }
    if any(seen.values()):
        lines = [f"{side}: {', '.join(names[:_SHOWN])}" for side, names in seen.items() if names]
        raise ConfigError(
            f"{store.path}: the model of its features was tuned on episodes that train_head.split "
            f"holds out, the first ({'; '.join(lines)}), so what is reported on them would flatter "
            "it. Set train_head.split to what stages.finetune had, the same seed above all, or "
            "extract with a model that was not tuned on them."
        )
    return []


def _seen(parts: Mapping[str, EpisodePart], tuned: Iterable[TunedPart]) -> list[str]:
    """The episodes of these parts whose groups have ticks that the model has seen."""
    known: dict[str, list[tuple[int, int]]] = {}
    for part in tuned:
        known.setdefault(part.content, []).append(part.ticks)
    groups = {
        part.group
        for part in parts.values()
        if any(a < part.ticks[1] and part.ticks[0] < b for a, b in known.get(part.content, ()))
    }
    return sorted(name for name, part in parts.items() if part.group in groups)
