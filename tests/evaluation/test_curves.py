"""What a training logged is read back; what is gone or torn is said."""

from pathlib import Path

import pytest

from pipeline.evaluation import read_curves


def written(logs: Path, name: str, text: str) -> None:
    """One curve as dvclive writes it."""
    file = logs / f"plots/metrics/{name}.tsv"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_every_curve_is_read_under_its_name(tmp_path: Path) -> None:
    written(tmp_path, "train/loss", "step\tloss\n10\t0.5\n20\t0.25\n")
    written(tmp_path, "val/error", "step\terror\n20\t9e-1\n")
    written(tmp_path, "lr", "step\tlr\n")
    found = read_curves(tmp_path)
    assert found.absence == ""
    assert {name: curve.step.tolist() for name, curve in found.curves.items()} == {
        "train/loss": [10, 20],
        "val/error": [20],
    }
    assert found.curves["train/loss"].value.tolist() == [0.5, 0.25]
    assert found.curves["val/error"].value.tolist() == [0.9]


def test_logs_that_are_gone_are_said(tmp_path: Path) -> None:
    found = read_curves(tmp_path / "logs")
    assert found.curves == {}
    assert str(tmp_path / "logs") in found.absence


@pytest.mark.parametrize("content", ["step\tloss\n10\n", "step\tloss\n10\tmuch\n", "x\ty\n1\t2\n"])
def test_logs_that_are_torn_are_said(tmp_path: Path, content: str) -> None:
    written(tmp_path, "train/loss", content)
    found = read_curves(tmp_path)
    assert found.curves == {}
    assert "cannot be read" in found.absence
