"""The page of a server, in a browser: what it shows, and that nothing of a robot is run in it."""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.robot.client import PolicyClient
from pipeline.robot.status import ConnectedRobot, ServerStatus

TITLE = "Policy server"


@pytest.fixture
def visit(browser: Any) -> Any:
    """`visit(server)`: its page, and what it did that a page must not."""
    contexts = []

    def load(server: Any, **options: Any) -> tuple[Any, list[str]]:
        context = browser.new_context(viewport={"width": 1100, "height": 900}, **options)
        contexts.append(context)
        page, trouble = context.new_page(), []
        page.on("pageerror", lambda error: trouble.append(f"script: {error}"))
        page.on("console", lambda said: trouble.append(said.text) if said.type == "error" else None)
        page.on(
            "request",
            lambda sent: (
                None
                if sent.url.startswith((f"http://{server.address}/", "data:"))
                else trouble.append(sent.url)
            ),
        )
        page.goto(f"http://{server.address}/")
        return page, trouble

    yield load
    for context in contexts:
        context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_shows_latencies_ages_frames_and_actions(
    served_policy: Callable[..., Any],
    serving: Callable[..., Any],
    observe: Callable[..., dict[str, Any]],
    visit: Any,
    scheme: str,
) -> None:
    server = serving(served_policy("flow_matching"))
    page, trouble = visit(server, color_scheme=scheme)
    assert page.title() == TITLE
    page.get_by_text("None is connected.").wait_for()
    attack = "<img src=x onerror=alert(1)>"
    with PolicyClient(f"ws://{server.address}") as client:
        for tick in range(5):
            client.infer(observe(tick, prompt=attack))
        page.get_by_text("Robot 1 at 127.0.0.1: 5 answers").wait_for()
        assert page.locator("#counts").inner_text().startswith("5 answered, 0 refused, 0 told busy")
        for row in ("pass of the model", "head", "waiting", "whole answer"):
            times = page.locator("#latency tr", has_text=row).locator("td").all_inner_texts()
            assert len(times) == 3 and 0 <= float(times[0]) <= float(times[2])
        assert "s old" in page.locator(".robot strong").inner_text()
        assert page.locator(".robot p").inner_text() == attack
        assert page.locator(".robot img").count() == 3
        widths = page.locator(".robot img").evaluate_all("all => all.map(one => one.naturalWidth)")
        assert widths == [20, 20, 20]
        captions = page.locator(".robot svg + figcaption").all_inner_texts()
        assert [caption.partition(":")[0] for caption in captions][:3] == ["dx", "dy", "dz"]
        assert len(captions) == 7 and captions[0].endswith("mm")
        points = page.locator(".robot polyline").first.get_attribute("points")
        assert len(points.split()) == 4
        overflow = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
        assert overflow <= 0
    page.get_by_text("None is connected.").wait_for()
    assert trouble == []


def test_it_asks_for_the_token(
    served_policy: Callable[..., Any], serving: Callable[..., Any], visit: Any
) -> None:
    server = serving(served_policy(), token="s3cret")
    page, _ = visit(server)  # a 401 is an error of the console
    page.get_by_text("The server asks for its token.").wait_for()
    assert page.locator("#shown").is_hidden()
    page.get_by_label("Token").fill("wrong")
    page.get_by_role("button", name="Show").click()
    page.get_by_text("That is not the token.").wait_for()
    page.get_by_label("Token").fill("s3cret")
    page.get_by_label("Token").press("Enter")
    page.get_by_text("None is connected.").wait_for()
    assert page.locator("#ask").is_hidden()
    assert "s3cret" not in page.url


def test_a_server_that_has_gone_is_said(
    served_policy: Callable[..., Any], serving: Callable[..., Any], visit: Any
) -> None:
    server = serving(served_policy())
    page, _ = visit(server)
    page.get_by_text("None is connected.").wait_for()
    server.stop()
    page.get_by_text("The server does not answer").wait_for()


def test_quantiles_are_of_the_parts_that_took_any_time(served_policy: Callable[..., Any]) -> None:
    status = ServerStatus(served_policy().metadata)
    robot = ConnectedRobot(1, "here")
    assert json.loads(status.json())["latency"] == {}
    observation: Any = SimpleNamespace(prompt=None, frames={})
    for ms in range(1, 1001):
        timing = {"vlm_ms": 0.0, "head_ms": ms, "wait_ms": 0.0, "infer_ms": 2 * ms}
        answer = {"server_timing": timing, "actions": np.zeros((4, 7))}
        status.answered(robot, observation, answer)
    latency = json.loads(status.json())["latency"]
    assert set(latency) == {"head_ms", "infer_ms"}
    np.testing.assert_allclose(
        list(latency["head_ms"].values()), [1000, 500.5, 990.01, 999.001, 1000]
    )
    assert latency["infer_ms"]["p99"] == pytest.approx(1980.02)
