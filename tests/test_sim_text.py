"""Captions: only the words of the piece, good grammar, never color or light."""

import dataclasses
import math
import re

import numpy as np
import pytest

from palpate.sim import MATERIALS, Video, WorldOptions, plan_world
from palpate.sim.felt import SCALES, measure
from palpate.sim.text import NAMED, UNNAMED, article, listed, phrase

COLORS = (
    "red orange yellow green blue purple violet pink brown black white gray golden silver beige"
)
LIGHT = set(f"{COLORS} colored color bright dark pale light shiny glossy matt matte".split())
LIGHT |= {"shaded", "glazed", "transparent", "clear"}
FIXED = {
    w for t in (*NAMED, *UNNAMED) for w in re.findall(r"[a-z]+", re.sub(r"\{.*?\}", "", t))
} | {"a", "an", "and"}


def words(text):
    return re.findall(r"[a-z]+", text.lower())


def test_captions_use_the_words_of_the_piece_and_the_template_alone():
    options = WorldOptions(tile=64, size=16, objects_per_material=3, mixed=0.5, captions="label")
    named = total = 0
    for plan in plan_world(options):
        video = Video(options, plan)
        for contact in range(options.contacts_per_video):
            text, surface = video.text(contact), video.object_of(contact).surface
            allowed = FIXED | set(words(" ".join(surface.words))) | set(words(surface.noun))
            assert set(words(text)) <= allowed, text
            assert sum(w in text.lower() for w in surface.words) >= 2
            assert not set(words(text)) & LIGHT, text
            assert text[0].isupper()
            assert text.endswith(".")
            assert not re.search(
                r"\b[Aa] [aeio]|\b[Aa] un(?!i)|\b[Aa]n [^aeiou]|\ba [a-z, ]*\ba\b", text
            ), text
            named += surface.noun.removeprefix("a ") in text
            total += 1
    assert 0.35 < named / total < 0.65


def test_no_material_has_words_of_color_or_light():
    from palpate.core import rng_for
    from palpate.sim import Tile

    for name, material in MATERIALS.items():
        for k in range(25):
            rng = rng_for(1, "words", name, k)
            assert not set(words(" ".join(material.draw(Tile(64, rng), rng).words))) & LIGHT


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        *((word, "a") for word in ("uniform", "hard", "usual", "unilateral", "one-sided")),
        *((word, "an") for word in ("unusual", "even", "Elastic", "uninterrupted", "onerous")),
        *(("honest", "an"), ("honeycombed", "a"), ("hourly", "an"), ("Umbral", "an")),
    ],
)
def test_articles(word, expected):
    assert article(word) == expected


def test_phrases():
    assert phrase(("rugged", "rough"), "tree bark") == "rugged, rough tree bark"
    assert phrase(("unusual", "porous"), "a sponge") == "an unusual, porous sponge"
    assert listed(("a",)) == "a"
    assert listed(("a", "b", "c")) == "a, b and c"


def test_words_and_nouns_belong_to_the_subtype_that_was_drawn():
    options = WorldOptions(
        tile=64,
        size=16,
        objects_per_material=6,
        captions="label",
        named=1.0,
        contacts_per_video=3,
        materials=("Tree", "Others", "Plants", "Metal"),
    )
    words_of, nouns = {}, {}
    for plan in plan_world(options):
        video = Video(options, plan)
        for contact in range(3):
            text, surface = video.text(contact), video.object_of(contact).surface
            wrong = r"\ba (?:a|e|i|o|unu|une)|\ban (?:[^aeiou]|uni[^nm])|surface|material"
            assert not re.search(wrong, text.lower()), text
            assert surface.noun.removeprefix("a ") in text
            words_of.setdefault(surface.subtype, set()).add(frozenset(surface.words))
            nouns.setdefault(plan.object_of(contact).material, set()).add(surface.noun)
    assert nouns["Tree"] == {"tree bark"}
    assert nouns["Others"] >= {"a sponge", "a rope"}
    assert all(len(sets) == 1 for sets in words_of.values())
    assert len({words for sets in words_of.values() for words in sets}) == len(words_of)


