"""A split: sample id -> part, as a file with a digest and with the rule that made it.

The file is JSON::

    {"format": "palpate-split/1", "digest": "<sha256>", "rule": {...}, "manifest": "<sha256>",
     "parts": {"train": [ids], "val": [ids], "test": [ids]}, "notes": [...]}

The digest is SHA-256 over the lines ``id TAB part``, sorted by id: it names the assignment, not the
rule.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

from palpate.core.files import digest_lines, plain, read_record, short, write_text
from palpate.core.hub import PushOptions, at_revision, fetched_file, push, write_card
from palpate.core.messages import Note, PalpateError
from palpate.core.records import from_plain
from palpate.core.shown import Shown

PARTS = ("train", "val", "test")
#: The verdict of an audit by which a split is called NoLeak.
NO_LEAK = "no leak found"
FORMAT = "palpate-split/1"
#: Its name on the hub.
HUB_FILE = "split.json"


@dataclass(frozen=True)
class _File:
    """What a split file holds."""

    format: str
    digest: str
    rule: Mapping[str, Any]
    manifest: str | None
    parts: Mapping[str, Sequence[str]]
    notes: Sequence[Note] = ()


@dataclass(frozen=True)
class Split(Shown):
    """Which part each sample belongs to.

    Attributes:
        parts: id -> ``"train"``, ``"val"`` or ``"test"``.
        rule: how it was made (method, group, ratios, seed, source files); any JSON object.
        manifest: digest of the manifest it was made on, or None.
        notes: what a reader must know.

    Raises:
        PalpateError: on an unknown part.
    """

    parts: Mapping[str, str]
    rule: Mapping[str, Any] = field(default_factory=dict)
    manifest: str | None = None
    notes: Sequence[Note] = ()

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.parts.values()) - set(PARTS)):
            must = f"A part must be one of {', '.join(PARTS)}"
            raise PalpateError(must, repr(unknown[0]), "Rename the part")

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.parts)

    def __bool__(self) -> bool:
        return True

    def __str__(self) -> str:
        """Return one line: name, samples by part, digest."""
        counts = ", ".join(f"{part} {n:,}" for part, n in self.counts().items())
        return (
            f"{self.rule.get('name', 'split')}: {counts or 'empty'} (digest {short(self.digest)})"
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the assignment."""
        return digest_lines(sorted([f"{i}\t{part}" for i, part in self.parts.items()]))

    def changed(self, **fields: Any) -> Split:
        """The same assignment with another rule, manifest or notes; its digest is not computed
        again.
        """
        other = replace(self, **fields)
        vars(other).update({k: v for k, v in vars(self).items() if k == "digest"})
        return other

    def ids(self, *parts: str) -> list[str]:
        """Return the ids in the given parts, in the order of the split."""
        return [i for i, part in self.parts.items() if part in parts]

    def counts(self) -> dict[str, int]:
        """Return the number of samples by part, without empty parts."""
        counts = Counter(self.parts.values())
        return {part: counts[part] for part in PARTS if counts[part]}

    @classmethod
    def from_ids(
        cls,
        *,
        rule: Mapping[str, Any] | None = None,
        manifest: str | None = None,
        **parts: Iterable[str],
    ) -> Split:
        """Make a split from ``train=[...], test=[...]``.

        Raises:
            PalpateError: if an id is in two parts, or twice in one.
        """
        table: dict[str, str] = {}
        for part, ids in parts.items():
            for i in ids:
                if i in table:
                    got = f"{i!r} in {table[i]} and {part}"
                    raise PalpateError("An id must be in one part only", got, "Remove it from one")
                table[i] = part
        return cls(table, rule or {}, manifest)

    def save(self, path: str | Path) -> None:
        """Write the split file atomically."""
        data = {
            "format": FORMAT,
            "digest": self.digest,
            "rule": self.rule,
            "manifest": self.manifest,
        }
        data = plain(data | ({"notes": self.notes} if self.notes else {}))
        data["parts"] = {part: self.ids(part) for part in self.counts()}
        lines = json.dumps(data, separators=(",\n ", ": "), ensure_ascii=False, allow_nan=False)
        write_text(Path(path), lines + "\n")  # indented JSON takes ten times as long

    def push_to_hub(self, repo_id: str, **options: Unpack[PushOptions]) -> str:
        """Put it on the hub as a data set with its card; return the address.

        Args:
            repo_id: ``owner/name``; made if it is not there; :meth:`load` takes it.
            options: ``private``, ``revision`` (a branch), ``token``.

        Raises:
            PalpateError: if the hub is out of reach or rejects it.
        """

        def write(folder: Path) -> None:
            self.save(folder / HUB_FILE)
            use = f"    import palpate as pp\n\n    split = pp.Split.load({repo_id!r})"
            text = f"{self}\n\nIt holds ids and no images.\n\n{use}"
            write_card(folder, f"Split {repo_id}", text, ["split"])

        return push(write, repo_id, kind="dataset", **options)

    @classmethod
    def load(cls, path: str | Path | Split, revision: str | None = None) -> Split:
        """Read a split file and check its digest; a split is returned as it is.

        Args:
            path: the file, or a hub id.
            revision: branch, tag or commit of a hub id; ``owner/name@revision`` is the same.

        Raises:
            PalpateError: if the file is missing, of another format, or was edited.
        """
        if isinstance(path, Split):
            return path
        if not isinstance(path, str | Path):
            must, got = "must be a split or its file", type(path).__name__
            raise PalpateError(must, got, "E.g. palpate.split(...)", argument="split")
        fix = "Write it again with: palpate split"
        path = fetched_file(at_revision(path, revision), HUB_FILE, "split", fix)
        try:
            file = from_plain(_File, read_record(Path(path), "split file", form=FORMAT))
            split = cls.from_ids(rule=file.rule, manifest=file.manifest, **file.parts)
        except (TypeError, ValueError):
            must = f"{path} must hold a rule and lists of ids by part"
            raise PalpateError(must, "an incomplete split file", fix) from None
        if split.digest != file.digest:
            must = f"The digest in {path} must match its content"
            raise PalpateError(must, "a split that was edited by hand", fix)
        return replace(split, notes=file.notes)
