"""The split of a training, and its train part."""

from __future__ import annotations

from pathlib import Path

from palpate.core import Split, require
from palpate.data.manifest import Manifest


def load_split(data: Manifest | str | Path, split: Split | str | Path | None = None) -> Split:
    """A split as it is, or from its file, or the only one that lies with the data.

    Raises:
        PalpateError: if there is none with the data, or several.
    """
    if split is not None:
        return Split.load(split)
    files = sorted(Path(data).glob("splits/*.json")) if isinstance(data, str | Path) else []
    must, fix = "must be given unless one lies with the data", "Make one with: palpate split"
    got = ", ".join(path.name for path in files) or "none there"
    require(len(files) == 1, "split", must, got, fix=fix)
    return Split.load(files[0])


def train_part(manifest: Manifest, split: Split) -> Manifest:
    """The train part of a split.

    Raises:
        PalpateError: if it is empty.
    """
    train = manifest.part(split, "train")
    must = "The train part of the split must hold samples of this manifest"
    require(len(train) > 0, None, must, "none", fix="Make a split with: palpate split")
    return train
