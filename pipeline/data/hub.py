"""Recordings on the Hugging Face Hub, in the Hub's own cache."""

from pathlib import Path

from pipeline.base.config import Source
from pipeline.base.errors import ConfigError
from pipeline.base.hub import network_errors


def hub_folder(source: Source) -> Path:
    """The folder of a source's data set on the Hub.

    Files that the Hub's cache lacks are downloaded; without network, what it has of that revision
    is used. Raises `ConfigError` where there is neither.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    assert source.hub is not None
    repo, _, revision = source.hub.partition("@")
    try:
        return Path(snapshot_download(repo, repo_type="dataset", revision=revision or None))
    except (HFValidationError, *network_errors()) as error:
        why = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        at = f" --revision {revision}" if revision else ""
        raise ConfigError(
            f"source {source.name!r}: hub {source.hub}: cannot be downloaded: {why}. Look at the "
            f"id, or run `hf download --repo-type dataset {repo}{at}` where there is network and "
            "give its folder as the source's path. A gated set needs `hf auth login`"
        ) from error
