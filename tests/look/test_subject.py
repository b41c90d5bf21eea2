"""What a path means, and what is said of one that means nothing."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.config import Params, load_params
from pipeline.base.errors import ConfigError
from pipeline.look.subject import subject_of

PARAMS = Path(__file__).resolve().parents[2] / "params.yaml"


def looking_at(*paths: object, output: Path | None = None) -> Params:
    said = ", ".join(f'"{path}"' for path in paths)
    more = [] if output is None else [f"inspect.output={output}"]
    return load_params(PARAMS, [f"inspect.path=[{said}]", *more])


def refused(*paths: object) -> str:
    with pytest.raises(ConfigError) as caught:
        subject_of(looking_at(*paths))
    return str(caught.value)


def test_without_a_path_it_is_the_sources_of_the_params() -> None:
    params = load_params(PARAMS)
    subject = subject_of(params)
    assert subject.sources == params.data.sources and subject.root == params.data.root
    assert subject.folder == Path("reports/inspect")


def test_a_path_that_means_nothing_is_told_what_it_is(tmp_path: Path) -> None:
    assert f"found nothing at {tmp_path / 'monday/run'}" in refused(tmp_path / "monday" / "run")
    (tmp_path / "run.zip").write_bytes(b"")
    assert f"found the file {tmp_path / 'run.zip'}" in refused(tmp_path / "run.zip")


def test_a_store_is_known_by_its_content(tmp_path: Path, tiny_store: Callable[..., Path]) -> None:
    store = tiny_store(tmp_path)
    renamed = store.rename(tmp_path / "copy of a store")
    assert subject_of(looking_at(renamed)).store == renamed


def test_every_path_has_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in ("lab/day 1/run", "lab/day2/run"):
        (tmp_path / place).mkdir(parents=True)
    folders = [
        subject_of(looking_at(*paths)).folder.as_posix()
        for paths in (["lab/day 1/run"], ["lab/day2/run"], ["lab/*"], ["."], ["lab", "lab/day2"])
    ]
    base = "reports/inspect"
    assert folders == [
        f"{base}/lab_day_1_run",
        f"{base}/lab_day2_run",
        f"{base}/lab_any",
        f"{base}/here",
        f"{base}/lab_and_1_more",
    ]
    assert subject_of(looking_at("lab", output=Path("mine"))).folder == Path("mine")
    for place in ("데이터", "실험"):
        (tmp_path / place).mkdir()
        assert subject_of(looking_at(place)).folder == Path("reports/inspect", place)
