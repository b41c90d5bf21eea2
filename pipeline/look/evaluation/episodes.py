"""The held-out episodes on the page of an evaluation."""

from collections.abc import Iterator
from functools import cache, partial

from pipeline.base.digests import file_digest
from pipeline.evaluate.episode_frames import read_episode_frames, shown_ticks
from pipeline.evaluate.evaluation import Evaluation
from pipeline.evaluate.tables import HEADINGS, best_baseline
from pipeline.look.evaluation import pictures as plots
from pipeline.look.page.blocks import Block, Picture, Section, Table, Text
from pipeline.store import episode_name
from pipeline.train.batches import Ticks
from pipeline.train.predictions import Predictions

_INSTANTS = 5
"""Ticks of an episode at which its frames are shown."""
_EPISODES = 40
"""Rows of the table of episodes."""
_ABOVE = "Above, the frames that the features at the dotted ticks were computed from. "


def episodes(found: Evaluation) -> list[Block]:
    """All held-out episodes by error."""
    comparison, store = found.comparison, found.store
    best = best_baseline(comparison)
    errors = {method: comparison.overall_by_episode(method) for method in ("policy", best)}
    rows: list[tuple[object, ...]] = []
    for place in comparison.ranked()[::-1][:_EPISODES]:
        episode = store.episodes[comparison.episodes[place]]
        policy, rule = (float(errors[method][place]) for method in ("policy", best))
        ticks = int((found.predictions.episodes == episode.index).sum())
        rows.append((episode_name(episode), ticks, policy, rule, policy / rule if rule else None))
    caption = "Overall error [training std] by episode, the worst first"
    if len(rows) < len(comparison.episodes):
        caption += f"; the worst {len(rows)} of {len(comparison.episodes)}"
    return [
        Table(
            ["episode", "held-out ticks", "policy", HEADINGS[best], "policy / baseline"],
            rows,
            caption=f"{caption}.",
        ),
        Picture(
            "episodes",
            "Mean absolute error of policy and baselines in each held-out episode.",
            partial(plots.episodes, comparison, store),
        ),
        Picture(
            "timeline",
            "Every action dimension over the episodes of lowest and highest error: recorded, and "
            "what the policy would do next.",
            partial(plots.timeline, comparison, found.predictions, store),
        ),
    ]


def extremes(found: Evaluation) -> Iterator[Section]:
    """The best and the worst closely, with their frames where the recordings still lie there.

    The picture of a single one is that of the worst, which dvc.yaml lists.
    """
    comparison, predictions, store = found.comparison, found.predictions, found.store
    errors = dict(zip(comparison.episodes, comparison.overall_by_episode("policy"), strict=True))
    digest_of = cache(file_digest)  # episodes of a LeRobot data set share files
    *_, (_, worst) = comparison.extremes()
    for title, index in comparison.extremes():
        name = "episode_worst" if index == worst else "episode_best"
        episode = store.episodes[index]
        ticks = shown_ticks(store, _whole(predictions, index), _INSTANTS)
        rows = store.array("tick/vl_row")[ticks]
        seen = read_episode_frames(store, episode, rows.tolist(), found.recordings, digest_of)
        drawn = partial(plots.chunks, comparison, predictions, store, episode, ticks, seen.frames)
        told = f"Overall error {errors[index]:.3f} [training std]. {seen.absence}".strip()
        caption = (
            f"Instruction: {episode.instruction}. {_ABOVE if seen.frames else ''}Recorded action, "
            "the policy's next action at every tick, and the whole chunks that it predicts at the "
            "dotted ticks; what was recorded then is the recorded line from there on."
        )
        yield Section(
            f"{title[0].upper()}{title[1:]}: {episode_name(episode)}",
            [Text(told), Picture(name, caption, drawn)],
        )


def _whole(predictions: Predictions, index: int) -> Ticks:
    """The judged ticks of an episode whose chunk ends within it; all, where it is that short."""
    here = predictions.episodes == index
    whole = here & predictions.valid.all(axis=1)
    return predictions.ticks[whole if whole.any() else here]
