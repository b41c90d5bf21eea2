"""What training and the frozen model get of one recording: samples, the batch, the prompt."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import groupby

from pipeline.base.config import Params
from pipeline.base.errors import PipelineError
from pipeline.compat.batch import UnifiedBatch
from pipeline.compat.dataset import UnifiedVLADataset
from pipeline.look.page.blocks import (
    Block,
    Document,
    Picture,
    Section,
    Table,
    Text,
    TokenRun,
    Tokens,
)
from pipeline.look.recording import pictures as plots
from pipeline.look.recording.facts import EpisodeView, PromptToken, PromptView
from pipeline.look.recording.frames import frames_at
from pipeline.look.recording.overview import RecordingsOverview
from pipeline.look.recording.page_episode import Viewer
from pipeline.look.recording.prompt import view_prompt
from pipeline.look.recording.samples import samples
from pipeline.look.recording.spec import remembered_spec

_STRETCHED = 0.05
"""A change of width over height that is said."""


def model_input(
    index: int, view_of: Viewer, overview: RecordingsOverview, params: Params
) -> Section:
    """The section of the episode at `index`; what cannot be made is a sentence saying why."""
    said = overview.summaries[index].episode
    return Section(
        "What the model and the policy get",
        [Text(f"Of the episode `{said}`, under the params in force.")],
        [
            Section(
                "Samples and batch",
                _samples(index, view_of, params, overview.summaries[index].zero),
            ),
            Section("Prompt", _prompt(view_of(index), overview, params)),
        ],
    )


def _samples(index: int, view_of: Viewer, params: Params, zero: float) -> list[Block]:
    @lru_cache(maxsize=1)
    def made() -> tuple[UnifiedVLADataset, UnifiedBatch]:
        return samples(view_of(index), params, params.inspect.samples, params.inspect.seed)

    try:
        count = len(made()[1].tick)
    except PipelineError as error:
        return [Text(f"No sample can be made: {error}")]
    head = params.train_head
    return [
        Picture(
            "samples",
            f"{count} training samples side by side: the frames, the sensor and state windows "
            f"that end at the tick, and the chunk of {head.horizon} actions that begins at it. "
            "The first is the episode's first tick, the last its last.",
            lambda: plots.samples(*made(), zero),
        ),
        Picture(
            "batch",
            "The same samples as one batch: windows are padded on the left before the episode's "
            "start, chunks are masked past its end.",
            lambda: plots.batch(made()[1]),
        ),
    ]


def _prompt(view: EpisodeView, overview: RecordingsOverview, params: Params) -> list[Block]:
    try:
        spec = remembered_spec(params, overview.views)
    except PipelineError as error:
        return [
            Text(
                "Neither the prompt nor the feature spec can be shown: "
                f"{str(error).rstrip('.')}. Name a checkpoint that is here with "
                "`--set vlm.checkpoint=FOLDER`; the demo's is written by `python -m stages.demo`."
            )
        ]
    try:
        prompt = view_prompt(view, params.vlm, spec)
        recorded = {name: one.shape[:2] for name, (one,) in frames_at(view, [0]).items()}
        blocks = _told(prompt, recorded)
    except PipelineError as error:
        blocks = [Text(f"The prompt cannot be shown: {error}")]
    said = "Feature spec: what decides what a feature is"
    return [*blocks, Document(said, spec.attrs())]


def _told(prompt: PromptView, recorded: Mapping[str, tuple[int, ...]]) -> list[Block]:
    height, width = prompt.pixels
    images = sum(prompt.image_tokens.values())
    text = len(prompt.tokens) - images
    return [
        Text(
            f"{len(prompt.tokens):,} tokens: {images:,} of images, {text:,} others. Each image is "
            f"{height} × {width} pixels for the model. Attention is causal: a token sees only what "
            "stands before it."
        ),
        *map(Text, stretched(recorded, prompt.pixels)),
        Tokens(runs(prompt.tokens)),
        Table(
            ["view", "recorded [pixels]", "for the model [pixels]", "image tokens"],
            [
                (name, _size(recorded[name]) if name in recorded else None, _size(prompt.pixels), n)
                for name, n in prompt.image_tokens.items()
            ],
            "Image tokens by view; sizes are height × width",
        ),
        Table(["token", "times"], list(prompt.special.items()), "Special tokens by name"),
    ]


def stretched(recorded: Mapping[str, tuple[int, ...]], pixels: tuple[int, int]) -> list[str]:
    """A sentence for each size (height, width) that the model sees in another shape."""
    views: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for name, size in recorded.items():
        views[size].append(name)
    found: list[str] = []
    for size, names in views.items():
        wider = pixels[1] / pixels[0] / (size[1] / size[0])
        more = max(wider, 1 / wider) - 1
        if more > _STRETCHED:
            found.append(
                f"Drawn out by {more:.0%} in {'width' if wider > 1 else 'height'}: "
                f"{', '.join(names)}, recorded as {_size(size)} pixels, for the model "
                f"{_size(pixels)}. `vlm.image_resize_height` and `vlm.image_resize_width` say so."
            )
    return found


def _size(size: tuple[int, ...]) -> str:
    return f"{size[0]} × {size[1]}"


def runs(tokens: Sequence[PromptToken]) -> list[TokenRun]:
    """Tokens of one kind and view as one run; those of an image folded to a count."""
    found: list[TokenRun] = []
    for (kind, view), each in groupby(tokens, lambda one: (one.kind, one.view)):
        group = list(each)
        if kind == "image":
            found.append(TokenRun(group[0].text, kind, f"× {len(group):,}, {view}"))
        elif kind == "special":
            found += [TokenRun(one.text, kind) for one in group]
        else:
            found.append(TokenRun("".join(one.text for one in group), kind))
    return found
