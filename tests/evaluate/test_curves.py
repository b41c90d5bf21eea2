"""What a training logged is read back; what is gone or torn is said."""

from pathlib import Path
from types import SimpleNamespace

from pipeline.base.config import TrainHeadParams
from pipeline.evaluate.sources import TrainingCurves
from pipeline.evaluate.sources import read_curves as curves_of


def read_curves(logs: Path, step: int = 20, **metrics: float) -> TrainingCurves:
    """Of a checkpoint of that step, with this error where one is given."""
    named = {name.replace("_", "/"): value for name, value in metrics.items()}
    checkpoint = SimpleNamespace(params=TrainHeadParams(logs=logs), step=step, metrics=named)
    return curves_of(checkpoint)  # type: ignore[arg-type]


def written(logs: Path, name: str, text: str) -> None:
    """One curve as dvclive writes it."""
    file = logs / f"plots/metrics/{name}.tsv"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_every_curve_is_read_under_its_name(tmp_path: Path) -> None:
    written(tmp_path, "train/loss", "step\tloss\n10\t0.5\n20\t0.25\n")
    written(tmp_path, "val/error", "step\terror\n20\t9e-1\n")
    written(tmp_path, "lr", "step\tlr\n")
    found = read_curves(tmp_path, val_error=0.9)
    assert found.absence == ""
    assert {name: curve.step.tolist() for name, curve in found.curves.items()} == {
        "train/loss": [10, 20],
        "val/error": [20],
    }
    assert found.curves["train/loss"].value.tolist() == [0.5, 0.25]
    assert found.curves["val/error"].value.tolist() == [0.9]


def test_logs_that_are_gone_or_without_a_point_are_said(tmp_path: Path) -> None:
    found = read_curves(tmp_path / "logs")
    assert found.curves == {}
    assert str(tmp_path / "logs") in found.absence
    written(tmp_path, "lr", "step\tlr\n")
    assert "there are none" in read_curves(tmp_path).absence


def test_curves_of_another_training_are_not_shown(tmp_path: Path) -> None:
    written(tmp_path, "val/error", "step\terror\n10\t0.5\n20\t0.25\n")
    assert read_curves(tmp_path, 10, val_error=0.5).curves
    assert read_curves(tmp_path, 10).curves, "a last checkpoint has no error of its own"
    for other in (
        read_curves(tmp_path, 30),
        read_curves(tmp_path, 15, val_error=0.5),
        read_curves(tmp_path, 20, val_error=0.5),
    ):
        assert other.curves == {}
        assert "are of another training" in other.absence


def test_logs_that_are_torn_are_said(tmp_path: Path) -> None:
    for content in ("step\tloss\n10\n", "step\tloss\n10\tmuch\n"):
        written(tmp_path, "train/loss", content)
        found = read_curves(tmp_path)
        assert found.curves == {}
        assert "cannot be read" in found.absence
