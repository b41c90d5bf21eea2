"""A frame of each codec is really decoded."""

import av
import pytest

from pipeline.look.doctor import decoders
from pipeline.look.doctor.decoders import CLIPS, check_decoder, decoding_trouble


@pytest.mark.parametrize("codec", CLIPS)
def test_this_pyav_decodes_what_data_sets_hold(codec: str) -> None:
    assert decoding_trouble(codec) is None
    assert check_decoder(codec).level == "ok"


def test_a_decoder_that_fails_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*rest: object, **named: object) -> None:
        raise av.FFmpegError(38, "Function not implemented")

    monkeypatch.setattr(decoders.av, "open", fail)
    finding = check_decoder("AV1")
    assert finding.level == "note"
    assert "does not decode it" in finding.found and "Function not implemented" in finding.found
    assert "libdav1d" in finding.remedy


def test_a_wrong_picture_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoders, "GREY", 180)
    assert decoding_trouble("H.264") == "its picture is wrong (grey 100, not 180)"
