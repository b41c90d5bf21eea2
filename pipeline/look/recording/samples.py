"""What policy and model receive from a recording: samples, the batch, the prompt as tokens."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline.base.config import Params, VLMParams
from pipeline.base.errors import PipelineError, RecordingError
from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.base.text import Table
from pipeline.look.page.blocks import Block, Text, TokenRun, Tokens
from pipeline.look.page.style import INK, draw_frame, panels
from pipeline.look.recording.cameras import read_frames
from pipeline.look.recording.episode import BROKEN, Draw, LoadedRecording
from pipeline.look.recording.streams import ChannelGroup, legend_beside, named_groups, plot_curves
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec
from pipeline.vlm.preparation import Preparer
from pipeline.vlm.processor import TokenKind

# The picture fills this width unless its columns get too narrow: so its smallest text, 8 points, is
# no smaller than 8 pixels on a page. Labels and legends are beside the columns.
_WIDTH_IN, _BESIDE_IN = 10.0, 3.0
_LEAST_COLUMN_IN, _COLUMN_IN, _PANEL_IN = 1.65, 2.5, 1.15
_SMALL = 8
# Characters of a title over the whole width.
_TITLE = 120


@dataclass(frozen=True)
class Sample:
    """What a policy sees at a tick, and the actions from there on, without padding.

    `frames` (height, width, 3), by view, are those of the VL row that the tick reuses. `windows`
    (entry, channel), by stream, are the last readings up to the tick for `sensor` and `state`, and
    for `action` the chunk that begins at the tick.
    """

    tick: int
    frames: Mapping[str, NDArray[np.uint8]]
    windows: Mapping[str, NDArray[np.float32]]


def sample_blocks(view: LoadedRecording, draw: Draw, params: Params) -> list[Block]:
    """`inspect.samples` samples of an episode side by side and as a batch, or why there is none."""
    try:
        samples = cut_samples(view, params)
    except BROKEN as error:
        return [Text(f"No sample can be made: {error}")]
    lengths = window_lengths(params)
    caption = "Training samples: frames, windows that end at the tick, and the chunk of actions."
    picture = draw("samples", caption, lambda view: draw_samples(view, samples, lengths))
    return [picture, batch_table(samples, lengths)]


def window_lengths(params: Params) -> dict[str, int]:
    """Entries of each stream's window, and of the action chunk, in training."""
    head = params.train_head
    return {"sensor": head.sensor_window, "state": head.state_window, "action": head.horizon}


def cut_samples(view: LoadedRecording, params: Params) -> list[Sample]:
    """At most `inspect.samples` different samples of an episode, as training cuts them.

    They are in order of time. The first is the episode's first tick, whose windows begin with
    padding; the last is its last tick, whose chunk is masked past the end; those between are drawn
    by `inspect.seed`. Raises `RecordingError` if the episode has an error (as one without ticks
    has), or if a frame cannot be read.
    """
    line, lengths = view.timeline, window_lengths(params)
    errors = [issue.message for issue in view.issues if issue.severity == "error"]
    if line is None or errors:
        raise RecordingError(errors[0])
    head = params.train_head
    oldest_s = {"sensor": head.sensor_reach_s or np.inf, "state": head.state_window_s or np.inf}
    last = len(line.time) - 1
    inner = np.random.default_rng(params.inspect.seed).permutation(np.arange(1, last))
    ticks = np.unique([0, last, *inner][: params.inspect.samples]).tolist()
    frames = {
        name: list(camera.read(line.frames[name][line.vl_row[ticks]].tolist()))
        for name, camera in view.cameras.items()
    }
    streams = {"sensor": (view.sensor, line.sensor_end), "state": (view.state, line.state_end)}
    samples: list[Sample] = []
    for place, tick in enumerate(ticks):
        windows: dict[str, NDArray[Any]] = {}
        for name, (stream, ends) in streams.items():
            if stream is not None:
                seen = slice(max(0, ends[tick] - lengths[name]), ends[tick])
                since_s = line.time[tick] - stream.time[seen]
                windows[name] = stream.values[seen][since_s <= oldest_s[name] + CLOCK_SLACK_S]
        windows["action"] = line.action[tick : tick + lengths["action"]]
        samples.append(Sample(tick, {name: row[place] for name, row in frames.items()}, windows))
    return samples


