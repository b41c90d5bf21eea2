"""A policy or a store on the Hugging Face Hub: a card made of its own figures, and the upload."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.base.config import Params
from pipeline.base.errors import CheckpointIncomplete, ConfigError, HubError, StoreMismatch
from pipeline.base.hub import could_be_hub_id, network_errors
from pipeline.base.text import Table
from pipeline.evaluate.figures import Figure, with_unit
from pipeline.evaluate.rollouts import SuccessRate
from pipeline.policy.checkpoint import DOCUMENT, PolicyCheckpoint, find_policy, load_policy
from pipeline.store import FeatureStore
from pipeline.vlm.checkpoint_folder import folder_here

if TYPE_CHECKING:
    from huggingface_hub import HfApi

_LIBRARY = "vla-feature-cache"
_NOT_JUDGED = "No evaluation or rollout of these weights was at hand."


def push(params: Params, api: "HfApi", say: Callable[[str], None] = print) -> None:
    """Upload what `push` names, with its card, in one commit; `push.card_only` prints the card.

    Raises `HubError` where the Hub cannot be reached or refuses, `StoreMismatch` for a folder that
    is neither a policy nor a store, and what opening it raises.
    """
    wanted = params.push
    if not could_be_hub_id(wanted.repo):
        raise ConfigError(f"push.repo: expected owner/name, found {wanted.repo!r}")
    folder = wanted.folder or params.train_head.output
    if (folder / "zarr.json").exists():
        kind, files = "dataset", _files_below(folder)
        card = store_card(FeatureStore.open(folder), wanted.repo)
    else:
        try:
            folder = find_policy(folder)
        except CheckpointIncomplete as error:
            raise StoreMismatch(
                f"push.folder: {folder}: expected a trained policy or a finished store. Run "
                "stages.train_head, or name another folder"
            ) from error
        kind, files = "model", _files_below(folder)
        reports = {"evaluate": params.evaluate.output, "rollout": params.rollout.output}
        card = policy_card(load_policy(folder), wanted.repo, params.vlm.checkpoint, reports)
    if wanted.card_only:
        say(card)
    size = sum(size for _, size in files.values())
    say(f"{folder}: {len(files)} files, {size / 1e6:.1f} MB, for the {kind} {wanted.repo}")
    if not wanted.card_only:
        say(_upload(api, wanted.repo, kind, wanted.private, files, card))


def _files_below(folder: Path) -> dict[str, tuple[Path, int]]:
    """Each file by its name in the repository, with its size in bytes."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): (path, path.stat().st_size) for path in paths}


def _upload(
    api: "HfApi",
    repo: str,
    kind: str,
    private: bool,
    files: Mapping[str, tuple[Path, int]],
    card: str,
) -> str:
    """One commit with all files and the card; returns its address."""
    from huggingface_hub import CommitOperationAdd
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalTokenNotFoundError

    operations = [CommitOperationAdd(name, path) for name, (path, _) in files.items()]
    operations.append(CommitOperationAdd("README.md", card.encode()))
    try:
        api.create_repo(repo, repo_type=kind, private=private, exist_ok=True)
        if private and not api.repo_info(repo, repo_type=kind).private:
            raise HubError(
                f"push.repo: {repo} is there and public. Set push.private=false if you mean it, or "
                "name another"
            )
        commit = api.create_commit(
            repo, operations, commit_message=f"Upload by {_LIBRARY}", repo_type=kind
        )
    except HubError:
        raise
    except (HfHubHTTPError, HFValidationError, LocalTokenNotFoundError, *network_errors()) as error:
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise HubError(
            f"push.repo: {repo}: {why}. Log in with a token that may write (hf auth login), and "
            "name a repository of yours as owner/name"
        ) from error
    return commit.commit_url


def policy_card(
    checkpoint: PolicyCheckpoint, repo: str, model: str, reports: Mapping[str, Path]
) -> str:
    """The card of a policy: what it is, what it needs, and how it was judged.

    `reports` has the folders of its evaluation and its rollouts. Figures of another policy or
    another step are left out.
    """
    source, params = checkpoint.source, checkpoint.params
    streams, spec = source["streams"], source["feature_spec"]
    action = streams["action"]
    about = {
        "action expert": f"{params.model_type}, fusion {params.fusion_strategy}",
        "actions": f"{params.horizon} steps of {_channels(streams, 'action')}, {action['kind']}",
        "rate": f"{source['action_hz']:g} Hz" if source["action_hz"] else "as recorded",
        "cameras": ", ".join(streams["views"]),
        "state": _channels(streams, "state"),
        "sensor": _channels(streams, "sensor"),
        "instructions": "; ".join(checkpoint.instructions),
        "trained on": f"{len(checkpoint.split['train'])} episodes, {checkpoint.step} steps",
    }
    lines = [
        *_front("model", repo, model),
        "A policy on features of a frozen Qwen2.5-VL, trained by vla-feature-cache.",
        *_section("What it is", _facts(about)),
        *_section(
            "What it needs",
            [
                f"The features of {_named(model)} with this feature spec (`{spec['digest']}`): "
                f"layers, pooling, image size and prompt are in `{DOCUMENT}`; the weights of the "
                f"model have the digest `{spec['weights']}`. Before it serves, the model proves "
                "on golden rows that it gives them.",
                "```",
                f"hf download {repo} --local-dir models/{repo.split('/')[-1]}",
                f"python -m stages.serve --set serve.checkpoint=models/{repo.split('/')[-1]}",
                "```",
            ],
        ),
        *_section("How it was judged", list(_judged(checkpoint, reports)) or [_NOT_JUDGED]),
    ]
    return "\n".join(lines) + "\n"


