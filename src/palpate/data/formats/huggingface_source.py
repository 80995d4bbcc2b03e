"""Opening Hugging Face data sets without running anything of theirs: folders, and names on the hub."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.core import MissingExtraError, PalpateError

#: Kinds of local folders and of hub data sets that are opened; none of them runs code of others.
LOCAL, REMOTE = ("parquet", "arrow", "imagefolder"), ("parquet",)
#: Marks the description of what palpate exported.
MARK = "palpate-export/1"
#: Column with the places of exported rows in their manifest.
ROW = "palpate_row"


@dataclass
class Source:
    """An opened data set.

    Attributes:
        name: folder or hub name.
        splits: name -> data set, whose images come as bytes.
        images: columns of images.
        labels: columns of class labels -> the names of their classes.
        names: all columns.
        about: what the description of an export says, or empty.
        facts: for the manifest.
        folder: where paths of images may point to, or None.
    """

    name: str
    splits: Mapping[str, Any]
    images: list[str]
    labels: Mapping[str, Sequence[str]]
    names: list[str]
    about: Mapping[str, Any]
    facts: Mapping[str, str]
    folder: Path | None


def open_source(source: Path, config: str | None = None, revision: str | None = None) -> Source:
    """Opens a folder or a hub name.

    Raises:
        PalpateError: if there is none, it is of a kind that is not opened, or the hub cannot be reached.
        MissingExtraError: if ``datasets`` is not installed.
    """
    try:
        import datasets
    except ImportError:
        raise MissingExtraError("datasets", "hf", "Reading Hugging Face data sets") from None
    source = Path(source)
    local = source.is_dir()
    name = source.name if local else source.as_posix()
    if not local and (source.exists() or re.fullmatch(r"[\w.\-]+(/[\w.\-]+)?", name) is None):
        raise PalpateError(
            "The source must be a folder, or a name on the hub like user/name",
            str(source),
            "Check the path",
        )
    saved = local and (
        (source / "dataset_dict.json").is_file() or (source / "state.json").is_file()
    )
    if not local:
        _require_hub(name, revision)
    try:
        loaded = (
            datasets.load_from_disk(str(source))
            if saved
            else _streamed(str(source) if local else name, config, revision, local)
        )
    except PalpateError:
        raise
    except Exception as error:  # the library raises many kinds
        fix = (
            "Write it again with save_to_disk, or as Parquet"
            if local
            else "Check the name, --set config=... and --set revision=..."
        )
        raise PalpateError(
            f"The data set {name} must be whole and readable", one_line(error), fix
        ) from None
    splits: dict[str, Any] = (
        {str(k): v for k, v in loaded.items()} if isinstance(loaded, dict) else {"": loaded}
    )
    features = dict(next(iter(splits.values())).features or {}) if splits else {}
    images = [n for n, f in features.items() if isinstance(f, datasets.Image)]
    for split, data in splits.items():
        if list(data.features or {}) != list(features):
            got = f"{split or 'one'} with {', '.join(data.features or {}) or 'none'}"
            raise PalpateError(
                f"All parts of {name} must have the columns {', '.join(features)}",
                got,
                "Import the parts one by one",
            )
        for image in images:
            data = data.cast_column(image, datasets.Image(decode=False))
        splits[split] = data.with_format(None)
    labels = {n: list(f.names) for n, f in features.items() if isinstance(f, datasets.ClassLabel)}
    info = next(iter(splits.values())).info
    about = _about(info.description)
    told = {"license": info.license, "citation": info.citation, "url": info.homepage}
    facts = {
        "dataset": name,
        **{k: str(v).strip() or "unknown" for k, v in told.items()},
        "format": "hf",
        **about.get("facts", {}),
    }
    return Source(
        name, splits, images, labels, list(features), about, facts, source if local else None
    )


def _require_hub(name: str, revision: str | None) -> None:
    """Asks the hub once, without the library's half minute of retries.

    Raises:
        PalpateError: if it cannot be reached and the user did not ask for the local cache, or has no such data set.
    """
    if os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "TRUE", "YES", "ON"):
        return
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    try:
        HfApi().dataset_info(name, revision=revision, timeout=20)
    except HfHubHTTPError as error:
        got = f"the answer {one_line(error)}"
        raise PalpateError(
            f"The Hugging Face hub must have the data set {name}",
            got,
            "Check the name; for a private one log in: hf auth login",
        ) from None
    except Exception as error:  # of the network library
        raise PalpateError(
            f"{name} is no folder here, so the Hugging Face hub must be within reach",
            one_line(error),
            f"Where there is a network: hf download --repo-type dataset {name} --local-dir DIR, and import DIR; with HF_HUB_OFFLINE=1 a cached copy is taken",
        ) from None


def _streamed(place: str, config: str | None, revision: str | None, local: bool) -> Any:
    """Parquet shards or an image folder, read as they lie, without a copy in the library's cache."""
    import datasets

    options: dict[str, Any] = {} if local else {"revision": revision}
    if "trust_remote_code" in inspect.signature(datasets.load_dataset_builder).parameters:
        options["trust_remote_code"] = False  # the default of today, said for all versions
    builder = datasets.load_dataset_builder(place, config, **options)
    if builder.name not in (LOCAL if local else REMOTE):
        fix = (
            "Convert it to Parquet"
            if local
            else "The hub keeps a copy in Parquet: --set revision=refs/convert/parquet"
        )
        raise PalpateError(
            f"{place} must be made of {' or '.join(LOCAL if local else REMOTE)} files",
            str(builder.name),
            fix,
        )
    return builder.as_streaming_dataset()


def _about(description: str | None) -> Mapping[str, Any]:
    """What the description of an export says; empty for any other."""
    try:
        found = json.loads(description or "")
    except ValueError:
        return {}
    return (
        found
        if isinstance(found, dict)
        and found.get("format") == MARK
        and isinstance(found.get("facts"), dict)
        else {}
    )


def one_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind."""
    return next(
        (line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__
    )[:300]
