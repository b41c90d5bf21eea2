"""A printed command repeats the params and settings of the command that prints it."""

import shlex
from pathlib import Path

import pytest

from pipeline.base.config import setting
from pipeline.base.printed_commands import DEFAULT_PARAMS, command, running_with


def test_it_repeats_params_and_settings_less_its_own():
    overrides = ["vlm.layers=[1, 2]", "extract.plan=true", "extract.store=a.zarr", "data.root=lab"]
    with running_with(Path("my params.yaml"), [*overrides, "data.root=other lab"]):
        printed = command("extract", setting("extract.store", Path("b.zarr")))
    settings = ["--set", "vlm.layers=[1, 2]", "--set", "data.root=other lab"]
    typed = ["--set", "extract.store=b.zarr", "--params", "my params.yaml", *settings]
    assert shlex.split(printed) == ["python", "-m", "stages.extract", *typed]


def test_default_params_are_not_repeated_nor_is_anything_afterwards():
    with running_with(DEFAULT_PARAMS, ["vlm.dtype=float32"]):
        assert command("demo") == "python -m stages.demo --set vlm.dtype=float32"
    with pytest.raises(KeyError), running_with(Path("lab.yaml"), []):
        raise KeyError
    assert command("store", "gc", "a.zarr") == "python -m stages.store gc a.zarr"


def test_what_removes_is_not_repeated_and_what_is_set_last_stands_last() -> None:
    settings = ["stores.remove=true", "a.b=1", "a={b: 2}", "a.b=3"]
    with running_with(DEFAULT_PARAMS, settings):
        assert command("store") == "python -m stages.store --set 'a={b: 2}' --set a.b=3"
