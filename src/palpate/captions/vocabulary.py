"""Words in captions: names of materials with their inflections and synonyms, and visual words.

A word names a material if one of its forms is one of the name's: ``wooden``, ``woods``, ``woody``
are forms of ``wood``, ``tiled`` is one of ``tile``, ``furry`` of ``fur``, ``plasticky`` of
``plastic``. Synonyms are in ``words/materials.tsv``; a label that is not there is matched by its
words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from importlib import resources

_WORD = re.compile(r"[^\W\d_]+")
#: Ending -> what may stand in its place in the lemma.
_ENDINGS = (
    ("ies", ("y",)),
    ("ves", ("f", "fe")),
    ("es", ("", "e")),
    ("s", ("",)),
    ("like", ("",)),
    *((e, ("", "e")) for e in ("y", "ey", "ish", "en", "ic", "ed", "ing", "ized", "ised")),
)
#: Words that look like an inflection of a material's name and are none, or say what was done to it.
_OTHER = {"rugged", "tiny", "tired", "hiding", "logic", "soiled", "ironed", "sanded", "sanding"}
#: Parts of labels that say nothing by themselves.
_ARTICLES = {"a", "an", "and", "of", "or", "the", "with"}
_EMPTY = _ARTICLES | {"material", "surface", "natural", "synthetic", "other", "others"}


def words_of(text: str) -> list[str]:
    """The words of a text in lower case; ``wood-like`` is two."""
    return _WORD.findall(text.lower())


@cache
def forms_of(word: str) -> frozenset[str]:
    """The word and the lemmas that it may be an inflection of."""
    forms = {word}
    for ending, stems in _ENDINGS if word not in _OTHER else ():
        if word.endswith(ending) and len(word) - len(ending) >= 3:
            bare = word.removesuffix(ending)
            forms |= {bare + stem for stem in stems}
            if bare[-1] == bare[-2] or bare.endswith("ck"):  # woolly, metallic; plasticky
                forms.add(bare[:-1])
    return frozenset(forms)


class Vocabulary:
    """Names of materials: those of the labels, and of all that ship.

    Args:
        labels: materials of the data set.
    """

    def __init__(self, labels: Iterable[str] = ()) -> None:
        self._of = {label: _names(label) for label in labels}
        shipped = (_names(label) for label in _synonyms())
        self._any = frozenset[str]().union(*self._of.values(), *shipped)

    def naming(self, text: str, label: str | None = None) -> list[str]:
        """The words of a text that name this label, or with None any material."""
        names = self._any if label is None else self._of.get(label) or _names(label)
        return [word for word in words_of(text) if not names.isdisjoint(forms_of(word))]

    def masked(self, text: str) -> str:
        """The text without names of materials.

        Parts between commas that are nothing but such names go; in others ``material`` replaces
        them.
        """
        parts: list[str] = []
        for part in text.split(","):
            names = set(self.naming(part))
            if names and not set(words_of(part)) - names - _EMPTY:
                continue
            for name in names:
                part = re.sub(rf"\b{name}\b", "material", part, flags=re.IGNORECASE)
            parts.append(re.sub(r"\bmaterial(?:[\s-]+material)+\b", "material", part))
        return ",".join(parts).strip()


@cache
def visual_words() -> frozenset[str]:
    """Words of color, gloss, light and outline."""
    lines = _file("visual.txt").splitlines()
    return frozenset(" ".join(line for line in lines if not line.startswith("#")).split())


def visual_in(text: str) -> list[str]:
    """The words of a text that no finger feels."""
    return [word for word in words_of(text) if word in visual_words()]


@cache
def _names(label: str) -> frozenset[str]:
    """Lemmas that name a label: its words and their synonyms."""
    words = [word for word in words_of(label) if word not in _EMPTY]
    synonyms = _synonyms()
    keys = {" ".join(words_of(label)), *(form for word in words for form in forms_of(word))}
    listed = [word for key in keys for word in synonyms.get(key, ())]
    plurals = [word for word in (*words, *listed) if word.endswith("s") and len(word) > 3]
    return frozenset((*words, *listed, *(word.removesuffix("s") for word in plurals)))


@cache
def _synonyms() -> dict[str, tuple[str, ...]]:
    """Name of a material -> its synonyms."""
    rows = (line.split("\t") for line in _file("materials.tsv").splitlines())
    return {name: tuple(words.split()) for name, words in rows}


def _file(name: str) -> str:
    path = resources.files("palpate.captions") / "words" / name
    return path.read_text(encoding="utf-8")
