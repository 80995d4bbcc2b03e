"""A split: sample id -> part, as a file with a digest and with the rule that made it.

The file is JSON::

    {"format": "palpate-split/1", "digest": "<sha256>", "rule": {...}, "manifest": "<sha256>",
     "parts": {"train": [ids], "val": [ids], "test": [ids]}, "notes": [...]}

The digest is SHA-256 over the lines ``id TAB part``, sorted by id: it names the assignment, not the rule.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from palpate.core.digest import digest_lines, short
from palpate.core.errors import PalpateError
from palpate.core.files import read_json, write_json
from palpate.core.notes import Note

PARTS = ("train", "val", "test")
FORMAT = "palpate-split/1"


@dataclass(frozen=True)
class Split:
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

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.parts)

    def __bool__(self) -> bool:
        return True

    def __str__(self) -> str:
        """One line: rule, samples by part, digest."""
        name = str(self.rule.get("name", "split"))
        counts = ", ".join(f"{part} {n:,}" for part, n in self.counts().items())
        return f"{name}: {counts or 'no samples'} (digest {short(self.digest)})"

    def _repr_html_(self) -> str:
        """For notebooks: the same as :meth:`__str__`."""
        return f"<div>{html.escape(str(self))}</div>"

    def __post_init__(self) -> None:
        unknown = sorted(set(self.parts.values()) - set(PARTS))
        if unknown:
            raise PalpateError(
                f"A part must be one of {', '.join(PARTS)}", repr(unknown[0]), "Rename the part"
            )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the assignment."""
        return digest_lines(f"{i}\t{self.parts[i]}" for i in sorted(self.parts))

    def ids(self, *parts: str) -> list[str]:
        """The ids in the given parts, in the order of the split."""
        return [i for i, part in self.parts.items() if part in parts]

    def counts(self) -> dict[str, int]:
        """Number of samples by part; parts without samples are left out."""
        return {part: n for part in PARTS if (n := len(self.ids(part)))}

    @classmethod
    def from_ids(
        cls,
        *,
        rule: Mapping[str, Any] | None = None,
        manifest: str | None = None,
        **parts: Iterable[str],
    ) -> Split:
        """A split from ``train=[...], test=[...]``.

        Raises:
            PalpateError: if an id stands in two parts, or twice in one.
        """
        table: dict[str, str] = {}
        for part, ids in parts.items():
            for i in ids:
                if i in table:
                    raise PalpateError(
                        "An id must stand in one part only",
                        f"{i!r} in {table[i]} and {part}",
                        "Remove one of the two",
                    )
                table[i] = part
        return cls(table, rule or {}, manifest)

    def save(self, path: str | Path) -> None:
        """Write the split file atomically."""
        data: dict[str, Any] = {
            "format": FORMAT,
            "digest": self.digest,
            "rule": dict(self.rule),
            "manifest": self.manifest,
            "parts": {part: self.ids(part) for part in self.counts()},
        }
        if self.notes:
            data["notes"] = [note.to_json() for note in self.notes]
        write_json(Path(path), data)

    @classmethod
    def load(cls, path: str | Path) -> Split:
        """Reads a split file and checks its digest.

        Raises:
            PalpateError: if the file is missing, of another format, or its digest does not match its content.
        """
        data = read_json(Path(path), "split file")
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise PalpateError(
                f"{path} must be a split file ({FORMAT})",
                "another kind of file",
                "Write one with: palpate split",
            )
        parts: dict[str, list[str]] = (
            data["parts"] if isinstance(data.get("parts"), dict) else {"": []}
        )
        rule: Any = data.get("rule")
        whole = set(parts) <= set(PARTS) and isinstance(rule, dict)
        if not whole or not all(
            isinstance(ids, list) and all(isinstance(i, str) for i in ids) for ids in parts.values()
        ):
            raise PalpateError(
                f"{path} must hold a rule and lists of ids by part",
                "an incomplete split file",
                "Write it again with: palpate split",
            )
        split = cls.from_ids(rule=rule, manifest=data.get("manifest"), **parts)
        if split.digest != data.get("digest"):
            raise PalpateError(
                f"The digest in {path} must match its content",
                "a split that was edited by hand",
                "Write it again with: palpate split",
            )
        return replace(split, notes=[Note.from_json(note) for note in data.get("notes", ())])
