"""What a command has read or made, and what it should have; and when a refusal is clear.

What has digests of its own (stores, archives, heads), and a recording whose change says so, must
come out as it was written; that readers read what stands there is checked in tests/data. Features
may be others where they are called by another name.
"""

import json
import pickle
import re
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import StoreIncomplete
from pipeline.data import RecordedAction
from pipeline.extract.survey import sound_episodes, survey
from pipeline.policy import checkpoint as checkpoints
from pipeline.store import FeatureStore
from pipeline.store.verification import verify
from pipeline.train.training_data import check_store
from tests.fuzz.corpus import STORE
from tests.fuzz.mutations import Change

if TYPE_CHECKING:
    from tests.fuzz.cases import Case

Episode = dict[str, Any]
"""Its streams, frames and texts, by name."""
read: Any = None
"""What `read_all` or `load_head` read in this process."""

# --- the parts of commands that read -------------------------------------------------------------


def read_all(params: Any) -> None:
    """Survey and check recordings as extraction does, and then read all streams and all frames."""
    global read
    with closing(ContentDigests(ledger_path(params.extract.store))) as digests:
        surveyed, _ = sound_episodes(survey(params, digests), digests)
    recordings = surveyed.recordings
    read = {recording.id.rpartition("/")[2]: _episode(recording) for recording in recordings}


def _episode(recording: Any) -> Episode:
    episode: Episode = {"instruction": recording.instruction}
    for name in ("state", "sensor", "action"):
        if (stream := getattr(recording, name)()) is not None:
            episode |= {f"{name}.time": stream.time, f"{name}.values": stream.values}
            channels = stream.channels
            episode |= {f"{name}.names": channels.names, f"{name}.units": channels.units}
            if isinstance(stream, RecordedAction):
                episode["action.rate_hz"] = [stream.rate_hz]
    for view, camera in recording.cameras().items():
        episode[f"frames.{view}"] = list(camera.read(range(len(camera.time))))
        episode[f"frames.{view}.time"] = camera.time
    return episode


def load_head(params: Any) -> None:
    """Load a head, as an evaluation begins."""
    global read
    folder = checkpoints.find_policy(params.evaluate.checkpoint)
    checkpoint = checkpoints.load_policy(folder)
    check_store(checkpoint, FeatureStore.open(params.evaluate.store))
    weights = {name: tensor.numpy() for name, tensor in checkpoint.policy().state_dict().items()}
    document = json.loads((folder / "policy.json").read_bytes())
    digests = document["weights_sha256"], (document.get("golden") or {}).get("sha256")
    said = json.loads(json.dumps(checkpoint.document(*digests)))
    read = {"document": said, "weights": weights}


# --- what came out -------------------------------------------------------------------------------


def result(case: "Case") -> Any:
    """What a command that ended with 0 has read or made."""
    return read if case.stage in ("read", "load") else _arrays(case.folder / STORE)


def _arrays(store: Path) -> dict[str, Any]:
    """Every array of a store and what its attributes say, as plain zarr reads them.

    Raises where its own readers refuse it.
    """
    FeatureStore.open(store)
    if not (checked := verify(store)).sound:
        raise StoreIncomplete("; ".join(checked.lines()))
    group = zarr.open_group(store, mode="r")
    kept = group.attrs.asdict()
    for of_a_run in ("metadata_digest", "plan", "environment"):
        kept.pop(of_a_run, None)
    members = group.members(max_depth=None)
    arrays = {path: array[:] for path, array in members if hasattr(array, "shape")}
    return arrays | {"attributes": json.loads(json.dumps(kept))}


# --- what should have come out -------------------------------------------------------------------


def judge(case: "Case", change: Change) -> str:
    """What is not as the files have it; empty where all is right."""
    found = result(case)
    if case.whole and not case.baseline.exists():
        case.baseline.write_bytes(pickle.dumps(found))
    before = pickle.loads(case.baseline.read_bytes())
    why = difference(case, found, before)
    if not why:
        return ""
    # Of a data set, episodes whose files are not there are reported and passed over, whatever
    # stands in the place of a file.
    told = case.thing.startswith("lerobot") and change.path.suffix in (".parquet", ".mp4")
    excepted = told and not change.path.is_file()
    if change.permits in ("same", "refuse") and not excepted:
        return f"gave other data than before: {why}"
    return _taken(case, found, before, change, why)


