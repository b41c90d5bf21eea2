"""The guides of several robots as the batch that a policy takes."""

from collections.abc import Sequence

import numpy as np
import torch

from pipeline.policy.expert import Guide
from pipeline.robot.chunking import PlanGuide


def stack_guides(guides: Sequence[PlanGuide | None], device: torch.device) -> Guide | None:
    """The guide of a batch of robots in this order, on `device`; None where no robot has one.

    Robots without a plan weigh nothing, so that their chunks are drawn freely.
    """
    given = next((guide for guide in guides if guide is not None), None)
    if given is None:
        return None
    free = PlanGuide(np.zeros_like(given.chunk), np.zeros_like(given.weight))
    rows = [guide or free for guide in guides]
    chunk, weight = np.stack([row.chunk for row in rows]), np.stack([row.weight for row in rows])
    return Guide(torch.from_numpy(chunk).to(device), torch.from_numpy(weight).to(device))
