"""Captions from labels: deterministic, about touch alone, for any material."""

import re

from palpate.data.captions import ADJECTIVES, caption
from palpate.data.formats.touch_and_go import CATEGORIES

SEEN = {"red", "green", "blue", "white", "black", "brown", "gray", "color", "bright", "dark"}
SEEN |= {"light", "shiny", "glossy", "transparent", "yellow", "orange", "pink"}


def test_every_material_has_touch_words_only():
    assert set(ADJECTIVES) == set(CATEGORIES.values())
    assert [CATEGORIES[k] for k in (0, 10, 15, 19)] == ["Concrete", "Rubber", "Rock", "Others"]
    for material in ADJECTIVES:
        assert 3 <= len(ADJECTIVES[material]) <= 6
        for k in range(40):
            text = caption(material, f"v/{k}")
            words = re.findall(r"[a-z]+", text)
            assert not set(words) & SEEN, text
            assert sum(adjective in text for adjective in ADJECTIVES[material]) >= 3
            assert material.lower() not in text
            assert not re.search(r"\ba [aeiou]|\ban [^aeiou]", text), text


def test_the_same_sample_has_the_same_words_and_others_vary():
    assert caption("Rock", "v/1") == caption("rock ", "v/1")
    assert len({caption("Rock", f"v/{k}") for k in range(50)}) > 20
    assert len({caption("Rock", "v/1", seed=s) for s in range(50)}) > 20


def test_an_unknown_material_is_named_as_it_is():
    texts = {caption("Sandpaper  No. 5 {x}", f"v/{k}") for k in range(50)}
    assert len(texts) == 5
    assert all("Sandpaper No. 5 {x}" in text for text in texts)