def store_card(store: FeatureStore, repo: str) -> str:
    """The card of a store: what it holds, and how to train from it."""
    streams, spec = store.streams, store.spec
    slots, dim = store.feature_shape
    about = {
        "episodes": f"{len(store.episodes):,}",
        "ticks": f"{store.ticks:,}",
        "features": f"{slots} slots of {dim} in {spec['storage_dtype']}",
        "feature spec": f"`{spec['digest']}`",
        **{name: _channels(streams, name) for name in ("action", "state", "sensor")},
    }
    folder = f"cache_store/{repo.split('/')[-1]}.zarr"
    lines = [
        *_front("dataset", repo, None),
        "Features of a frozen Qwen2.5-VL with the raw sensor, state and action streams, written by "
        "vla-feature-cache: a plain zarr v3 group that is mapped into memory for training.",
        *_section("What it holds", _facts(about)),
        *_section(
            "Train from it",
            [
                "```",
                f"hf download {repo} --repo-type dataset --local-dir {folder}",
                f"python -m stages.verify --set verify.store={folder}",
                f"python -m stages.train_head --set train_head.store={folder}",
                "```",
            ],
        ),
    ]
    return "\n".join(lines) + "\n"


def _front(kind: str, repo: str, model: str | None) -> list[str]:
    """The metadata in front of a card, and its title."""
    entries = [f"library_name: {_LIBRARY}", "tags: [robotics, vision-language-action]"]
    if kind == "model":
        entries.append("pipeline_tag: robotics")
    if model is not None and _is_on_the_hub(model):
        entries.append(f"base_model: {model}")
    return ["---", *entries, "---", f"# {repo.split('/')[-1]}"]


def _is_on_the_hub(model: str) -> bool:
    return could_be_hub_id(model) and folder_here(model) is None


def _named(model: str) -> str:
    """The model of the params by its hub id; a local folder says nothing to others."""
    return f"`{model}`" if _is_on_the_hub(model) else "a Qwen2.5-VL"


def _section(title: str, lines: Sequence[str]) -> list[str]:
    return ["", f"## {title}", *lines]


def _facts(about: Mapping[str, str]) -> list[str]:
    return Table(("", " "), list(about.items())).markdown()


def _channels(streams: Mapping[str, Any], name: str) -> str:
    """The names and units of a stream's channels, the first of many; a store may lack it."""
    stream = streams.get(name)
    if not stream or not stream["names"]:
        return "none"
    pairs = [*map(with_unit, stream["names"], stream["units"])]
    return ", ".join(pairs) if len(pairs) <= 30 else f"{len(pairs)}: {', '.join(pairs[:5])}, …"


def _judged(checkpoint: PolicyCheckpoint, reports: Mapping[str, Path]) -> Iterator[str]:
    """Success and errors of this policy, by the documents of its evaluation and its rollouts."""
    rollout, metrics = (_document(reports["rollout"], name) for name in ("settings", "metrics"))
    if rollout.get("weights") == checkpoint.digest:
        yield (
            f"In {rollout['episodes']} closed-loop episodes of `{rollout['environment']}`, level "
            f"`{rollout['level']}`, with 95 % intervals:"
        )
        yield ""
        rows = [(name, str(SuccessRate(**rate))) for name, rate in metrics["success"].items()]
        yield from Table(("controller", "success"), rows).markdown()
    judged, metrics = (_document(reports["evaluate"], name) for name in ("judged", "metrics"))
    if judged.get("policy", {}).get("weights") == checkpoint.digest:
        held_out = metrics["test"]
        yield ""
        yield f"Errors on {held_out['episodes']} held-out episodes, beside the best simple rule:"
        yield ""
        rows = [
            (span, group, *(Figure(**by[name]).text() for name in ("policy", "best_baseline")))
            for span in ("executed", "chunk")
            for group, by in metrics[span].items()
            if "best_baseline" in by
        ]
        yield from Table(("steps", "error", "policy", "best simple rule"), rows).markdown()


def _document(folder: Path, name: str) -> dict[str, Any]:
    """A JSON document of a report; empty where there is none."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
