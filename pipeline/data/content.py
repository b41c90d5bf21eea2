"""What a recording's files hold, as one digest: equal content means equal streams."""

import json
import os
from collections.abc import Callable
from pathlib import Path

from pipeline.base.digests import joint_digest
from pipeline.data.recording import Recording


def content_digest(recording: Recording, digest_of: Callable[[Path], str]) -> str:
    """Digest of a recording's files, wherever they lie; `digest_of` gives that of one file.

    Raises `RecordingError`, and what `digest_of` raises where a file cannot be read.
    """
    # Frame times stand in file names, so a name is content too; where the folder lies is not.
    named = ((os.path.relpath(file, recording.path), digest_of(file)) for file in recording.files())
    return joint_digest(recording.identity(), json.dumps(sorted(named)))
