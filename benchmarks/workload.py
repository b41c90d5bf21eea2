"""What contenders of the extraction benchmark are given: the same recordings, rows and decoder."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests
from pipeline.data import Recording
from pipeline.data.row_range import RowRange
from pipeline.extract.check import CheckedEpisode, check_episodes
from pipeline.extract.layout import build_arrays, lay_out
from pipeline.extract.rows import spans_of
from pipeline.extract.survey import Survey, survey
from pipeline.simulation.demo_recordings import TASK
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import RowSource, StoreBuild
from pipeline.vlm.preparation import Preparer

ROWS_AN_EPISODE = 18
"""At least: a demonstration has 20 to 30 VL rows."""

_EXTRA_VIEWS = {"View3": "View1", "View4": "View2"}
"""Views that the demo lacks, and the ones that they mirror: the same frame would be seen once."""

Frames = Mapping[str, NDArray[np.uint8]]


@dataclass(frozen=True)
class Workload:
    """Recordings on disk, and what stage one says of them before it needs the model."""

    params: Params
    survey: Survey
    checked: Sequence[CheckedEpisode]
    digests: ContentDigests
    missing: NDArray[np.int64]
    """The VL rows to compute."""
    recordings: Sequence[Recording]
    """In the store's order."""
    vl_start: NDArray[np.int64]
    frame_time: NDArray[np.float64]

    @classmethod
    def of(cls, params: Params, rows: int, digests: ContentDigests) -> "Workload":
        """The first `rows` VL rows of the recordings of `params`."""
        surveyed = survey(params, digests)
        checked, bad = check_episodes(surveyed, params)
        assert not bad, bad
        with closing(_laid_out(params, surveyed, checked)) as build:
            layout = RowSource(build.part)
            vl_start = layout.episode_edges("vl")
            by_digest = {one.digest: one.recording for one in surveyed.episodes}
            recordings = [by_digest[digest] for digest in layout.episode_digests]
            layout.close()
            frame_time = build.files("vl/frame_time").read(0, int(vl_start[-1]))
        assert rows <= len(frame_time), f"expected {rows} VL rows, found {len(frame_time)}"
        missing = np.arange(rows)
        return cls(params, surveyed, checked, digests, missing, recordings, vl_start, frame_time)

    def fresh_build(self) -> StoreBuild:
        """A build with everything but feature rows, in place of the one before."""
        return _laid_out(self.params, self.survey, self.checked)

    def spans(self) -> Iterator[RowRange]:
        """The rows in spans, as stage one cuts them."""
        views = self.survey.spec.views
        return spans_of(self.recordings, self.vl_start, self.frame_time, views, self.missing, 1)

    def read(self) -> Iterator[tuple[str, Frames]]:
        """Instruction and decoded frames of each row, in line."""
        for span in self.spans():
            for _, frames in span.read():
                yield span.recording.instruction, frames

    def text_tokens(self) -> int:
        """Tokens of the first row that are not an image's."""
        instruction, frames = next(self.read())
        layout = Preparer(self.params.vlm, self.survey.spec).prepare(instruction, frames).layout
        return layout.length - len(layout.image_tokens())

    def distinct_share(self) -> float:
        """How many of the frames differ: a frame that comes twice need not be encoded twice."""
        hashes = [hash(frame.tobytes()) for _, row in self.read() for frame in row.values()]
        return len(set(hashes)) / len(hashes)


def _laid_out(params: Params, surveyed: Survey, checked: Sequence[CheckedEpisode]) -> StoreBuild:
    build = StoreBuild(params.extract.store, build_arrays(checked, surveyed, params), surveyed.plan)
    shutil.rmtree(build.part, ignore_errors=True)
    lay_out(build, checked, surveyed, params, [])
    return build


def params_of(folder: Path, device: str, vlm: dict[str, Any]) -> Params:
    """Params of an extraction of the recordings in `folder` into a store there, mean-pooled."""
    document = {
        "data": {
            "root": str(folder / "recordings"),
            "sources": [{"name": "raw", "path": "raw"}],
        },
        "vlm": {"checkpoint": str(folder / "vlm"), "pooling": ["mean"]} | vlm,
        "extract": {"store": str(folder / "store.zarr"), "device": device},
    }
    return Params.model_validate(document)


def write_recordings(
    folder: Path, rows: int, views: int = 3, size: tuple[int, int] | None = None
) -> None:
    """Write simulated insertions in the raw format that make at least `rows` VL rows.

    `size` is the height and width of frames, else the simulation's; views are 3, 4 or 5.
    """
    task = folder / "recordings" / "raw" / TASK
    episodes = -(-rows // ROWS_AN_EPISODE)
    for seed in tqdm(range(episodes), "recordings", unit="episode", disable=None):
        write_raw(task, simulate_episode(seed, 1.7e9 + 60 * seed))
    for episode in task.iterdir():
        for name, seen in list(_EXTRA_VIEWS.items())[: views - 3]:
            _mirror(episode / seen, episode / name)
        if size is not None:
            _enlarge(episode, size)


def _mirror(view: Path, mirrored: Path) -> None:
    mirrored.mkdir()
    for file in view.iterdir():
        ImageOps.mirror(Image.open(file)).save(mirrored / file.name, quality=90)


def _enlarge(episode: Path, size: tuple[int, int]) -> None:
    height, width = size
    for file in episode.glob("View*/*.jpg"):
        image = Image.open(file).resize((width, height), Image.Resampling.BICUBIC)
        image.save(file, quality=90)