def test_captions_of_hct_are_lists_of_adjectives():
    options = WorldOptions(
        materials=("Plants", "Wood"),
        objects_per_material=5,
        tile=64,
        size=16,
        layout="hct",
        captions="label",
    )
    ends = set()
    for plan in plan_world(options):
        for contact in range(options.contacts_per_video):
            video = Video(options, plan)
            surface, parts = video.object_of(contact).surface, video.text(contact).split(", ")
            noun = surface.noun.removeprefix("a ")
            assert set(parts) <= {*surface.words, noun}
            assert len(parts) == len(set(parts)) >= 2
            ends.add(parts[-1] == noun)
    assert ends == {True, False}


def test_the_share_of_named_captions_is_obeyed():
    for named, templates in ((0.0, UNNAMED), (1.0, NAMED)):
        options = WorldOptions(
            materials=("Wood",),
            objects_per_material=4,
            tile=64,
            size=16,
            captions="label",
            named=named,
        )
        texts = [Video(options, k).text(t) for k in range(4) for t in range(4)]
        assert all(("wood" in text.lower()) is (templates is NAMED) for text in texts)


FELT = {w for scale in SCALES.values() for level in scale.words for w in level}


def felt_texts(**options):
    options = WorldOptions(tile=64, size=32, contacts_per_video=2, **options)
    videos = [Video(options, plan) for plan in plan_world(options)]
    return [
        (v.plan.object_of(k).material, v.object_of(k).surface.noun, v.text(k))
        for v in videos
        for k in range(2)
    ]


def test_felt_captions_use_the_words_of_the_scales_and_name_no_material():
    rows = felt_texts(objects_per_material=3, layout="hct")
    for _, noun, text in rows:
        assert set(text.split(", ")) <= FELT
        assert noun.removeprefix("a ") not in text
    words_of = {
        m: {w for other, _, t in rows if other == m for w in t.split(", ")} for m, *_ in rows
    }
    assert words_of["Sand"] & words_of["Concrete"]  # two materials share words


def test_felt_captions_follow_the_surface():
    n, px = 64, 14 / 64
    x = np.arange(n) * px
    waves = 0.2 * np.sin(2 * np.pi * x / 2.0) * np.ones((n, 1))
    rng = np.random.default_rng(0)
    flat, lined, noisy = np.zeros((n, n)), waves, 0.2 * rng.standard_normal((n, n))
    felt = {k: measure(h, px, 0.0, 0.0) for k, h in zip("fln", (flat, lined, noisy), strict=True)}
    assert felt["f"]["roughness"] < felt["l"]["roughness"] < felt["n"]["roughness"]
    assert felt["l"]["direction"] > 0.95 > 0.2 > felt["n"]["direction"]
    assert felt["l"]["regularity"] > 0.9 > 0.2 > felt["n"]["regularity"]
    assert felt["l"]["grain"] == pytest.approx(math.log(2.0), abs=0.05)
    tilted = measure(lined + 0.3 * x[:, None] - 0.1 * x, px, 0.0, 0.0)
    assert tilted == pytest.approx(felt["l"], abs=0.02)  # how the pad lies is not felt
    soft, hard = measure(lined, px, 0.9, 0.0), felt["l"]
    assert soft["hardness"] < hard["hardness"]
    assert soft["friction"] > hard["friction"] > measure(lined, px, 0.0, 0.9)["friction"]


def test_an_uncertain_describer_changes_words_and_the_label_captions_keep_their_digest():
    sure, unsure = (felt_texts(objects_per_material=1, describer=d) for d in (0.0, 2.0))
    assert sum(a == b for a, b in zip(sure, unsure, strict=True)) < len(sure) / 2
    label = WorldOptions(captions="label")
    assert label.digest == dataclasses.replace(label, describer=3.0).digest != WorldOptions().digest
    assert len({WorldOptions(describer=d).digest for d in (0.1, 0.2)}) == 2