def draw_samples(
    view: LoadedRecording, samples: Sequence[Sample], lengths: Mapping[str, int]
) -> Figure:
    """The samples side by side, a column each: frames, windows, action chunk.

    Windows end at their tick. Readings before the episode's first, and the steps of a chunk past
    its end, which training masks, are hatched. States are drawn as their change since the window's
    first.
    """
    rows = named_groups({name: view.shown[name] for name in samples[0].windows})
    views = samples[0].frames
    column = float(np.clip((_WIDTH_IN - _BESIDE_IN) / len(samples), _LEAST_COLUMN_IN, _COLUMN_IN))
    heights = [column * frame.shape[0] / frame.shape[1] for frame in views.values()]
    heights += [_PANEL_IN] * len(rows)
    size = column * len(samples) + _BESIDE_IN, sum(heights) + 1.8
    shape = {"squeeze": False, "sharey": "row", "height_ratios": heights}
    figure, axes = panels(*size, len(heights), len(samples), **shape)
    for place, sample in enumerate(samples):
        axes[0, place].set_title(_sample_title(view, sample.tick), fontsize=_SMALL)
        for line_axes, (name, frame) in zip(axes, sample.frames.items(), strict=False):
            draw_frame(line_axes[place], frame)
            line_axes[0].set_ylabel(name, fontsize=_SMALL)
    middle = (len(samples) - 1) // 2
    for line_axes, (name, group) in zip(axes[len(views) :], rows, strict=True):
        values = [sample.windows[name][:, group.indices] for sample in samples]
        _draw_row(line_axes, name, group, values, lengths[name])
        if group is [other for stream, other in rows if stream == name][-1]:
            along = "steps ahead" if name == "action" else "readings before the tick"
            line_axes[middle].set_xlabel(along, fontsize=_SMALL)
    episode = view.recording.id.split("/")[-1]
    figure.suptitle(f"{episode}\n“{view.instruction}”"[:_TITLE], fontsize=9)
    return figure


def batch_table(samples: Sequence[Sample], lengths: Mapping[str, int]) -> Table:
    """How much of each window and chunk is real, a row for each sample."""
    streams = list(samples[0].windows)
    rows = [
        [sample.tick, *(f"{len(sample.windows[name])} of {lengths[name]}" for name in streams)]
        for sample in samples
    ]
    caption = "The same samples as a batch: how much of each is real, and not padded or masked."
    heads = [f"{name} {'steps' if name == 'action' else 'readings'}" for name in streams]
    return Table(["tick", *heads], rows, caption)


def _draw_row(
    axes: Sequence[Axes],
    name: str,
    group: ChannelGroup,
    windows: Sequence[NDArray[Any]],
    length: int,
) -> None:
    """Draw the panels of one group of channels, one for each sample, on the same scale."""
    ahead = name == "action"
    start, stop = (0.0, float(length)) if ahead else (0.5 - length, 0.5)
    limits = np.percentile(np.concatenate(windows), (1, 99.5)) if group.profile else (0, 1)
    for axis, real in zip(axes, windows, strict=True):
        edge = float(len(real)) if ahead else 0.5 - len(real)
        if len(real) < length:
            absent = (edge, stop) if ahead else (start, edge)
            axis.axvspan(*absent, facecolor="none", edgecolor=INK, hatch="//", lw=0, alpha=0.35)
        if group.profile:
            extent = (edge, stop, len(group.indices) - 0.5, -0.5)
            axis.imshow(real.T, aspect="auto", extent=extent, vmin=limits[0], vmax=limits[1])
        elif ahead:
            # The last action is held to the end; the masked part is under the hatch.
            at = np.array([*range(len(real)), length], np.float64)
            plot_curves(axis, at, np.concatenate([real, real[-1:]]), group.names, held=True)
        else:
            # States lie far apart and move little within a window.
            shown = real - real[0] if name == "state" else real
            plot_curves(axis, np.arange(1.0 - len(real), 1.0), shown, group.names)
        axis.set_xlim(start, stop)
        axis.tick_params(labelsize=_SMALL)
    label = f"{name}\n{group.label}" + (", depth" if group.profile else "")
    label += "\nchange" if name == "state" else ""
    axes[0].set_ylabel(label, fontsize=_SMALL)
    if len(group.names) > 1 and not group.profile:
        # The last sample's window is the fullest: a single reading has a marker, not a line.
        legend_beside(axes[-1])


