"""A data set's folder, with its card, as a data set repository of the Hugging Face Hub (the extra `hub`).

Whose account it is, huggingface_hub knows: `hf auth login`, or HF_TOKEN; HF_ENDPOINT names another hub.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neeco.errors import NeecoError, install_hint

OPTION = "--push-to-hub"
LEFT_OUT = (".*", "*/.*")  # what a data set is continued from


def check_hub(name: str) -> None:
    """Raise NeecoError where huggingface_hub is missing, nobody is logged in, or `name` cannot be a repository's."""
    with _failures(name):
        from huggingface_hub import HfApi
        from huggingface_hub.utils import validate_repo_id

        validate_repo_id(name)
        HfApi().whoami()


def push_to_hub(folder: Path, name: str) -> str:
    """Upload the data set in `folder` to the repository `name` ("owner/name", or "name" of one's own) and return its
    address. A repository that does not exist is made, private. Raises NeecoError."""
    with _failures(name):
        from huggingface_hub import HfApi

        hub = HfApi(library_name="neeco")
        repository = hub.create_repo(name, repo_type="dataset", private=True, exist_ok=True)
        message = "Add data set rendered by neeco"
        hub.upload_folder(
            repo_id=repository.repo_id,
            repo_type="dataset",
            folder_path=folder,
            commit_message=message,
            ignore_patterns=list(LEFT_OUT),
        )
        return str(repository)


@contextmanager
def _failures(name: str) -> Iterator[None]:
    """Put failures of the hub, of the network and of the name into one line."""
    try:
        from huggingface_hub.errors import HTTPError
    except ImportError:
        raise NeecoError(f"{OPTION}: needs huggingface_hub; {install_hint('hub')}") from None
    try:
        yield
    except (HTTPError, OSError, ValueError) as error:  # no connection; refused, not logged in; not a name
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".: ")
        raise NeecoError(f"{OPTION} {name}: {reason}; log in with `hf auth login`, or try again") from error
