"""Section of looking: at recordings, and at a store."""

from pathlib import Path

from pydantic import Field

from pipeline.base.config.section import Section, Seed
from pipeline.base.config.stage_one import RecordingFormat


class InspectParams(Section):
    """What is looked at, and how much of it is shown."""

    path: str | tuple[str, ...] | None = None
    """Recordings, folders or globs of them, or a store; the recordings of `data.sources` where
    null or none. Ticks, views and the feature spec follow the sections `data` and `vlm`."""
    format: RecordingFormat = "auto"
    """Of the recordings at `path`."""
    episodes: int = Field(default=3, ge=1)
    """Episodes drawn in detail, evenly spread and those with the worst findings first; every one is
    checked."""
    ticks: int = Field(default=5, ge=1)
    """Instants of an episode at which its views are shown."""
    samples: int = Field(default=5, ge=1)
    """Training samples shown side by side."""
    points: int = Field(default=4000, ge=100)
    """VL rows of a store that pictures show at most, evenly spread."""
    seed: Seed = 0
    """Of the choice of samples."""
    output: Path = Path("reports/inspect")
    """Folder of the page and its pictures. Where it is not given, what `path` names has a folder of
    its own in reports/inspect, so that one inspection leaves another's page alone."""
