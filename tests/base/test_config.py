"""params.yaml: what is wrong is said at once, with its place."""

from pathlib import Path

import pytest

from pipeline.base.config import load_params
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
    ours, theirs = (
        _flat(load_params(path).model_dump()) for path in (ROOT / "params.yaml", minimal)
    )
    assert {key for key in ours | theirs if ours.get(key) != theirs.get(key)} == DEMO_ONLY


def _flat(section, above=""):
    """Values by their full keys."""
    if not isinstance(section, dict):
        return {above: section}
    return {
        key: value
        for name, inner in section.items()
        for key, value in _flat(inner, f"{above}.{name}" if above else name).items()
    }


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


def test_one_value_where_a_list_belongs_is_told_how_to_write_it(minimal):
    with pytest.raises(ConfigError, match=r"pooling: expected a list, such as \[mean\]"):
        load_params(minimal, ["vlm.pooling=mean"])


def test_every_problem_is_said_with_its_place(minimal):
    with pytest.raises(ConfigError) as caught:
        load_params(minimal, ["train_head.lr=-1", "train_head.lrr=1", "data.vlm_reuse_count=0"])
    text = str(caught.value)
    assert "3 problem(s)" in text
    assert "train_head.lr: Input should be greater than 0 (found -1)" in text
    assert "train_head.lrr: unknown key; did you mean lr?" in text
    assert "data.vlm_reuse_count" in text


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("lr=1", "expected section.key=value"),
        ("train_head.lr", "expected section.key=value"),
        ("data.sources=[", "not YAML"),
        ("data.sources.path=x", "data.sources is a list"),
        ("vlm.prompt='{picture}'", "only {instruction} and {images}"),
        ("vlm.prompt='{images}{images}'", "may stand once"),
        ("extract.store=cache_store/demo", "ends in .zarr"),
        ("data.sources=[{name: a, path: x}, {name: a, path: y}]", "stands more than once"),
        ("train_head.mixture={other: 1}", "mixture names other"),
        ("extract.workers=-1", "extract.workers"),
        ("extract.workers=somehost", "extract.workers"),
        ("train_head.diffusion={timesteps: 20, sampling_steps: 50}", "above timesteps 20"),
        ("train_head.grad_accumulation=80", "parts without a tick"),
        ("train_head.model_type=transformer", "flow_matching"),
        ("train_head.fusion_strategy=film", "cross_attention"),
        ("finetune.tuning.towers=[]", "finetune.tuning.towers"),
        ("vlm.variants=0", "vlm.variants"),
    ],
)
def test_what_is_refused(minimal, override, message):
    with pytest.raises(ConfigError) as caught:
        load_params(minimal, [override])
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "override",
    ["train_head.mixture={other: 1}", "train_head.diffusion={timesteps: 20, sampling_steps: 50}"],
)
def test_a_rule_over_a_section_does_not_print_the_section(minimal, override):
    with pytest.raises(ConfigError) as caught:
        load_params(minimal, [override])
    _, line = str(caught.value).splitlines()
    assert "{" not in line and len(line) < 120


def test_a_missing_and_a_broken_file(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: no such file.*--params"):
        load_params(tmp_path / "nowhere.yaml")
    (tmp_path / "broken.yaml").write_text("data: [")
    with pytest.raises(ConfigError, match="cannot be read as YAML"):
        load_params(tmp_path / "broken.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(ConfigError, match="expected sections"):
        load_params(tmp_path / "list.yaml")
