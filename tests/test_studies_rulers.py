"""Rulers agree or reverse as planted, and say when they cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.stats import kendalltau

from mini_fixtures import make_encoders
from palpate.core import Note, PalpateError, Score, Split
from palpate.data.manifest import Manifest
from palpate.encoders.embed import embed
from palpate.metrics import tmmd
from palpate.sim import WorldOptions, write_world
from palpate.studies.rulers import measure_rulers, ruler_claim, ruler_scores, ruler_tables

METHODS, SEEDS = [f"m{k}" for k in range(8)], range(3)
KEYS = [(m, s) for m in METHODS for s in SEEDS]


def ruler(order, noise, seed):
    """TMMD of every generator: its method's place in ``order``, and noise of its own."""
    rng = np.random.default_rng(seed)
    return {
        (m, s): Score("TMMD", m, order[METHODS.index(m)] + noise * rng.normal()) for m, s in KEYS
    }


RANKS = np.arange(8.0)


def test_tau_is_scipys_and_intervals_hold_what_was_planted():
    rulers = {
        "Orig": ruler(RANKS, 0.5, 0),
        "NoLeak": ruler(3 * RANKS + 7, 1.5, 1),  # another unit, the same order
        "reversed": ruler(-RANKS, 0.5, 2),
        "blind": ruler(0 * RANKS, 1.0, 3),
    }
    made = {s.subject: s for s in ruler_scores(rulers, replicates=400)}
    for pair, score in made.items():
        a, b = pair.split(" and ")
        x, y = ([float(rulers[name][k]) for k in sorted(KEYS)] for name in (a, b))
        assert score.value == pytest.approx(kendalltau(x, y).statistic), pair
        assert score.interval[0] <= score.value <= score.interval[1], pair
    assert made["Orig and NoLeak"].interval[0] > 0.5
    assert made["Orig and reversed"].interval[1] < -0.5
    assert made["Orig and blind"].interval[0] < 0 < made["Orig and blind"].interval[1]
    assert made["Orig and NoLeak"].details["by_method"] == pytest.approx(1)


def test_methods_are_what_is_resampled():
    """Ten seeds of three methods are three generators, not thirty: the interval stays wide."""
    rng = np.random.default_rng(0)
    many = {(f"m{k % 3}", k // 3): float(k % 3) + 0.01 * rng.normal() for k in range(30)}
    turned = {key: -value if key[0] == "m2" else value for key, value in many.items()}
    rulers = {
        name: {key: Score("TMMD", key[0], value) for key, value in of.items()}
        for name, of in (("a", many), ("b", turned))
    }
    low, high = ruler_scores(rulers, replicates=400)[0].interval
    assert high - low > 0.8


def test_tables_and_the_claim_follow():
    alike = {"Orig": ruler(RANKS, 0.3, 0), "NoLeak": ruler(RANKS, 0.3, 1)}
    agreement = ruler_scores(alike, replicates=300)
    matrix, ranks = ruler_tables(alike, agreement)
    assert matrix.rows[0] == ["Orig", None, agreement[0]]
    assert matrix.rows[1] == ["NoLeak", agreement[0], None]
    assert [[float(c) for c in row[1:]] for row in ranks.rows] == [[k, k] for k in range(1, 9)]
    assert ruler_claim(agreement).verdict == "holds"
    empty = {n: of | {("empty", 0): Score("TMMD", "empty", 4.5)} for n, of in alike.items()}
    ranks = ruler_tables(empty, agreement, controls=["empty", "of no data"])[1]
    assert (ranks.rows[-1][0], ranks.controls) == ("empty", ["empty"])
    assert [float(row[1]) for row in ranks.rows] == [*range(1, 9), 6]  # 4.5 after five of them
    against = {"Orig": ruler(RANKS, 0.3, 0), "NoLeak": ruler(-RANKS, 0.3, 1)}
    assert ruler_claim(ruler_scores(against, replicates=300)).verdict == "does not hold"
    blind = {"Orig": ruler(RANKS, 0.3, 0), "NoLeak": ruler(0 * RANKS, 1.0, 5)}
    made = ruler_claim(ruler_scores(blind, replicates=300))
    assert made.verdict == "undecided"
    assert made.why.startswith("Tau of Orig and NoLeak is")


def test_perfect_agreement_has_no_interval_and_mistakes_are_named():
    steps = np.array([0.01 * s for _, s in KEYS])
    same = {
        name: {key: Score("TMMD", key[0], float(x)) for key, x in zip(KEYS, values, strict=True)}
        for name, values in (("a", RANKS.repeat(3) + steps), ("b", 2 * RANKS.repeat(3) + steps))
    }
    score = ruler_scores(same, replicates=100)[0]
    assert (score.value, score.interval) == (1, None)
    assert score.details["p_value"] == pytest.approx(2 / 40320)  # 2 of 8! orders
    assert ruler_claim([score]).verdict == "holds"
    with pytest.raises(PalpateError, match="two rulers"):
        ruler_scores({"a": same["a"]})
    with pytest.raises(PalpateError, match="the same generators"):
        ruler_scores({"a": same["a"], "b": {("m0", 0): Score("TMMD", "m0", 1.0)}})
    seen = Note("text", {"text": "has seen them"})
    noted = {key: replace(s, notes=[seen]) for key, s in same["b"].items()}
    assert [*ruler_scores({"a": same["a"], "b": noted})[0].notes] == [*score.notes, seen]
    empty = {**same["a"], ("m0", 0): Score("TMMD", "m0", None)}
    with pytest.raises(PalpateError, match="must have a score"):
        ruler_scores({"a": same["a"], "b": empty})


def test_every_ruler_measures_every_folder(tmp_path):

    options = WorldOptions(
        materials=2,
        objects_per_material=6,
        contacts_per_video=1,
        frames_per_contact=2,
        size=32,
        tile=64,
        mixed=0.0,
        leak="none",
    )
    write_world(tmp_path / "w", options)
    manifest = Manifest.load(tmp_path / "w")
    split = Split.load(tmp_path / "w" / "splits" / "Orig.json")
    test = manifest.part(split, "test")
    rng, images = np.random.default_rng(0), {}
    for seed, noise in enumerate((0, 60)):
        folder, cells = tmp_path / str(seed), []
        folder.mkdir()
        for k, (i, path) in enumerate(zip(test.ids, test.paths("tactile"), strict=True)):
            x = np.asarray(Image.open(path)).astype(float)
            x = np.clip(x + noise * rng.normal(size=x.shape), 0, 255).astype(np.uint8)
            Image.fromarray(x).save(folder / f"{k}.png")
            cells.append({"id": i, "tactile": f"{k}.png"})
        Manifest.from_rows(cells, folder).save(folder / "manifest.parquet")
        images["m", seed] = folder
    rulers = {"a": make_encoders(0), "b": make_encoders(1)}
    made = measure_rulers(rulers, images, manifest, split)
    for name, encoders in rulers.items():
        assert float(made[name]["m", 0]) == pytest.approx(0, abs=1e-9)  # the real images
        real = embed(test, encoders, still=True)
        x = embed(Manifest.load(images["m", 1]), encoders, still=True).features
        same = {"ids": test.ids, "groups": test.column("video")}
        how = {"reference_ids": test.ids, "reference_groups": test.column("video")}
        want = tmmd(x, real.features, **same, **how, preset="grouped", permutations=0)
        assert float(made[name]["m", 1]) == pytest.approx(want.value, rel=1e-4)
