"""The Hugging Face Hub: the form of its ids, and the errors of a network that fails."""

import sys
from typing import Any


def could_be_hub_id(text: str) -> bool:
    """Whether a text has the form of a hub id: an owner and a name."""
    parts = text.split("/")
    return len(parts) == 2 and all(parts) and parts[0][0] not in ".~"


def network_errors() -> tuple[type[Exception], ...]:
    """The errors of a network that fails; releases of huggingface_hub differ in their client."""
    clients: list[Any] = [sys.modules[name] for name in ("httpx", "httpx2") if name in sys.modules]
    return OSError, *(client.TransportError for client in clients)
