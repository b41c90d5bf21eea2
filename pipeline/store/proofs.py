"""What a probe found that fewer bytes would lose, kept beside the store that it read.

`<name>.zarr.proofs.json` has a verdict for each type of storage. A later extraction of the same
features into that type, in the same folder, copies the verdict into its store.
"""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from pipeline.base.digests import joint_digest
from pipeline.base.documents import Document, Text
from pipeline.base.errors import CheckpointIncomplete
from pipeline.base.files import OutputKind, read_document, refuse_foreign, write_with_digest
from pipeline.base.projection import slot_groups

SUFFIX = ".proofs.json"
PROOF = "proof"
"""The root's attribute of a store with a verdict."""


class Loss(Document):
    """What a type would lose of one group of slots."""

    of: Text
    """The group."""
    slots: Text
    """`slots_digest` of its slots."""
    r2: float
    """R^2 of the action with this type, minus that with the features in float32."""
    low: float | None = None
    high: float | None = None
    error_std: float
    """Root mean square change of a number, in standard deviations of its channel."""


class Proof(Document):
    """The verdict on one type, from so many recordings."""

    store: Text
    """The name of the store that was probed."""
    recordings: Annotated[int, Field(ge=0)]
    ticks: Annotated[int, Field(ge=0)]
    losses: list[Loss]

    def __str__(self) -> str:
        worst = min(self.losses, key=lambda loss: loss.r2)
        ends = "" if worst.low is None else f" ({worst.low:+.4f} to {worst.high:+.4f})"
        return (
            f"a probe of {self.recordings} recordings of {self.store} found that the R2 of the "
            f"features alone changes by {worst.r2:+.4f}{ends} from float32, at worst ({worst.of})"
        )


class Proofs(Document):
    """The content of the file."""

    features: Text
    """`features_digest` of the store."""
    types: dict[Text, Proof]


def features_digest(spec: Mapping[str, Any]) -> str:
    """The digest of a feature spec without how the features are stored, the slots and the variants.

    A probe reads plain frames alone.
    """
    but = {"digest", "storage_dtype", "pca", "slots", "variants", "augmentation"}
    kept = {name: value for name, value in spec.items() if name not in but}
    if "pca" in spec:
        kept["dim"] = spec["pca"]["of"]
    return joint_digest(json.dumps(kept, sort_keys=True))


def slots_digest(slots: Iterable[Mapping[str, Any]]) -> str:
    """The digest of the documents of a group's slots."""
    plain = [{k: v for k, v in slot.items() if k != "variant"} for slot in slots]
    return joint_digest(json.dumps(plain, sort_keys=True))


def stored_name(spec: Mapping[str, Any]) -> str:
    """How the features of a spec are stored, as `str` of `extract.dtype` names it."""
    stored = spec.get("storage_dtype", "float32")
    return f"pca {spec['dim']} in {stored}" if "pca" in spec else stored


def write_proofs(store: Path, spec: Mapping[str, Any], types: Mapping[str, Proof]) -> Path:
    """Write the verdicts beside a store of this spec, and keep earlier ones on other types.

    Raises `ConfigError` where something lies there that no probe wrote.
    """
    path, features = store.with_name(store.name + SUFFIX), features_digest(spec)
    refuse_foreign(path, _PROOFS)
    before = _read(path)
    kept = before.types if before is not None and before.features == features else {}
    content = Proofs(features=features, types={**kept, **types})
    write_with_digest(path, content.model_dump(mode="json"))
    return path


def find_proof(folder: Path, spec: Mapping[str, Any]) -> Proof | None:
    """The verdict in a folder of stores on how all groups of slots of a spec are stored."""
    groups = {*map(slots_digest, slot_groups(spec["slots"]))}
    features, name = features_digest(spec), stored_name(spec)
    for path in sorted(folder.glob(f"*.zarr{SUFFIX}")):
        proofs = _read(path)
        if proofs is not None and proofs.features == features and name in proofs.types:
            proof = proofs.types[name]
            losses = [loss for loss in proof.losses if loss.slots in groups]
            if len(losses) == len(groups):
                return proof.model_copy(update={"losses": losses})
    return None


def proof_of(attributes: Mapping[str, Any]) -> Proof | None:
    """The verdict in a store's attributes; None without one that can be read."""
    with suppress(ValueError):
        return Proof.model_validate(attributes.get(PROOF))
    return None


def storage_note(attributes: Mapping[str, Any]) -> str | None:
    """How a store keeps its features and what that loses, or how to find out; None for float32."""
    if (stored := stored_name(attributes["feature_spec"])) == "float32":
        return None
    command = "stages.probe with probe.codecs on a store in float32 says what that loses"
    return f"features are stored in {stored}; {proof_of(attributes) or command}"


def _read(path: Path) -> Proofs | None:
    with suppress(CheckpointIncomplete):
        return read_document(path, Proofs)[0]
    return None


_PROOFS = OutputKind("the verdicts of a probe", lambda path: _read(path) is not None)