def difference(case: "Case", found: Any, before: Any) -> str:
    """The first place at which two results differ; empty where they do not."""
    if case.subject.kind in ("VLM folders", "adapters"):  # their digest is of the bytes of files
        return differ("features", before["vl/features"], found["vl/features"])
    return differ("", before, found)


def _taken(case: "Case", found: Any, before: Any, change: Change, why: str) -> str:
    """What should not have been taken from a changed file."""
    strange = f"{change.key} is of a strange type and was taken" * (change.permits == "type")
    match case.subject.kind:
        case "VLM folders" | "adapters":
            if not np.isfinite(found["vl/features"]).all():
                return "features are not finite"
            digests = [one["attributes"]["feature_spec"]["digest"] for one in (found, before)]
            if digests[0] == digests[1]:
                return "other features go by the same name"
            return strange
        case "recordings":
            return ""
        case _:
            return why


def differ(where: str, said: Any, taken: Any) -> str:
    """The first place at which two documents of objects, lists, arrays and values differ."""
    if isinstance(said, np.ndarray):
        same = said.shape == np.shape(taken) and np.array_equal(said, taken, equal_nan=True)
        return "" if same else f"{where} holds other numbers"
    if isinstance(said, dict) and isinstance(taken, dict):
        if strange := sorted(said.keys() ^ taken.keys()):
            return f"{where}.{strange[0]} was taken, or was said, but not both"
        pairs = {key: (said[key], taken[key]) for key in said}
    elif isinstance(said, list | tuple) and isinstance(taken, list | tuple):
        if len(said) != len(taken):
            return f"{where}: {len(taken)} of {len(said)} entries were taken"
        pairs = dict(enumerate(zip(said, taken, strict=True)))
    else:
        same = type(said) is type(taken) and (said == taken or said != said)
        return "" if same else f"{where}: {said!r:.80} was taken as {taken!r:.80}"
    wrong = (differ(f"{where}.{key}", *pair) for key, pair in pairs.items())
    return next(filter(None, wrong), "")


# --- when a refusal is clear ---------------------------------------------------------------------

MOST = 2000
"""Characters of a message."""
MEND = re.compile(
    r"(?:^|[.;:,)]\s+|\(|\n\s*|\b(?:or|and|then|please|to) )"
    r"(add|copy|correct|convert|choose|cut|delete|download|drop|export|extract|free|give|have|keep|"
    r"leave|look|make|mend|move|name|pass|pick|put|read|remove|rename|replace|re-?run|restore|run|"
    r"save|say|set|sort|split|take|train|try|turn|unpack|upgrade|use|wait|write)\b",
    re.IGNORECASE,
)
"""A sentence that begins with what to do, in the imperative."""
FOREIGN = re.compile(
    r"Traceback|(Error|Exception)\(|MemoryError|object at 0x|<class '|allow_pickle|above report|"
    r"trust_remote_code|weights_only|errors\.pydantic\.dev|NoneType"
)
"""What speaks of the code and not of the file, or advises to open it unsafely."""


def unclear(stderr: str, change: Change, case: "Case") -> str:
    """What a message lacks; empty where it is clear: one that names the file and what to do."""
    text = stderr.strip()
    if not text.startswith("error: ") or len(re.findall(r"^error: ", text, re.MULTILINE)) != 1:
        return "not one message that begins with `error: `"
    if len(text) > MOST:
        return f"{len(text)} characters"
    if strange := FOREIGN.search(text):
        return f"speaks of {strange[0]}"
    if not MEND.search(text.removeprefix("error: ")):
        return "does not say what to do"
    return "" if _names(text, change, case) else f"does not name {change.path.name}"


def _names(text: str, change: Change, case: "Case") -> bool:
    """Whether a message names the changed file.

    Of a file that is still one of its kind, it may name another file of the same thing, which the
    first contradicts; of a store's file the folder of its array.
    """
    name = change.path.name.encode("utf-8", "backslashreplace").decode()
    if (len(name) > 1 and name in text) or repr(change.path.name)[1:-1] in text.split("/"):
        return True
    match case.subject.kind:
        case "stores" | "archives":
            above = [path for path in change.path.parents if path.is_relative_to(case.place)]
            return any(str(path) in text for path in above if path != case.place)
        case _:
            return change.sound and case.place.name in text
