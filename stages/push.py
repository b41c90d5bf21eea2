"""Upload a policy or a store to the Hugging Face Hub, with a card made of its own figures.

A policy's card says what it is, what it needs, and how it was judged: the figures of
evaluate.output and rollout.output, if they are of this very policy. Log in first (hf auth login,
or HF_TOKEN). A new repository is private unless push.private is false.

  python -m stages.push owner/name                             the policy of train_head.output
  python -m stages.push owner/name --card                      print the card, upload nothing
  python -m stages.push owner/name --folder cache_store/demo.zarr

Next: hf download owner/name, where it is used
"""

from functools import partial
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("push",)
SHORTHANDS = (
    Shorthand("repo", "push.repo", "the repository", "OWNER/NAME", "?"),
    Shorthand("--folder", "push.folder", "a policy or a store", "FOLDER"),
    Shorthand("--card", "push.card_only", "print the card, upload nothing"),
)


def main(params: "Params") -> None:
    """Upload what `push` names."""
    from huggingface_hub import HfApi

    from pipeline.look.hub import push

    push(params, HfApi(library_name="vla-feature-cache"), partial(print, flush=True))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
