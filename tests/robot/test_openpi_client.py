"""openpi-client 0.1.2 as it is, in an environment of its own, speaks to the server."""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.robot.client import PolicyClient

pytestmark = pytest.mark.extra
NEEDS = ("numpy<2", "openpi-client==0.1.2", "typing-extensions")
"""It imports typing-extensions and does not say so."""
TICKS, EXECUTE = 40, 20
"""More steps of a chunk than an answer's key has bytes."""

SCRIPT = """
import json, sys
import numpy as np
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.websocket_client_policy import WebsocketClientPolicy

address, key, observations, execute, out = sys.argv[1:]
host, _, port = address.rpartition(":")
given = np.load(observations, allow_pickle=False)
policy = WebsocketClientPolicy(host, int(port), api_key=key)
broker = ActionChunkBroker(policy, int(execute))
actions = []
for tick in range(len({name.partition(" ")[0] for name in given.files})):
    fields = {name.partition(" ")[2]: given[name] for name in given.files
              if name.startswith(f"{tick} ")}
    answer = broker.infer({**fields, "prompt": "go"})
    actions.append(answer["actions"])
np.save(out, np.stack(actions))
metadata = policy.get_server_metadata()
try:
    policy.infer({"time": np.float64(99.0), "observation/state": np.zeros(3)})
    said = None
except RuntimeError as error:
    said = str(error)
print(json.dumps({"numpy": np.__version__, "horizon": metadata["horizon"], "said": said}))
"""


@pytest.fixture(scope="module")
def python_of_openpi() -> Path:
    """A Python that has what `NEEDS` names, installed once on this machine."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "vla-feature-cache"
    named = hashlib.sha256(" ".join([sys.version, *NEEDS]).encode()).hexdigest()[:12]
    folder = cache / f"openpi-client-{named}"
    python = folder / "bin" / "python"
    if (folder / "complete").exists():
        return python
    try:
        cache.mkdir(parents=True, exist_ok=True)
        # Elsewhere first, for a run that is killed leaves half of it. Scripts are not moved along.
        for command in (
            [sys.executable, "-m", "venv", "--clear", str(folder)],
            [str(python), "-m", "pip", "install", "--quiet", *NEEDS],
        ):
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=240)
    except (OSError, subprocess.SubprocessError) as error:
        why = str(getattr(error, "stderr", None) or error).strip().splitlines()[-1]
        pytest.skip(f"{', '.join(NEEDS)} cannot be installed here: {why}")
    (folder / "complete").touch()
    return python


def run(python: Path, address: str, key: str, observations: list[Any]) -> tuple[Any, Any]:
    """What the script says, and the actions that it was given."""
    with tempfile.TemporaryDirectory() as place:
        given, out = Path(place) / "given.npz", Path(place) / "out.npy"
        named = {f"{k} {name}": own for k, fields in enumerate(observations)
                 for name, own in fields.items()}  # fmt: skip
        np.savez(given, **named)
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            [python, "-c", SCRIPT, address, key, str(given), str(EXECUTE), str(out)],
            capture_output=True, text=True, check=False, timeout=120, env=clean,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout), np.load(out)


def test_it_gets_what_our_client_gets_bit_for_bit(
    python_of_openpi, served_policy, serving, observe
):
    """With its chunk broker, which takes every array of an answer for one of steps."""
    served = served_policy("flow_matching", horizon=EXECUTE, told=("go",))
    server = serving(served, token="s3cret")
    observations = [observe(tick) for tick in range(TICKS)]
    said, theirs = run(python_of_openpi, server.address, "s3cret", observations)
    assert said["numpy"].startswith("1.") and said["horizon"] == EXECUTE
    assert "Error in inference server" in said["said"]
    assert "refused: observation/state: expected one of" in said["said"]
    ours: list[np.ndarray] = []
    with PolicyClient(f"ws://{server.address}", token="s3cret") as client:
        for tick in range(0, TICKS, EXECUTE):
            ours += list(client.infer(observations[tick] | {"prompt": "go"})["actions"])
    np.testing.assert_array_equal(theirs, ours)
