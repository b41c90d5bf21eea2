"""Pictures are drawn as the page draws them."""

from collections.abc import Iterator

import matplotlib as mpl
import pytest

from pipeline.look.page.style import RC


@pytest.fixture(autouse=True)
def common_style() -> Iterator[None]:
    """As the page draws them."""
    with mpl.rc_context(RC):
        yield
