"""The verdict on a type of storage finds the stores of the same features, and no others."""

from pathlib import Path

import pytest

from pipeline.base.errors import ConfigError
from pipeline.store.proofs import Loss, Proof, find_proof, proof_of, write_proofs

WHOLE = {"digest": "a", "weights": "w", "dim": 128, "storage_dtype": "float32"}
INT8 = WHOLE | {"digest": "b", "storage_dtype": "int8"}
FEW = WHOLE | {"dim": 32, "storage_dtype": "int8", "pca": {"of": 128, "basis": "c"}}
PROOF = Proof(
    recordings=24,
    ticks=500,
    losses=[
        Loss(of="layer 3, mean", r2=0.001, low=-0.001, high=0.002, error_std=0.01),
        Loss(of="layer 3, grid", r2=-0.004, low=-0.009, high=0.0, error_std=0.02),
    ],
)
GROUPS = ["layer 3, mean", "layer 3, grid"]


def test_a_verdict_is_found_by_the_features_and_their_type(tmp_path: Path) -> None:
    write_proofs(tmp_path / "whole.zarr", WHOLE, {"int8": PROOF})
    path = write_proofs(tmp_path / "whole.zarr", WHOLE, {"pca 32 in int8": PROOF})
    assert path == tmp_path / "whole.zarr.proofs.json"
    assert find_proof(tmp_path, INT8, GROUPS) == find_proof(tmp_path, FEW, GROUPS) == PROOF
    assert find_proof(tmp_path, FEW | {"dim": 16}, GROUPS) is None
    assert find_proof(tmp_path, INT8 | {"weights": "others"}, GROUPS) is None
    # Of many probed groups, the store may keep some, but no other.
    chosen = find_proof(tmp_path, INT8 | {"slots": ["mean alone"]}, GROUPS[:1])
    assert chosen is not None
    assert chosen.losses == PROOF.losses[:1]
    assert find_proof(tmp_path, INT8, ["layer 3, last"]) is None
    assert str(PROOF) == (
        "a probe of 24 recordings found -0.0040 (-0.0090 to +0.0000) in R2 beside float32, at "
        "worst (layer 3, grid)"
    )
    assert proof_of({"proof": PROOF.model_dump(mode="json")}) == PROOF
    assert proof_of({}) is proof_of({"proof": {"recordings": "many"}}) is None

    write_proofs(tmp_path / "whole.zarr", WHOLE | {"weights": "others"}, {"int8": PROOF})
    assert find_proof(tmp_path, INT8, GROUPS) is None


def test_nothing_else_is_written_over(tmp_path: Path) -> None:
    mine = tmp_path / "whole.zarr.proofs.json"
    mine.write_text('{"my": "notes"}')
    assert find_proof(tmp_path, INT8, GROUPS) is None
    with pytest.raises(ConfigError, match="expected nothing there or the verdicts of a probe"):
        write_proofs(tmp_path / "whole.zarr", WHOLE, {"int8": PROOF})
    assert mine.read_text() == '{"my": "notes"}'
