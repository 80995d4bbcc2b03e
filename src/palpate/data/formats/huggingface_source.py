"""Opening Hugging Face data sets, folders and names on the hub, without running their code."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from palpate.core import MissingExtraError, PalpateError, content_of, require, require_regular
from palpate.core.images import SUFFIXES

#: Kinds of local folders and of hub data sets that are opened; none of them runs code of others.
LOCAL, REMOTE = ("parquet", "arrow", "imagefolder"), ("parquet",)


@dataclass(frozen=True)
class Source:
    """An opened data set."""

    name: str  # folder or hub name
    splits: Mapping[str, Any]  # name -> data set, whose images come as bytes
    images: Sequence[str]  # columns of images
    labels: Mapping[str, Sequence[str]]  # columns of class labels -> the names of their classes
    names: Sequence[str]  # all columns
    facts: Mapping[str, str]  # for the manifest
    folder: Path | None  # where paths of images may point to, or None


def open_source(source: Path, config: str | None = None, revision: str | None = None) -> Source:
    """Open a folder or a hub name."""
    try:
        import datasets
    except ImportError:
        raise MissingExtraError("datasets", "hf", "Reading Hugging Face data sets") from None
    source = Path(source)
    local = source.is_dir()
    name = source.name if local else source.as_posix()
    loaded = _loaded(source, name, config, revision)
    splits: dict[str, Any] = dict(loaded) if isinstance(loaded, dict) else {"": loaded}
    require(bool(splits), None, f"{name} must hold rows", "none", fix="Check what wrote it")
    features = dict(next(iter(splits.values())).features or {})
    images = [n for n, f in features.items() if isinstance(f, datasets.Image)]
    for split, data in splits.items():
        must = f"All parts of {name} must have the columns {', '.join(features)}"
        got = f"{split} with {', '.join(data.features or {}) or 'none'}"
        fix = "Import the parts one by one"
        require(list(data.features or {}) == list(features), None, must, got, fix=fix)
        for image in images:
            data = data.cast_column(image, datasets.Image(decode=False))
        splits[split] = data.with_format(None)
    labels = {n: list(f.names) for n, f in features.items() if isinstance(f, datasets.ClassLabel)}
    info = next(iter(splits.values())).info
    facts = {"dataset": name, "license": info.license, "citation": info.citation}
    facts |= {"url": info.homepage}
    facts = {key: str(value).strip() or "unknown" for key, value in facts.items()}
    facts["format"] = "hf"
    folder = source if local else None
    return Source(name, splits, images, labels, list(features), facts, folder)


def first_line(error: BaseException) -> str:
    """The first line of the text of an error, or its kind."""
    lines = (line.strip() for line in str(error).splitlines())
    return next(filter(None, lines), type(error).__name__)[:300]


def _loaded(source: Path, name: str, config: str | None, revision: str | None) -> Any:
    """The data set as the library opens it, without a copy in its cache."""
    local = source.is_dir()
    if not local:
        if source.exists() or re.fullmatch(r"[\w.\-]+(/[\w.\-]+)?", name) is None:
            must = "The source must be a folder, or a name on the hub like user/name"
            raise PalpateError(must, str(source), "Check the path")
        _require_hub(name, revision)
    for path in source.rglob("*"):
        if path.suffix.lower() not in SUFFIXES:  # the library waits for a pipe for ever
            require_regular(path)
            if path.is_file() and path.suffix.lower() in (".csv", ".json", ".jsonl"):
                content_of(path)  # raises for those too large, as the library does not
    try:
        if any((source / mark).is_file() for mark in ("dataset_dict.json", "state.json")):
            return _saved(source)
        return _streamed(str(source) if local else name, config, revision, local)
    except PalpateError:
        raise
    except Exception as error:  # the library raises many kinds
        fix = "Check the name, the configuration and the revision"
        fix = "Write it again with save_to_disk, or as Parquet" if local else fix
        must = f"The data set {name} must be whole and readable"
        raise PalpateError(must, first_line(error), fix) from None


def _saved(source: Path) -> dict[str, Any]:
    """The parts of ``save_to_disk`` that have rows; the library cannot open the others."""
    import datasets

    parts = {"": source}
    if (source / "dataset_dict.json").is_file():
        names = json.loads(content_of(source / "dataset_dict.json"))["splits"]
        parts = {name: source / name for name in names}
    rows = {n: json.loads(content_of(p / "state.json"))["_data_files"] for n, p in parts.items()}
    return {n: datasets.load_from_disk(str(p)) for n, p in parts.items() if rows[n]}


def _require_hub(name: str, revision: str | None) -> None:
    """Query the hub once, without the library's half minute of retries."""
    if os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "TRUE", "YES", "ON"):
        return
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    try:
        HfApi().dataset_info(name, revision=revision, timeout=20)
    except Exception as error:  # of the network library
        must = f"{name} is no folder here, so the Hugging Face hub must be within reach"
        fix = f"Where there is a network: hf download --repo-type dataset {name} --local-dir DIR, "
        fix += "and import DIR; with HF_HUB_OFFLINE=1 a cached copy is taken"
        if isinstance(error, HfHubHTTPError):
            must = f"The Hugging Face hub must have the data set {name}"
            fix = "Check the name; for a private one log in: hf auth login"
        raise PalpateError(must, first_line(error), fix) from None


def _streamed(name: str, config: str | None, revision: str | None, local: bool) -> Any:
    """Parquet shards or an image folder."""
    import datasets

    load: Any = datasets.load_dataset_builder
    if "trust_remote_code" in inspect.signature(load).parameters:
        load = partial(load, trust_remote_code=False)  # versions that have it differ in its default
    builder = load(name, config, revision=None if local else revision)
    kinds = LOCAL if local else REMOTE
    if builder.name not in kinds:
        must = f"{name} must be made of {' or '.join(kinds)} files"
        fix = "Convert it to Parquet" if local else "The hub keeps a copy in Parquet"
        example = None if local else {"revision": "refs/convert/parquet"}
        raise PalpateError(must, str(builder.name), fix, example=example)
    return builder.as_streaming_dataset()
