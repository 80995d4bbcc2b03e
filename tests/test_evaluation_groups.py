"""Scores where nobody said what belongs together: recordings by names, and no verdict without."""

from dataclasses import replace

import numpy as np
import pytest

from forge.scores import by_key, codes, unit
from palpate.core import FeatureSet, PalpateError, Split
from palpate.evaluation import score

FAST = {"companions": [], "permutations": 99, "presets": ["grouped"], "sigma": 10}


def touches(rng, videos, frames=6, start=0, objects=0, named="video_{v:03d}_{f:04d}"):
    """Features of frames around their video, and of videos around one of so many objects."""
    of_object = rng.normal(size=(objects or videos, 16))[np.arange(videos) % (objects or videos)]
    centers = 3 + of_object * bool(objects) + rng.normal(size=(videos, 16))
    x = unit(np.repeat(centers, frames, 0) + 0.2 * rng.normal(size=(videos * frames, 16)))
    pairs = [(v, f) for v in range(start, start + videos) for f in range(frames)]
    ids = [named.format(v=v, f=f, k=k) for k, (v, f) in enumerate(pairs, start * frames)]
    return FeatureSet(ids, x, None, None, "e" * 64)


def columns_of(sides, objects):
    """The labels of two sides: id, video, and objects that the sides do not share."""
    return [
        {"id": i, "video": f"{side}{k // 6}", "object": f"{side}-{k // 6 % objects}"}
        for side, x in sides.items()
        for k, i in enumerate(x.ids)
    ]


def p_of(*sides, **options):
    [s] = score(*sides, **FAST | options)["TMMD"]
    return s.details["p_value"]


def rejected(draws, one):
    return np.mean([one(np.random.default_rng(k)) <= 0.05 for k in range(draws)])


def by_video(rng):
    return p_of(touches(rng, 10), touches(rng, 10, start=10))


def by_object(rng):
    sides = {"a": touches(rng, 24, objects=8), "b": touches(rng, 24, start=24, objects=8)}
    return p_of(*sides.values(), labels=columns_of(sides, 8), group="video")


@pytest.mark.parametrize("one", [by_video, by_object])
def test_the_null_is_rejected_as_often_as_said(one):
    assert rejected(20, one) <= 0.2  # 20 draws at 5 %: five or more in 0.3 %


@pytest.mark.nightly
@pytest.mark.parametrize("one", [by_video, by_object])
def test_the_null_is_rejected_in_5_percent_of_many_draws(one):
    assert 0.02 <= rejected(200, one) <= 0.09


def sides_of(*names, videos=10):
    """Two sides of disjoint videos, whose names are made by patterns."""
    rng = np.random.default_rng(0)
    starts = range(0, videos * len(names), videos)
    return [touches(rng, videos, start=s, named=n) for s, n in zip(starts, names, strict=True)]


PLAIN = ["{k}"] * 2
TOLD = ["video_{v:03d}_{f:04d}"] * 2


@pytest.mark.parametrize(
    ("names", "videos", "options", "notes", "sure"),
    [
        (TOLD, 10, {}, ["groups"], True),
        (PLAIN, 10, {}, ["groups-unknown"], False),
        (PLAIN, 10, {"group": "frame"}, [], True),
        (TOLD, 10, {"group": "frame"}, ["group-finer", "groups"], True),
        (TOLD, 4, {}, ["groups", "groups-few"], False),
    ],
)
def test_no_interval_and_no_p_where_nobody_knows_what_belongs_together(
    names, videos, options, notes, sure
):
    made, real = sides_of(*names, videos=videos)
    results = score(made, real, **FAST | {"presets": ["paper"], "companions": ["prdc"]} | options)
    assert codes(results) == notes
    scores = by_key(results)
    assert all(s.value is not None for k, s in scores.items() if k[0].startswith(("TMMD", "Prec")))
    assert (scores["TMMD", "generated", "paper"].interval is not None) == sure
    for s in results if not sure else ():
        assert (s.interval, s.details.get("p_value")) == (None, None)
        assert "independent-samples" not in [n.code for n in s.notes]
    assert (scores["TMMD", "generated", "paper"].details["p_value"] is not None) == sure


def test_the_line_says_where_groups_come_from():
    results = score(*sides_of(*TOLD), **FAST)
    assert "videos: from file names `video_{video}_{frame:d}`" in str(results)
    results = score(*sides_of(*PLAIN), **FAST | {"presets": ["paper"]})
    assert "Name files <video>_<frame>" in str(results)


def test_a_level_that_is_too_fine_is_noted_with_the_right_one():
    rng = np.random.default_rng(0)
    sides = {"a": touches(rng, 24, objects=8), "b": touches(rng, 24, start=24, objects=8)}
    labels = columns_of(sides, 8)
    results = score(*sides.values(), labels=labels, group="video", **FAST)
    [note] = [n for n in results.notes if n.code == "group-finer"]
    assert note.params == {"group": "video", "level": "object", "used": "object"}
    auto = score(*sides.values(), labels=labels, **FAST)["TMMD", "generated"]
    assert results["TMMD", "generated"].details["p_value"] == auto.details["p_value"]
    assert results.settings["options"]["group"] == "object"


def test_samples_of_both_sides_take_the_coarsest_level_of_eight():
    """Pairs: what a split kept whole, then coarse to fine; others: what the sides do not share."""
    real = touches(np.random.default_rng(0), 24)
    made = replace(real, features=unit(real.features + 0.01))
    for objects, level in ((8, "object"), (7, "video")):
        labels = [
            row | {"object": row["object"].replace("b-", "a-")}
            for row in columns_of({"a": real}, objects)
        ]
        results = score(made, real, labels=labels, **FAST)
        assert results.settings["options"]["group"] == level
        assert "groups-few" not in codes(results)
    labels[0]["object"] = "another"  # a video of two objects is cut by none
    assert score(made, real, labels=labels, **FAST).settings["options"]["group"] == "video"
    split = Split.from_ids(train=[], test=real.ids, rule={"group": "video"}, manifest="m" * 64)
    labels = columns_of({"a": real}, 8)
    assert (
        score(made, real, labels=labels, split=split, **FAST).settings["options"]["group"]
        == "video"
    )


def test_generators_of_other_samples_are_scored_alone():
    (a, real), (b,) = sides_of(*TOLD), sides_of("other_{v:03d}_{f:04d}")
    results = score({"a": a, "b": b}, real, **FAST)
    assert {s.a for s in results["TMMD"]} == {"a", "b"}
    assert "no-differences" in codes(results)
    assert not [s for s in results if s.b]


def test_two_generators_have_a_sentence():
    real = touches(np.random.default_rng(0), 12)
    noise = np.random.default_rng(1).normal(size=real.features.shape)
    near, far = (replace(real, features=unit(real.features + k * noise + k)) for k in (0.01, 0.4))
    results = score({"near": near, "far": far}, real, **FAST | {"companions": ["fid"]})
    assert "near is better by TMMD, " in str(results)


def test_one_image_is_no_set():
    with pytest.raises(
        PalpateError, match=r"must be several images .* Got one of shape \(32, 32, 3\)"
    ):
        score(
            np.zeros((32, 32, 3), np.uint8), np.zeros((2, 32, 32, 3), np.uint8), companions=["ssim"]
        )
