"""Fill a laid-out build with feature rows: taken over where they are known, else computed."""

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, joint_digest
from pipeline.extract.survey import Survey
from pipeline.extract.takeover import take_over
from pipeline.extract.work import Computed, Work
from pipeline.store import RowSource, StoreBuild

_DECIDES_SPEED = ("weights", "adapter", "processor", "compute_dtype", "variants")


@dataclass(frozen=True)
class ExtractionReport:
    """What was done."""

    store: Path
    rows: int
    taken: int
    """Rows taken over from an earlier store or build."""
    computed: int
    seconds: float
    """Of preparing, encoding and committing."""
    repeated: int = 0
    """Rows equal to another that was computed."""
    model_share: float | None = None
    """Of the time since the model was loaded, how much it worked; None where none was, here."""
    waited_share: float | None = None
    """Likewise, how much it waited for frames to be decoded and prepared."""


def fill(
    build: StoreBuild,
    surveyed: Survey,
    donors: Sequence[RowSource],
    params: Params,
    digests: ContentDigests,
    missing: NDArray[np.int64],
) -> ExtractionReport:
    """Fill in the missing rows: from donors where its frames are known, else by the model.

    `extract.workers` says whether this process has the model, or dask workers do.
    """
    begun = time.monotonic()
    rows = build.specs["vl/time"].shape[0]
    with (
        closing(RowSource(build.part)) as layout,
        tqdm(
            total=rows,
            initial=rows - len(missing),
            desc="extract",
            unit="row",
            disable=None,
            smoothing=0.05,
        ) as progress,
    ):
        by_digest = {one.digest: one.recording for one in surveyed.episodes}
        work = Work(
            build=build,
            spec=surveyed.spec,
            recordings=[by_digest[digest] for digest in layout.episode_digests],
            vl_start=layout.episode_edges("vl"),
            frame_time=build.files("vl/frame_time").read(0, rows),
            missing=missing,
            donors=donors,
            params=params,
            digests=digests,
            done=progress.update,
        )
        taken = take_over(work, layout)
        found = _computed(replace(work, missing=np.setdiff1d(missing, taken)))
    if found.rows_per_s is not None:
        digests.note_rate(rate_name(surveyed, params), found.rows_per_s)
    return ExtractionReport(
        store=build.target,
        rows=rows,
        taken=len(taken) + found.known,
        computed=found.computed,
        seconds=time.monotonic() - begun,
        repeated=found.repeated,
        model_share=found.model_share,
        waited_share=found.waited_share,
    )


def _computed(work: Work) -> Computed:
    if not len(work.missing):
        return Computed()
    # What holds the model takes seconds to import, dask one more: here alone they are needed.
    if work.params.extract.workers == 0:
        from pipeline.extract.local import compute_here

        return compute_here(work)
    from pipeline.extract.cluster import compute_on_cluster

    return compute_on_cluster(work)


def rate_name(surveyed: Survey, params: Params) -> str:
    """Under which name the speed of this model on these devices is remembered.

    Whatever else of the spec changes, such as prompt, slots or names of views, costs little.
    """
    extract, spec = params.extract, surveyed.spec.attrs()
    by = f" on {extract.workers}" if extract.workers != 0 else ""
    alike = {name: spec.get(name) for name in _DECIDES_SPEED} | {"views": len(spec["views"])}
    return f"{joint_digest(json.dumps(alike, sort_keys=True))} {extract.device}{by}"
