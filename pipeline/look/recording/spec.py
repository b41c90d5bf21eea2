"""The feature spec of params, without reading a large checkpoint again at every look."""

import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tqdm import tqdm

from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec

LEDGER = ".files.sqlite"
"""In `inspect.output`, where extraction has none yet."""


def remembered_spec(params: Params, views: Sequence[str]) -> FeatureSpec:
    """The spec of features that `params` give for these views.

    A checkpoint is read whole for its digest, which takes seconds a gigabyte, and after that only
    where a file of it has changed: digests are remembered in the ledger of `digest_ledger`. Raises
    `VLMError` where the checkpoint is not there or incomplete.
    """
    with (
        closing(ContentDigests(digest_ledger(params))) as digests,
        tqdm(desc="digest of the checkpoint", unit="file", disable=None, leave=False) as bar,
    ):

        def digest(path: Path) -> str:
            bar.update()
            return digests.of(path)

        return feature_spec(params.vlm, params.extract.dtype, views, digest)


def digest_ledger(params: Params) -> Path:
    """The ledger beside `extract.store` where extraction keeps one, else one in `inspect.output`.

    Looking makes no file beside stores: whoever only looks may have none, or may not write there.
    """
    shared = ledger_path(params.extract.store)
    if shared.is_file() and os.access(shared, os.W_OK) and os.access(shared.parent, os.W_OK):
        return shared
    return params.inspect.output / LEDGER
