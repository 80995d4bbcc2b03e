"""Captions: the words of the measured surface, never of color or light."""

import math
import re

import numpy as np
import pytest

from palpate.sim import Video, WorldOptions, plan_world
from palpate.sim.felt import SCALES, TEMPLATES, measure

COLORS = (
    "red orange yellow green blue purple violet pink brown black white gray golden silver beige"
)
LIGHT = set(f"{COLORS} colored color bright dark pale light shiny glossy matt matte".split())
LIGHT |= {"shaded", "glazed", "transparent", "clear"}


def test_no_word_is_of_color_or_light():
    assert not LIGHT & {word for phrase in FELT for word in phrase.split()}


FELT = {w for scale in SCALES.values() for level in scale.words for w in level}


def felt_texts(**options):
    options = WorldOptions(tile=64, size=32, contacts_per_video=2, **options)
    videos = [Video(options, plan) for plan in plan_world(options)]
    return [(v.plan.object_of(k).material, v.text(k)) for v in videos for k in range(2)]


def test_felt_captions_use_the_words_of_the_scales_and_name_no_material():
    frames = [re.escape(template).replace(r"\{\}", "(.+)") for template in TEMPLATES]
    words_of = {}
    for material, text in felt_texts(objects_per_material=3):
        assert re.fullmatch(r"[A-Z].* and .*\.", text)
        lower = text[0].lower() + text[1:].rstrip(".")
        inner = next(m[1] for f in reversed(frames) if (m := re.fullmatch(f, lower)))
        words = set(re.split(", | and ", inner))
        assert words <= FELT
        words_of.setdefault(material, set()).update(words)
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
