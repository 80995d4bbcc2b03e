"""What a contact feels like, in words.

Captions of ``felt`` name what is measured on the surface (:mod:`palpate.sim.felt`), never the
material. In those of ``label`` the adjectives come from the piece that was drawn (its sub-type),
never from the class alone, and never name color or light. A share ``named`` of them also names the
material; the others use adjectives alone, so that text is not just the label. In the layout of HCT
a caption is, as there, a list of adjectives (``rugged, rough``), then the noun if named (``rugged,
rough, tree bark``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from palpate.sim.felt import describe
from palpate.sim.materials import Surface
from palpate.sim.options import WorldOptions

#: ``{phrase}``: adjectives and noun, with its article if the noun can be counted.
NAMED = ("{phrase}", "this is {phrase}", "the sensor touches {phrase}", "it feels like {phrase}")
#: ``{list}``: the adjectives, joined by commas and "and".
UNNAMED = ("{list}", "it feels {list}", "a surface that feels {list}", "{list} to the touch")
# Words with a vowel letter but a consonant sound in front (uniform, usual, one-sided; not
# uninterrupted), or the reverse (hour, honest).
_CONSONANT = re.compile(r"uni(?![nm])|us[eu]|eu|once|one\b")
_VOWEL = re.compile(r"[aeiou]|hour|hono|hones|heir")


def article(word: str) -> str:
    """Return ``"a"`` or ``"an"``, by sound: ``"a uniform"``, ``"an unusual"``."""
    word = word.lower()
    return "an" if _VOWEL.match(word) and not _CONSONANT.match(word) else "a"


def listed(words: Sequence[str]) -> str:
    """Join words: ``"a"``, ``"a and b"``, ``"a, b and c"``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def phrase(words: Sequence[str], noun: str) -> str:
    """Return ``"rugged, rough tree bark"``; if the noun can be counted ``"an even, waxy leaf"``."""
    counted = bare(noun)
    text = f"{', '.join(words)} {counted}"
    return text if counted == noun else f"{article(words[0])} {text}"


def bare(noun: str) -> str:
    """Return ``"leaf"`` of ``"a leaf"``; other nouns unchanged."""
    return noun.removeprefix("a ").removeprefix("an ")


def caption(options: WorldOptions, video: int, contact: int, surface: Surface) -> str:
    """Write the caption of a contact: at least two of the piece's adjectives, in random order."""
    rng = options.rng("text", video, contact)
    words = [surface.words[k] for k in rng.permutation(len(surface.words))]
    words = words[: int(rng.integers(min(2, len(words)), len(words) + 1))]
    named = bool(rng.random() < options.named)
    if options.layout == "hct":
        return ", ".join([*words, bare(surface.noun)] if named else words)
    templates = NAMED if named else UNNAMED
    template = templates[int(rng.integers(len(templates)))]
    return _sentence(template.format(phrase=phrase(words, surface.noun), list=listed(words)))


def felt_caption(options: WorldOptions, video: int, contact: int, felt: Mapping[str, float]) -> str:
    """Write the caption of a contact from what :func:`~palpate.sim.felt.measure` returns."""
    rng = options.rng("felt text", video, contact)
    words = describe(felt, options.describer, rng)
    if options.layout == "hct":
        return ", ".join(words)
    return _sentence(UNNAMED[int(rng.integers(len(UNNAMED)))].format(list=listed(words)))


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
