"""What is said to run about a damaged store acts on that very store."""

from pathlib import Path

import pytest

from pipeline.store.border import mend, restore_command, start_over
from pipeline.store.paths import read_plan


@pytest.mark.parametrize("inside", ["", "zarr.json", "vl/features/c/0/0/0"])
def test_a_store_is_repaired_and_extracted_by_name(inside: str) -> None:
    said = mend(Path("some/my store.zarr") / inside)
    assert "stages.verify --repair --set 'verify.store=some/my store.zarr'" in said
    assert "stages.extract" not in said, "it would replace a store that the params do not describe"
    assert ".part" not in said


def test_a_build_is_removed_and_begun_anew() -> None:
    said = mend(Path("some/a.zarr.part/vl/key/c/0/0"))
    assert "python -m stages.store gc some/a.zarr.part --remove" in said
    assert said.endswith("python -m stages.extract --set extract.store=some/a.zarr.")
    assert "--repair" not in said


def test_a_build_that_was_set_aside_is_removed_alone() -> None:
    said = mend(Path("some/a.zarr.part/.known/3/vl/key/c/0/0"))
    assert said.startswith("Remove some/a.zarr.part/.known/3, then run python -m stages.extract")


def test_a_name_of_another_kind_is_taken_as_it_is() -> None:
    assert "verify.store=copy," in mend(Path("copy"))


def test_where_the_root_is_lost_all_say_the_same(tmp_path: Path) -> None:
    for name in ("a.zarr", "a.zarr.part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "zarr.json").write_text("{")
        with pytest.raises(RuntimeError) as caught:
            read_plan(tmp_path / name)
        assert start_over(tmp_path / name) in str(caught.value)


def test_an_archive_is_restored_to_a_store_beside_it() -> None:
    for archive, store in (("x/a.archive.zarr", "x/a.zarr"), ("x/a.zarr", "x/a.restored.zarr")):
        said = restore_command(Path(archive))
        assert said.endswith(f"--set archive.output={archive} --set archive.store={store}")
