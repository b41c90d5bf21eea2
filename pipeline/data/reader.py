"""What every reader shares: which episode it is, and what the params say about it."""

import os
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

from pipeline.base.config import Source
from pipeline.data.media import RECORDINGS
from pipeline.data.recording import CameraStream, Recording


class FileRecording(Recording):
    """A recording that knows its source's overrides and the view filter."""

    def __init__(self, path: Path, source: Source, views: Sequence[str] | None) -> None:
        self.path = path
        self.id = path.name
        self.source = source.name
        self._overrides = source
        self._views = None if views is None else frozenset(views)

    # Read on first use: the old format keeps it in the pickle, which opening leaves closed.
    @cached_property
    def instruction(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The source's instruction, else the recording's own."""
        if self._overrides.instruction is not None:
            return self._overrides.instruction
        return self._recorded_instruction()

    def cameras(self) -> Mapping[str, CameraStream]:
        return {view: camera for view, camera in self._cameras().items() if self._wants(view)}

    def view_names(self) -> Sequence[str]:
        return [view for view in self.all_views() if self._wants(view)]

    @abstractmethod
    def all_views(self) -> Sequence[str]:
        """Names of the views before the filter, without reading any numeric stream."""

    @abstractmethod
    def _recorded_instruction(self) -> str: ...

    @abstractmethod
    def _cameras(self) -> Mapping[str, CameraStream]: ...

    def _wants(self, view: str) -> bool:
        return self._views is None or view in self._views


def entries(folder: Path) -> list[os.DirEntry[str]]:
    """What is in a folder; `RecordingError` where it cannot be listed."""
    with RECORDINGS.foreign(folder, "cannot be listed"), os.scandir(folder) as found:
        return list(found)


def absolute(path: Path) -> Path:
    """The path made absolute without following symbolic links."""
    return Path(os.path.abspath(path))


def natural_key(text: str | Path) -> list[tuple[int, int, str]]:
    """Sorts `View2` before `View10`."""
    parts = re.split(r"(\d+)", str(text))
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]
