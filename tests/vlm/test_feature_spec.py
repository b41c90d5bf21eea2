"""A spec's digest moves with everything that decides a feature, and with nothing else."""

import json
import shutil

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from pipeline.base.differences import differences
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import resolve_checkpoint, weight_files
from pipeline.vlm.feature_spec import feature_shape, feature_spec
from pipeline.vlm.slots import Slot
from tests.vlm.documents import edit

VIEWS = ("View1", "View2", "View3")


@pytest.fixture
def spec_of(vlm_params, digest_file):
    def build(views=VIEWS, storage_dtype="float32", **changes):
        return feature_spec(vlm_params(**changes), storage_dtype, views, digest_file)

    return build


def test_document_is_json_with_what_a_person_wants_to_see(spec_of):
    spec = spec_of(views=("View2", "View1"), image_resize_height=360, image_resize_width=640)
    assert json.loads(json.dumps(spec.attrs())) == spec.attrs()
    assert spec.attrs()["digest"] == spec.digest
    assert spec.views == ("View1", "View2")
    assert spec.image_size == (364, 644)
    assert spec.dim == 128
    assert spec.document["processor"]["image_size"] == [364, 644]
    assert spec.document["processor"]["resample"] == "bicubic"
    assert spec.document["example_prompt"].count("<|image_pad|>") == 2
    assert "attention" not in spec.document
    assert spec == spec_of(
        views=("View1", "View2"), image_resize_height=360, image_resize_width=640
    )


def test_slots_go_by_layer_norm_pooling(spec_of):
    spec = spec_of(
        views=("View1", "View2"),
        layers=[-1, 1],
        norms=[True, False],
        pooling=["mean", "view_mean", "grid"],
    )
    assert len(spec.slots) == 2 * 2 * (1 + 2 + 32)
    assert spec.slots[:2] == (Slot(3, True, "mean"), Slot(3, True, "view_mean", "View1"))
    assert spec.slots[8] == Slot(3, True, "grid", "View1", (1, 1))
    assert spec.slots[35:71:35] == (Slot(3, False, "mean"), Slot(1, True, "mean"))


def test_all_layers_are_named_in_a_word(spec_of, vlm_params):
    assert spec_of(layers="all") == spec_of(layers=[0, 1, 2, 3])
    assert feature_shape(vlm_params(layers="all"), VIEWS) == (4, 128)
    assert feature_shape(vlm_params(layers="all", checkpoint="owner/name"), VIEWS) == (36, 2048)


def test_grids_tokens_and_the_tower_stand_side_by_side(spec_of):
    spec = spec_of(
        views=("View1",),
        layers=["vision", 2],
        norms=[True, False],
        pooling=["view_mean", {"grid": [1, 2]}, "tokens"],
    )
    one = 1 + 2 + 4 * 5
    assert len(spec.slots) == 3 * one  # the tower has no final norm
    assert spec.slots[2].document() == {
        "layer": "vision",
        "norm": False,
        "pooling": "grid 1x2",
        "view": "View1",
        "cell": [0, 1],
    }
    assert spec.slots[one - 1] == Slot("vision", False, "tokens", "View1", (3, 4), (4, 5))


def test_variants_are_named_only_where_there_are_several(spec_of):
    """So that stores of one variant keep their digest, and what was extracted stays known."""
    one = spec_of()
    assert spec_of(variants=1, augmentation={"rotation_deg": 30, "seed": 7}) == one
    assert not {"variants", "augmentation"} & one.document.keys()
    assert one.document["slots"] == [{"layer": 3, "norm": True, "pooling": "mean"}]
    three = spec_of(variants=3, pooling=["mean", "last"], augmentation={"crop": 0.8})
    assert three.slots == spec_of(pooling=["mean", "last"]).slots, "those of one variant"
    assert [(slot["variant"], slot["pooling"]) for slot in three.document["slots"]] == [
        (variant, pooling) for variant in range(3) for pooling in ("mean", "last")
    ]
    assert three.document["variants"] == 3
    assert three.document["augmentation"].items() >= {"version": 1, "crop": 0.8, "seed": 0}.items()


CHANGES = [
    {"dtype": "bfloat16"},
    {"storage_dtype": "float16"},
    {"views": ("View1", "View2")},
    {"image_resize_width": 168},
    {"image_resize_width": 141},  # the same pixels, another request
    {"prompt": "{images}{instruction}"},
    {"layers": [1]},
    {"norms": [False]},
    {"pooling": ["last"]},
    {"variants": 3},
    {"variants": 3, "augmentation": {"seed": 1}},
    {"variants": 3, "augmentation": {"rotation_deg": 4}},
]


def test_digest_and_keys_move_with_each_param_and_with_the_code(spec_of, monkeypatch):
    specs = [spec_of(**change) for change in ({}, *CHANGES)]
    monkeypatch.setattr("pipeline.vlm.feature_spec.EXTRACTOR_VERSION", 999)
    specs.append(spec_of())
    assert len({spec.digest for spec in specs}) == len(specs)
    assert len({spec.row_key("go", {}) for spec in specs}) == len(specs)
    assert all(differences(specs[0].attrs(), spec.attrs()) for spec in specs[1:])


def test_digest_stays_where_features_do(spec_of, copy):
    (copy / "README.md").write_text("not read by the model")
    base = spec_of()
    assert spec_of(attention="eager") == base
    assert spec_of(checkpoint=str(copy)) == base
    assert spec_of(layers=[3]) == spec_of(layers=[-1]) == base
    assert differences(base.attrs(), spec_of(attention="eager").attrs()) == {}


