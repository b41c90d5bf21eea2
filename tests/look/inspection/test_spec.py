"""The spec of a checkpoint is found without reading what was read before."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base import digests
from pipeline.base.config import Params, load_params
from pipeline.look.recording.spec import LEDGER, digest_ledger, remembered_spec

PARAMS = Path(__file__).resolve().parents[3] / "params.yaml"


@pytest.fixture
def params(demo_checkpoint: Path, tmp_path: Path) -> Params:
    return load_params(
        PARAMS,
        [
            f"vlm.checkpoint={demo_checkpoint}",
            f"inspect.output={tmp_path / 'pages'}",
            f"extract.store={tmp_path / 'stores' / 'one.zarr'}",
        ],
    )


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files whose content is read for a digest."""
    found: list[Path] = []
    really: Callable[[Path], str] = digests.file_digest

    def counted(path: Path) -> str:
        found.append(path)
        return really(path)

    monkeypatch.setattr(digests, "file_digest", counted)
    return found


def test_a_checkpoint_is_read_once(params: Params, read: list[Path], tmp_path: Path) -> None:
    first = remembered_spec(params, ["View1"])
    assert any(path.suffix == ".safetensors" for path in read)
    read.clear()
    assert remembered_spec(params, ["View1"]) == first
    assert read == []
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [LEDGER]


def test_what_extraction_has_read_is_not_read_again(
    params: Params, read: list[Path], tmp_path: Path
) -> None:
    ledger = tmp_path / "stores" / "one.zarr.files.sqlite"
    known = digests.ContentDigests(ledger)
    for path in params_files(params):
        known.of(path)
    known.close()
    read.clear()
    assert digest_ledger(params) == ledger
    remembered_spec(params, ["View1"])
    assert read == [] and not (tmp_path / "pages").exists()


def params_files(params: Params) -> list[Path]:
    return [path for path in Path(params.vlm.checkpoint).iterdir() if path.is_file()]
