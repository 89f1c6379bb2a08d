"""Formats of dataset hubs: `imagefolder/` (Hugging Face) and WebDataset shards; uploads to the Hugging Face Hub, whose
account huggingface_hub knows (`hf auth login` or HF_TOKEN; HF_ENDPOINT names another hub).

imagefolder/{train,validation}/metadata.jsonl next to the images and their masks, parts, ignored pixels and depth:
                                             datasets.load_dataset("DATASET"), by the card's configuration
webdataset/{train,val}-NNNNNN.tar            samples read in a row, a sample's files with its number as key: .png or
                                             .jpg (image), .mask.png, .parts.png, .ignore.png, .depth.png and .json
                                             (its record: state, camera, labels)
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import read_bytes, write_atomically, write_text
from neeco.synthesis.writers import Record, Writer, WrittenImages, link, public_record, stem

SPLITS = {"train": "train", "val": "validation"}  # ours, and the hub's names
SHARD_SIZE = 1000  # samples in a tar file
SHARDED = {"masks": "mask.png", "parts": "parts.png", "ignore": "ignore.png", "depth": "depth.png"}


class ImageFolder(Writer):
    """Images with masks, parts, ignored pixels and depth, and of every visible instrument `bbox` (x, y, width, height
    px), `area` px, `category` (its index), `name`, `keypoints` (x, y px and visibility) and `pose` (camera from
    instrument, mm, OpenCV axes)."""

    format = "imagefolder"
    description = (
        "`imagefolder/{train,validation}/`, with metadata.jsonl: `datasets.load_dataset` of the data set's folder "
        "gives image, mask, parts, ignore, depth and objects (bbox, area, category, name, keypoints, pose)"
    )

    def write(self, images: WrittenImages) -> None:
        """(Re)write images (hard links) and metadata. Raises NeecoError."""
        root, folder, points = images.root, images.root / self.format, images.keypoint_names
        lines: dict[str, list[str]] = {}
        for record in images.records:
            split, name = SPLITS[record["split"]], stem(record["index"])
            image = Path(record["image"]).name
            link(root / record["image"], folder / split / image)
            planes = {plane.partition(".")[0]: kind for kind, plane in SHARDED.items()}  # mask, parts, ...
            for plane, kind in planes.items():
                link(root / kind / f"{name}.png", folder / split / f"{name}_{plane}.png")
            visible = [label for label in record["labels"] if label["area"] > 0]
            line = {
                "file_name": image,
                **{f"{plane}_file_name": f"{name}_{plane}.png" for plane in planes},
                "objects": {
                    "bbox": [label["box"] for label in visible],
                    "area": [label["area"] for label in visible],
                    "category": [images.instruments.index(label["name"]) for label in visible],
                    "name": [label["name"] for label in visible],
                    "keypoints": [
                        [[float(value) for value in label["keypoints"].get(point, [0, 0, 0])] for point in points]
                        for label in visible
                    ],
                    "pose": [label["camera_from_instrument"] for label in visible],
                },
            }
            lines.setdefault(split, []).append(json.dumps(line, allow_nan=False))
        for split, of_split in lines.items():
            write_text(folder / split / "metadata.jsonl", "".join(f"{line}\n" for line in of_split))


class WebDataset(Writer):
    """Shards of samples."""

    format = "webdataset"
    description = "`webdataset/{train,val}-*.tar`"

    def write(self, images: WrittenImages) -> None:
        """(Re)write the shards. Raises NeecoError."""
        folder = images.root / self.format
        for old in folder.glob("*.tar"):
            old.unlink()
        for split in sorted({record["split"] for record in images.records}):
            chosen = [record for record in images.records if record["split"] == split]
            for number, start in enumerate(range(0, len(chosen), SHARD_SIZE)):
                path = folder / f"{split}-{number:06d}.tar"
                write_atomically(path, partial(_write_shard, images.root, chosen[start : start + SHARD_SIZE]))


def _write_shard(root: Path, records: Sequence[Record], path: Path) -> None:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            key = stem(record["index"])
            image = root / record["image"]
            contents = {image.suffix[1:]: read_bytes(image, "an image")}
            for folder, ending in SHARDED.items():
                contents[ending] = read_bytes(root / folder / f"{key}.png", "labels")
            contents["json"] = json.dumps(public_record(record), allow_nan=False).encode()
            for ending, content in contents.items():
                entry = tarfile.TarInfo(f"{key}.{ending}")  # dated 1970 and nobody's: bytes depend on content alone
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))


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
        hub.upload_folder(
            repo_id=repository.repo_id,
            repo_type="dataset",
            folder_path=folder,
            commit_message="Add data set rendered by neeco",
            ignore_patterns=list(LEFT_OUT),
        )
        return str(repository)


@contextmanager
def _failures(name: str) -> Iterator[None]:
    """Put failures of the hub, of the network and of the name into one line."""
    try:
        from huggingface_hub.errors import HFValidationError, HTTPError
    except ImportError:
        raise NeecoError(f"{OPTION}: needs huggingface_hub; {install_hint('hub')}") from None
    try:
        yield
    except HFValidationError:
        form = "give NAME or OWNER/NAME of letters, digits, '-', '_' and '.'"
        raise NeecoError(f"{OPTION} {name}: is not a repository's name; {form}") from None
    except (HTTPError, OSError, ValueError) as error:  # no connection; refused, not logged in
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".: ")
        raise NeecoError(f"{OPTION} {name}: {reason}; log in with `hf auth login`, or try again") from error
