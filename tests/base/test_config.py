"""params.yaml: what is wrong is said at once, with its place."""

import shlex
from functools import partial
from pathlib import Path

import pytest

from pipeline.base.config import LimitsFile, load_params, load_section, setting
from pipeline.base.differences import differences
from pipeline.base.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]

MINIMAL = """
data: {sources: [{name: demo, path: raw}]}
vlm: {checkpoint: models/demo_vlm}
"""


@pytest.fixture
def minimal(tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text(MINIMAL)
    return path


def test_the_projects_own_params_are_valid():
    params = load_params(ROOT / "params.yaml")
    assert params.data.vlm_reuse_count == 3
    assert [source.name for source in params.data.sources] == ["raw", "new", "old", "lerobot"]


DEMO_ONLY = {
    "data.sources",
    # The demo's model is small and computes in float32 on a CPU, its frames are small.
    "vlm.dtype",
    "vlm.image_resize_height",
    "vlm.image_resize_width",
    # Its weights are random and must move further; a backward pass through it takes little memory.
    "finetune.lr",
    "finetune.tuning.gradient_checkpointing",
}
"""Keys that params.yaml sets otherwise than by default."""


def test_a_minimal_file_means_what_the_projects_own_says(minimal):
    """So that who begins with three lines gets the model, steps and slots of the documentation."""
    ours, theirs = (load_params(path).model_dump() for path in (ROOT / "params.yaml", minimal))
    assert differences(ours, theirs).keys() == DEMO_ONLY


def test_overrides_are_yaml_and_reach_any_depth(minimal):
    params = load_params(
        minimal,
        [
            "data.vlm_reuse_count=5",
            "data.action_hz=null",
            'data.sources=[{"name": "a", "path": ["x", "y/*"]}]',
            "train_head.mixture={a: 3}",
            "train_head.expert.dim=64",
            "vlm.prompt='{images} {instruction}'",
        ],
    )
    assert params.data.vlm_reuse_count == 5
    assert params.data.action_hz is None
    assert params.data.sources[0].paths == ("x", "y/*")
    assert params.train_head.mixture == {"a": 3.0}
    assert params.train_head.expert.dim == 64
    assert params.vlm.prompt == "{images} {instruction}"


def test_every_problem_is_said_with_its_place(minimal):
    with pytest.raises(ConfigError) as caught:
        load_params(minimal, ["train_head.lr=-1", "train_head.lrr=1", "data.vlm_reuse_count=0"])
    text = str(caught.value)
    assert "3 problem(s)" in text
    assert "train_head.lr: expected greater than 0, found -1" in text
    assert "train_head.lrr: unknown key; --keys lists" in text
    assert "data.vlm_reuse_count" in text


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("vlm.pooling=mean", "vlm.pooling: expected a list such as [a, b], found 'mean'"),
        ("lr=1", "expected section.key=value"),
        ("train_head.lr", "expected section.key=value"),
        ("data.sources=[", "cannot be read as YAML"),
        ("data.sources.path=x", "data.sources is a list"),
        ("a..b=1", "expected section.key=value"),
        ("extract.store=", "extract.store: expected a path, found None"),
        ("extract.store.name=x", "extract.store: expected a path, found keys with values"),
        ("data.action_hz=.nan", "data.action_hz: expected a finite number, found nan"),
        ("data.root=!!python/name:os.system", "could not determine a constructor"),
        ("serve.port=2026-01-01", "serve.port: expected a valid integer"),
        ("extract.workers=1000000", "extract.workers: expected a number of processes up to"),
        ("vlm.prompt='{picture}'", "only {instruction} and {images}"),
        ("vlm.prompt='{images}{images}'", "may stand once"),
        ("extract.store=cache_store/demo", "ends in .zarr"),
        ("data.sources=[{name: a, path: x}, {name: a, path: y}]", "stands more than once"),
        ("train_head.lr=yes", "train_head.lr: expected a number, found true or false"),
        ("train_head.diffusion={timesteps: 20, sampling_steps: 50}", "above timesteps 20"),
    ],
)
def test_what_is_refused(minimal, override, message):
    with pytest.raises(ConfigError) as caught:
        load_params(minimal, [override])
    text = str(caught.value)
    assert message in text
    assert len(text) < 2000
    assert text.isprintable() or "problem(s)\n" in text
    assert str(minimal) in text or text.startswith("--set ")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"data: [", "line 1, column 8: expected the node content"),
        (b"", "expected sections such as `data:`, found None"),
        (b"[" * 100_000, "cannot be read as YAML: RecursionError"),
        (b"data: {}\ndata: {}", "line 2, column 1: the key 'data' stands twice in one section"),
        (b"data: \xff", "ReaderError"),
    ],
)
def test_a_file_that_cannot_be_read_is_named_with_the_place_in_it(tmp_path, content, message):
    path = tmp_path / "broken.yaml"
    if content is not None:
        path.write_bytes(content)
    for load in (load_params, partial(load_section, section=LimitsFile)):
        with pytest.raises(ConfigError) as caught:
            load(path)
        text = str(caught.value)
        assert text.startswith(f"{path}: ") and message in text and len(text) < 1000
        assert "--params FILE" in text


@pytest.mark.parametrize("key", ["extract.store", "vlm.checkpoint", "inspect.path"])
def test_a_home_is_to_be_written_out(key):
    with pytest.raises(ConfigError, match=rf"{key}: ~ is not expanded; write {Path.home()}/x.zarr"):
        load_params(ROOT / "params.yaml", [f"{key}=~/x.zarr"])


def test_no_output_lies_inside_a_store():
    for place in ("a.zarr/vl/head.zarr", "b/a.zarr.part/x.zarr"):
        with pytest.raises(ConfigError, match=r"archive\.output: must not lie inside a store"):
            load_params(ROOT / "params.yaml", [f"archive.output={place}"])


def test_an_override_changes_one_of_the_sections_that_share_an_alias(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(MINIMAL + "extract: &x {device: cpu}\nevaluate: *x\n")
    params = load_params(path, ["extract.device=cuda"])
    assert (params.extract.device, params.evaluate.device) == ("cuda", "cpu")


def test_advice_typed_as_it_is_printed_gives_the_value(minimal):
    for path in ("a b/c", "1.5", "null", "2026-13-45", "{x}", "#x", "*x", "é/😀", "it's: x"):
        flag, override = shlex.split(setting("data.root", Path(path)))
        assert flag == "--set"
        assert load_params(minimal, [override]).data.root == Path(path)
        _, override = shlex.split(setting("data.views", ["View1", path]))
        assert load_params(minimal, [override]).data.views == ("View1", path)


def test_a_date_is_a_name(minimal):
    """Recorders name folders after days."""
    params = load_params(minimal, ["data.root=2025-11-03"])
    assert params.data.root == Path("2025-11-03")
