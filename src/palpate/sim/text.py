"""What a touch feels like, in words.

The adjectives come from the piece that was drawn (its sub-type), never from the class alone, and never say colour or light. Half of the
captions (``named``) also name the thing; the others use adjectives alone, so that text is not just the label.
"""

from __future__ import annotations

from collections.abc import Sequence

from palpate.sim.materials import Surface
from palpate.sim.options import WorldOptions

#: ``{phrase}``: adjectives and noun, with its article if the noun can be counted.
NAMED = ("{phrase}", "this is {phrase}", "the sensor touches {phrase}", "it feels like {phrase}")
#: ``{list}``: the adjectives, joined by commas and "and".
UNNAMED = ("{list}", "it feels {list}", "a surface that feels {list}", "{list} to the touch")
#: Begin with a vowel letter but a consonant sound.
_CONSONANT_SOUND = ("uni", "use", "eu", "one")


def article(word: str) -> str:
    """``"a"`` or ``"an"``, by the sound that ``word`` begins with."""
    return "an" if word[:1].lower() in "aeiou" and not word.lower().startswith(_CONSONANT_SOUND) else "a"


def listed(words: Sequence[str]) -> str:
    """``"a"``, ``"a and b"``, ``"a, b and c"``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def phrase(words: Sequence[str], noun: str) -> str:
    """``"rugged, rough tree bark"``; of a noun that can be counted (``"a leaf"``): ``"an even, waxy leaf"``."""
    if noun.startswith("a "):
        return f"{article(words[0])} {', '.join(words)} {noun[2:]}"
    return f"{', '.join(words)} {noun}"


def caption(options: WorldOptions, video: int, touch: int, surface: Surface) -> str:
    """The caption of one touch: a sentence with at least two of the piece's adjectives, in random order."""
    rng = options.rng("text", video, touch)
    words = [surface.words[k] for k in rng.permutation(len(surface.words))]
    words = words[: int(rng.integers(min(2, len(words)), len(words) + 1))]
    templates = NAMED if rng.random() < options.named else UNNAMED
    sentence = templates[int(rng.integers(len(templates)))].format(phrase=phrase(words, surface.noun), list=listed(words))
    return f"{sentence[0].upper()}{sentence[1:]}."