def _sample_title(view: LoadedRecording, tick: int) -> str:
    """Which tick a column shows, and how old its features are."""
    line = view.timeline
    assert line is not None
    row = line.vl_row[tick]
    old = tick - int(np.argmax(line.vl_row == row))
    return (
        f"tick {tick} of {len(line.time)}\nat {line.time[tick] - view.zero:.2f} s\n"
        f"reuses VL row {row},\n{old} {'tick' if old == 1 else 'ticks'} old"
    )


def prompt_blocks(view: LoadedRecording, params: Params, views: Sequence[str]) -> list[Block]:
    """The prompt of the episode's first VL row, or why it cannot be shown."""
    try:
        # The digest is left out: it does not change the prompt, and it would read every weight.
        spec = feature_spec(params.vlm, params.extract.dtype, views, lambda path: "")
        return show_prompt(view, params.vlm, spec)
    except PipelineError as error:
        return [Text(f"The prompt cannot be shown: {error}")]


def show_prompt(view: LoadedRecording, vlm: VLMParams, spec: FeatureSpec) -> list[Block]:
    """The prompt of the episode's first VL row: its tokens, and a table of images.

    Loads the checkpoint's tokenizer and settings, no weight. Raises `VLMError` where the checkpoint
    is not there or the instruction holds a control token, and `RecordingError` where the episode
    has no tick, no instruction or a frame that cannot be decoded.
    """
    if view.instruction is None or view.timeline is None:
        raise RecordingError(f"{view.recording.path}: has no instruction to read, or no tick")
    frames, broken = read_frames(view, [0])
    if broken:
        raise RecordingError(broken[0].message)
    preparer = Preparer(vlm, spec)
    row = preparer.prepare(view.instruction, {name: shown[0] for name, shown in frames.items()})
    size, starts = row.layout.grid[0] * row.layout.grid[1], dict(row.layout.image_starts)
    views = {place + start: name for name, start in starts.items() for place in range(size)}
    tokens = [
        (*preparer.describe(token), views.get(place))
        for place, token in enumerate(row.token_ids.tolist())
    ]
    pixels = "{} × {}".format(*spec.image_size)
    rows = [(name, "{} × {}".format(*frames[name][0].shape), pixels, size) for name in starts]
    heads = ("view", "recorded [pixels]", "for the model [pixels]", "image tokens")
    return [
        Text(f"{len(tokens):,} tokens, {len(views):,} of images."),
        Tokens(fold_tokens(tokens)),
        Table(heads, rows, "Image tokens by view; sizes are height × width"),
    ]


def fold_tokens(tokens: Sequence[tuple[str, TokenKind, str | None]]) -> list[TokenRun]:
    """Text as one run, special tokens one by one, those of an image folded to a count.

    A token is its text, its kind, and the view whose image it stands for.
    """
    folded: list[TokenRun] = []
    for (kind, view), like in groupby(tokens, lambda token: token[1:]):
        texts = [text for text, _, _ in like]
        if kind == "special":
            folded += [TokenRun(text, kind) for text in texts]
        elif kind == "image":
            folded.append(TokenRun(texts[0], kind, f"× {len(texts):,}, {view}"))
        else:
            folded.append(TokenRun("".join(texts), kind))
    return folded
