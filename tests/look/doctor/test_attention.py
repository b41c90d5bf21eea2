"""flash-attention: there, absent, broken, asked for."""

from pathlib import Path

import pytest

from pipeline.look.doctor.attention import FLASH, check_flash, flash_trouble


@pytest.mark.parametrize(
    ("trouble", "device", "asked", "level"),
    [
        (None, "cuda", "auto", "ok"),
        (None, "cuda", "flash_attention_2", "ok"),
        ("not installed", "cuda", "auto", "note"),
        ("not installed", "cpu", "auto", "ok"),
        ("not installed", "cuda", "flash_attention_2", "missing"),
        (None, "cpu", "flash_attention_2", "missing"),
    ],
)
def test_flash_attention_is_needed_only_where_it_is_asked_for(
    trouble: str | None, device: str, asked: str, level: str
) -> None:
    finding = check_flash(trouble, device, asked)
    assert finding.level == level
    assert (FLASH in finding.remedy) == (level != "ok")


def test_a_build_for_another_torch_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "flash_attn.py").write_text("raise ImportError('undefined symbol: _ZN3c10')")
    monkeypatch.syspath_prepend(str(tmp_path))
    trouble = flash_trouble()
    assert trouble is not None
    assert "built for another torch" in trouble and "undefined symbol" in trouble
