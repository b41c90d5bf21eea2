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
from pipeline.data.episode import RowFrames, RowRange
from pipeline.extract.engine import RANGE_ROWS
from pipeline.extract.streams import build_arrays, lay_out
from pipeline.extract.survey import CheckedEpisode, Survey, sound_episodes, survey
from pipeline.simulation.demo_recordings import TASK
from pipeline.simulation.insertion_formats import write_raw
from pipeline.simulation.recorder import simulate_episode
from pipeline.store import StoreBuild
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
    frames: RowFrames

    @classmethod
    def of(cls, params: Params, rows: int, digests: ContentDigests) -> "Workload":
        """The first `rows` VL rows of the recordings of `params`."""
        surveyed, checked = sound_episodes(survey(params, digests), digests)
        with closing(_laid_out(surveyed, checked)) as build:
            vl_start, frame_time = (
                build.files(name).read(0, build.specs[name].shape[0])
                for name in ("episode/vl_start", "vl/frame_time")
            )
        assert rows <= len(frame_time), f"expected {rows} VL rows, found {len(frame_time)}"
        frames = RowFrames(surveyed.recordings, vl_start, frame_time, surveyed.spec.views)
        return cls(params, surveyed, checked, digests, np.arange(rows), frames)

    def fresh_build(self) -> StoreBuild:
        """A build with everything but feature rows, in place of the one before."""
        return _laid_out(self.survey, self.checked)

    def ranges(self) -> Iterator[RowRange]:
        """The rows in ranges, as stage one cuts them."""
        return self.frames.ranges(self.missing, RANGE_ROWS)

    def read(self) -> Iterator[tuple[str, Frames]]:
        """Instruction and decoded frames of each row, in line."""
        for rows in self.ranges():
            for _, frames in rows.read():
                yield rows.recording.instruction, frames

    def text_tokens(self) -> int:
        """Tokens of the first row that are not an image's."""
        instruction, frames = next(self.read())
        layout = Preparer(self.params.vlm, self.survey.spec).prepare(instruction, frames).layout
        return layout.length - len(layout.image_tokens())

    def distinct_share(self) -> float:
        """How many of the frames differ: a frame that comes twice need not be encoded twice."""
        hashes = [hash(frame.tobytes()) for _, row in self.read() for frame in row.values()]
        return len(set(hashes)) / len(hashes)


def _laid_out(surveyed: Survey, checked: Sequence[CheckedEpisode]) -> StoreBuild:
    build = StoreBuild(surveyed.target, build_arrays(checked, surveyed), surveyed.plan)
    shutil.rmtree(build.part, ignore_errors=True)
    lay_out(build, checked, surveyed, [])
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
