"""The verdict on a type of storage finds the stores of the same features, and no others."""

from pathlib import Path

import pytest

from pipeline.base.errors import ConfigError
from pipeline.store.proofs import Loss, Proof, find_proof, proof_of, slots_digest, write_proofs


def slots(*poolings: str, cells: int = 1) -> list[dict]:
    return [
        {"layer": 3, "norm": True, "pooling": pooling, "cell": [0, cell]}
        for pooling in poolings
        for cell in range(cells)
    ]


BOTH = slots("mean", "grid")
WHOLE = {"digest": "a", "weights": "w", "dim": 128, "storage_dtype": "float32", "slots": BOTH}
INT8 = WHOLE | {"digest": "b", "storage_dtype": "int8"}
FEW = WHOLE | {"dim": 32, "storage_dtype": "int8", "pca": {"of": 128, "basis": "c"}}
MEAN, GRID = (slots_digest(slots(pooling)) for pooling in ("mean", "grid"))
PROOF = Proof(
    store="whole.zarr",
    recordings=24,
    ticks=500,
    losses=[
        Loss(of="layer 3, mean", slots=MEAN, r2=0.001, low=-0.001, high=0.002, error_std=0.01),
        Loss(of="layer 3, grid", slots=GRID, r2=-0.004, low=-0.009, high=0.0, error_std=0.02),
    ],
)


def test_a_verdict_is_found_by_the_features_and_their_type(tmp_path: Path) -> None:
    write_proofs(tmp_path / "whole.zarr", WHOLE, {"int8": PROOF})
    path = write_proofs(tmp_path / "whole.zarr", WHOLE, {"pca 32 in int8": PROOF})
    assert path == tmp_path / "whole.zarr.proofs.json"
    assert find_proof(tmp_path, INT8) == find_proof(tmp_path, FEW) == PROOF
    assert find_proof(tmp_path, FEW | {"dim": 16}) is None
    assert find_proof(tmp_path, INT8 | {"weights": "others"}) is None
    # A store of augmented variants repeats its slots.
    twice = [slot | {"variant": variant} for variant in range(2) for slot in slots("mean")]
    varied = INT8 | {"slots": twice, "variants": 2, "augmentation": {"shift": 0.1}}
    assert find_proof(tmp_path, varied) is not None
    # Of many probed groups, the store may keep some, but no other.
    chosen = find_proof(tmp_path, INT8 | {"slots": slots("mean")})
    assert chosen is not None
    assert chosen.losses == PROOF.losses[:1]
    for other in (slots("last"), slots("grid", cells=4), slots("mean", "last")):
        assert find_proof(tmp_path, INT8 | {"slots": other}) is None
    assert str(PROOF) == (
        "a probe of 24 recordings of whole.zarr found that the R2 of the features alone changes by "
        "-0.0040 (-0.0090 to +0.0000) from float32, at worst (layer 3, grid)"
    )
    assert proof_of({"proof": PROOF.model_dump(mode="json")}) == PROOF
    assert proof_of({}) is proof_of({"proof": {"recordings": "many"}}) is None

    write_proofs(tmp_path / "whole.zarr", WHOLE | {"weights": "others"}, {"int8": PROOF})
    assert find_proof(tmp_path, INT8) is None


def test_nothing_else_is_written_over(tmp_path: Path) -> None:
    mine = tmp_path / "whole.zarr.proofs.json"
    mine.write_text('{"my": "notes"}')
    assert find_proof(tmp_path, INT8) is None
    with pytest.raises(ConfigError, match="expected nothing there or the verdicts of a probe"):
        write_proofs(tmp_path / "whole.zarr", WHOLE, {"int8": PROOF})
    assert mine.read_text() == '{"my": "notes"}'