def _touch_weight(folder):
    path = folder / "model.safetensors"
    weights = load_file(path)
    weights["model.norm.weight"][0] += 1e-3
    save_file(weights, path, metadata={"format": "pt"})


def _edit(name, **changes):
    return lambda folder: edit(folder / name, changes)


def _rename_token(folder):
    path = folder / "tokenizer.json"
    path.write_text(path.read_text().replace("<|box_end|>", "<|box_fin|>"))


FILES = [
    (_touch_weight, "weights"),
    (_edit("config.json", tie_word_embeddings=False), "weights"),
    (_edit("preprocessor_config.json", image_mean=[0.5, 0.5, 0.5]), "processor.image_mean"),
    (_edit("preprocessor_config.json", max_pixels=12000), "processor.image_size"),
    (_rename_token, "tokenizer"),
    (_edit("tokenizer_config.json", chat_template="{{ '<|image_pad|>' * 3 }}"), "chat_template"),
]


def test_digest_moves_with_each_file(spec_of, demo_checkpoint, tmp_path):
    base = spec_of()
    for number, (change, place) in enumerate(FILES):
        folder = shutil.copytree(demo_checkpoint, tmp_path / str(number))
        change(folder)
        changed = spec_of(checkpoint=str(folder))
        assert changed.digest != base.digest
        assert place in differences(base.document, changed.document)


def test_row_key_moves_with_spec_prompt_pixels_shape_and_view(spec_of, make_frame):
    spec = spec_of()
    frames = {view: make_frame(seed, 24, 32) for seed, view in enumerate(VIEWS)}
    one_value = {view: frame.copy() for view, frame in frames.items()}
    one_value["View3"][23, 31, 2] ^= 1
    swapped = frames | {"View1": frames["View2"], "View2": frames["View1"]}
    reshaped = frames | {"View1": frames["View1"].reshape(32, 24, 3)}
    alone = frames["View1"]
    keys = [
        spec.row_key("go", frames),
        spec_of(dtype="float16").row_key("go", frames),
        spec.row_key("go ", frames),
        spec.row_key("go", one_value),
        spec.row_key("go", swapped),
        spec.row_key("go", reshaped),
        spec.row_key("go", {"View2": alone}),
    ]
    assert all(len(key) == 16 for key in keys)
    assert len(set(keys)) == len(keys)
    backwards = dict(reversed(frames.items()))
    strided = {view: np.asfortranarray(frame) for view, frame in backwards.items()}
    assert spec.row_key("go", strided) == keys[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layers": [4]}, r"expected -4 to 3 for a model of 4 decoder layers, .*found \[4\]"),
        ({"layers": [-1, 3]}, r"each layer once, found \[-1, 3\]"),
        ({"layers": ["vision"], "pooling": ["grid", "last"]}, "pooling last: the vision tower"),
        ({"adapter": "/nowhere"}, r"vlm\.adapter /nowhere: no such folder"),
    ],
)
def test_bad_params_are_named(spec_of, changes, message):
    with pytest.raises(VLMError, match=message):
        spec_of(**changes)


def test_a_hub_id_that_is_not_there_says_what_to_run(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VLMError, match=r"stages\.demo.*hf download models/demo_vlm"):
        resolve_checkpoint("models/demo_vlm")


def test_a_cached_hub_copy_is_used_without_network(monkeypatch, tmp_path, demo_checkpoint):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--someone--small-vl"
    snapshot = repository / "snapshots" / ("a" * 40)
    shutil.copytree(demo_checkpoint, snapshot)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("a" * 40)
    assert resolve_checkpoint("someone/small-vl") == snapshot
    (snapshot / "model.safetensors").unlink()
    with pytest.raises(VLMError, match=r"no \*\.safetensors"):
        weight_files(resolve_checkpoint("someone/small-vl"))


def test_only_what_transformers_loads_is_digested(copy):
    whole, shard = copy / "model.safetensors", copy / "model-00001-of-00001.safetensors"
    index = copy / "model.safetensors.index.json"
    shutil.copy(whole, shard)
    index.write_text(json.dumps({"metadata": {}, "weight_map": {"a": shard.name}}))
    assert weight_files(copy) == [copy / "config.json", whole]
    whole.unlink()
    assert weight_files(copy) == sorted([copy / "config.json", shard, index])
    (copy / "adapter_config.json").write_text("{}")
    with pytest.raises(VLMError, match=r"adapter_config\.json.*name that as vlm\.adapter"):
        weight_files(copy)


def test_what_transformers_read_is_remembered_by_all_it_depends_on(
    vlm_params, digest_file, copy, monkeypatch
):
    kept: dict[str, str] = {}
    made: list[str] = []

    def remember(what, make):
        if what not in kept:
            made.append(what)
            kept[what] = make()
        return kept[what]

    def spec(views=VIEWS, **changes):
        vlm = vlm_params(checkpoint=str(copy), **changes)
        again = feature_spec(vlm, "float32", views, digest_file, remember)
        fresh = feature_spec(vlm, "float32", views, digest_file)
        assert again == fresh
        assert json.dumps(again.document) == json.dumps(fresh.document), "in the same order"

    spec()
    spec(layers=[0])
    assert len(made) == 1, "no layer decides what is read"
    spec(prompt="{images}")
    spec(image_resize_height=168)
    spec(views=("View1",))
    (copy / "another.txt").write_text("")
    spec()
    monkeypatch.setattr("pipeline.vlm.feature_spec.version", lambda name: "another")
    spec()
    assert len(made) == 6
