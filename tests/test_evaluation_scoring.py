"""``palpate.evaluation.score``: against loops and the library; splits, controls, notes, caches."""

import dataclasses
import os
import shutil

import numpy as np
import polars as pl
import pytest
from PIL import Image
from scipy import stats

from forge.errors import fails
from forge.pictures import paint
from forge.scores import DIM, FRAMES, GROUPS, IDS, by_key, codes, feature_sets, unit
from palpate.core import FeatureSet, PalpateError, Score, Split
from palpate.core.score import require_comparable
from palpate.data import samples
from palpate.data.manifest import Manifest
from palpate.evaluation import score, scorers
from palpate.evaluation.controls import matched_features
from palpate.metrics import Polynomial, compare, contact_scores, distance, i_tmmd, ssim
from palpate.metrics.distributions import prdc_rows
from palpate.metrics.intervals import spread_of_values
from palpate.report.labels import label_of, subject_of

SETS = feature_sets()
TEST, TRAIN = IDS[:24], IDS[24:]
SPLIT = Split.from_ids(train=TRAIN, test=TEST, rule={"name": "halves"}, manifest="m" * 64)
FAST = {"companions": [], "permutations": 0, "sigma": 10}


def pairwise_mean(x, y, kernel, groups, same):
    """Mean of the kernel over pairs, by two loops; pairs of one group are excluded."""
    pairs = [(i, j) for i in range(len(x)) for j in range(len(y))]
    pairs = [(i, j) for i, j in pairs if not (same and i == j)]
    pairs = [(i, j) for i, j in pairs if not groups or groups[i] != groups[j]]
    return np.mean([kernel(x[i], y[j]) for i, j in pairs])


def mmd2(x, y, kernel, groups=None):
    within = pairwise_mean(x, x, kernel, groups, True) + pairwise_mean(y, y, kernel, groups, True)
    return within - 2 * pairwise_mean(x, y, kernel, groups, False)


def test_embeddings_agree_with_loops_and_with_the_library():
    made = {name: SETS[name] for name in ("near", "far")}
    results = score(made, SETS["real"])
    scores = by_key(results)
    x, y = (SETS[name].features.astype(float) for name in ("far", "real"))

    def gauss(a, b):
        return 1000 * np.exp(-((a - b) ** 2).sum() / 200)

    def cubic(a, b):
        return 1000 * (a @ b / DIM + 1) ** 3

    for key, want in {
        ("TMMD", "far", "paper"): mmd2(x, y, gauss),
        ("TMMD", "far", "grouped"): mmd2(x, y, gauss, GROUPS),
        ("KID (embeddings)", "far", None): mmd2(x, y, cubic),
    }.items():
        assert scores[key].value == pytest.approx(want, rel=1e-9, abs=1e-6)
    library = compare(made, SETS["real"], floor=SETS["real"], preset="grouped")
    for s in [*library.scores, *library.differences]:
        got = scores[label_of(s), subject_of(s), "grouped"]
        assert (got.value, got.interval, got.floor) == (s.value, s.interval, s.floor), label_of(s)
    for metric in ("FID", "KID", "Precision", "Recall", "Density", "Coverage"):
        assert f"{metric} (embeddings)" in {m for m, _, _ in scores}
    assert results.settings["digests"] == {"encoder": "e" * 64, "reference": SETS["real"].digest}


@pytest.mark.parametrize("companion", ["kid", "prdc", "fid", "cmmd"])
def test_companions_on_features_have_paired_differences(companion):
    made = {name: SETS[name] for name in ("near", "far")}
    results = score(made, SETS["real"], companions=[companion], permutations=0)
    scores = by_key(results)
    metrics = {m for m, _, _ in scores if "(embeddings)" in m and "difference" not in m}
    assert metrics
    for metric in metrics:
        preset = "cmmd" if companion == "cmmd" else None
        a, b = (scores[metric, name, preset].value for name in made)
        difference = scores[f"{metric} difference", "near - far", preset]
        assert difference.value == pytest.approx(a - b, abs=1e-12)
    if companion == "kid":
        near = scores["KID (embeddings)", "near", None]
        options = {"kernel": Polynomial(), "normalize": False}
        direct = distance(SETS["near"].features, SETS["real"].features, **options).value
        assert near.value == pytest.approx(direct, abs=1e-6)
        assert "kid-interval" in [n.code for n in near.notes]


def test_differences_of_precision_take_the_groups_of_the_rows_they_average():
    order = np.random.default_rng(0).permutation(IDS)
    made = {"a": SETS["near"], "b": SETS["far"].take([*order])}
    few = 8 * FRAMES
    videos = [f"w{v}" for v in range(8) for _ in range(FRAMES)]
    names = [f"r{k}" for k in range(few)]
    real = FeatureSet(names, SETS["real"].features[:few], None, videos, "e" * 64)
    scores = by_key(score(made, real, companions=["prdc"], permutations=0))
    rows = [prdc_rows(SETS[name], real)[1] for name in ("near", "far")]
    per_generated, per_real = ("Precision", "Density"), ("Recall", "Coverage")
    for metric in (*per_generated, *per_real):
        groups = GROUPS if metric in per_generated else videos
        delta = rows[0][metric] - rows[1][metric]
        got = scores[f"{metric} (embeddings) difference", "a - b", None]
        assert got.value == pytest.approx(delta.mean(), abs=1e-12)
        interval = spread_of_values(delta, groups).interval()
        assert (got.interval is None) == (interval is None)
        assert interval is None or got.interval == pytest.approx(interval, abs=1e-9)


def test_bare_arrays_have_no_groups_and_pair_by_row():
    x = {name: SETS[name].features for name in ("near", "far")}
    results = score(x, SETS["real"].features, **FAST)
    scores = by_key(results)
    assert {preset for _, _, preset in scores} == {"paper"}
    want = distance(x["near"], SETS["real"].features).value
    assert scores["TMMD", "near", "paper"].value == pytest.approx(want, abs=1e-6)
    assert scores["CI-TMMD", "near", "paper"].value is None
    assert scores["TMMD difference", "near - far", "paper"].interval is None
    assert codes(results)[:2] == ["groups-unknown", "row-pairs"]
    results = score({"near": x["near"], "short": x["far"][:30]}, SETS["real"].features, **FAST)
    assert not [m for m, _, _ in by_key(results) if "difference" in m]
    assert codes(results) == ["groups-unknown", "no-differences"]
    results = score(x, SETS["real"].features, group="frame", **FAST)
    assert results["TMMD difference", "near - far"].interval is not None


def test_a_generator_in_another_order_takes_labels_and_groups_from_the_reference():
    order = np.random.default_rng(0).permutation(len(IDS))
    bare = FeatureSet([IDS[k] for k in order], SETS["far"].features[order])
    options = {"presets": ["grouped"], **FAST}
    want, got = (by_key(score({"g": s}, SETS["real"], **options)) for s in (SETS["far"], bare))
    assert want.keys() == got.keys()
    for key, s in want.items():
        assert got[key].value == pytest.approx(s.value, abs=1e-6), key


def test_several_bandwidths_have_names_of_their_own():
    made = {name: SETS[name] for name in ("near", "far")}
    options = {"sigma": [10, 1, "median", "multi"], "companions": ["cmmd"]}
    scores = by_key(score(made, SETS["real"], **options))
    x, y = SETS["far"].features, SETS["real"].features
    narrow = scores["TMMD (σ = 1)", "far", "paper"].value
    assert narrow == pytest.approx(distance(x, y, sigma=1).value, abs=1e-6)
    assert scores["TMMD (σ median)", "far", "paper"].settings["kernel"] == "gaussian, median"
    assert ("D-TMMD (σ multi) difference", "near - far", "grouped") in scores
    biased = distance(x, y, estimator="biased").value
    assert scores["CMMD (embeddings)", "far", "cmmd"].value == pytest.approx(biased, abs=1e-6)
    single = by_key(score(SETS["far"], SETS["real"], **{**FAST, "sigma": 1}))
    assert single["TMMD", "generated", "paper"].bandwidth == 1


def test_a_split_scores_the_test_part_against_the_floor_of_the_train_part():
    results = score({"g": SETS["far"]}, SETS["real"], split=SPLIT, **FAST)
    s = by_key(results)["TMMD", "g", "paper"]
    assert (s.n, s.m, s.split) == (24, 24, SPLIT.digest)
    real = SETS["real"]
    train, test = real.take(TRAIN), real.take(TEST)
    further = matched_features(train, test, 0)
    assert s.floor == pytest.approx(distance(further.features, test.features).value, abs=1e-6)
    assert codes(results) == ["outside-test-part", "groups", "groups-few"]
    part = by_key(score({"g": SETS["far"].take(TEST)}, real, split=SPLIT, **FAST))
    assert part["TMMD", "g", "grouped"].value == by_key(results)["TMMD", "g", "grouped"].value


def test_the_excess_has_a_floor_where_the_whole_score_has_none():
    real = SETS["real"]
    scores = by_key(score({"g": SETS["near"]}, real, presets=["grouped"], **FAST))
    whole, excess = scores["I-TMMD", "g", "grouped"], scores["I-TMMD E", "g", "grouped"]
    assert excess.value == whole.details["E"]
    assert excess.interval == tuple(whole.details["E_interval"])
    assert whole.floor == pytest.approx(i_tmmd(real).value, abs=1e-9)
    few = real.take([i for i, g in zip(IDS, GROUPS, strict=True) if g in sorted({*GROUPS})[::2]])
    scores = by_key(score({"a": SETS["near"], "b": SETS["far"]}, few, presets=["grouped"], **FAST))
    assert scores["I-TMMD", "a", "grouped"].floor is None  # another number of videos
    floor = scores["I-TMMD E", "a", "grouped"].floor
    assert floor == pytest.approx(i_tmmd(few).details["E"], abs=1e-9)
    assert scores["I-TMMD difference", "a - b", "grouped"].details["better"] is None


def test_collapse_and_copies_are_noted():
    real = SETS["real"]
    mean = real.features.mean(axis=0)
    still = dataclasses.replace(real, features=unit(mean + 0.05 * real.features))
    half = np.vstack([real.features[:5], SETS["far"].features[5:]])
    copied = dataclasses.replace(real, features=half)
    results = score({"still": still, "copied": copied}, real, **FAST)
    notes = by_key(results)["TMMD", "copied", "paper"].notes
    [copies] = [n.params for n in notes if n.code == "copied-rows"]
    assert copies == {"count": 5, "n": 48}
    below = {n.params["subject"] for n in results.notes if n.code == "below-floor"}
    assert below == {"still"}


def test_of_many_rows_only_fid_is_computed_by_default(monkeypatch):
    monkeypatch.setattr(scorers, "MANY", 10)
    results = score({"g": SETS["far"]}, SETS["real"], permutations=0)
    assert {m for m, _, _ in by_key(results) if "(embeddings)" in m} == {"FID (embeddings)"}
    assert codes(results) == ["groups", "wide-sigma-alone", *["too-many-rows"] * 2]
    assert [n.params["name"] for n in results.notes[2:]] == ["kid", "prdc"]
    results = score({"g": SETS["far"]}, SETS["real"], companions=["kid"], permutations=0)
    assert "KID (embeddings)" in {m for m, _, _ in by_key(results)}


def test_a_default_companion_that_cannot_be_computed_becomes_a_note():
    few = {name: s.take([IDS[0]]) for name, s in SETS.items()}
    results = score({"g": few["far"]}, few["real"], presets=["cmmd"], sigma=10, permutations=0)
    skipped = [n.params["name"] for n in results.notes if n.code == "companion-skipped"]
    assert skipped == ["fid", "prdc"]
    with pytest.raises(PalpateError):
        score({"g": few["far"]}, few["real"], presets=["cmmd"], sigma=10, companions=["fid"])


def test_two_plain_folders_show_sigma_10_and_multi_without_pairs_of_one_scene():
    ids = [str(k) for k in range(len(IDS))]  # which show no recording
    bare = {"ids": ids, "labels": None, "groups": None}
    made, real = (dataclasses.replace(SETS[k], **bare) for k in ("far", "real"))
    results = score({"g": made}, real, companions=[], permutations=0)
    wide, multi = results["TMMD", "g"], results["TMMD (σ multi)", "g"]
    assert (wide.bandwidth, wide.settings["preset"]) == (10, "grouped")
    assert (multi.settings["kernel"], multi.settings["preset"]) == ("gaussian, multi", "grouped")
    scenes = {"estimator": "grouped", "groups": IDS, "reference_groups": IDS}
    assert wide.value == pytest.approx(distance(made.features, real.features, **scenes).value)
    assert results["I-TMMD", "g"].settings["preset"] == "paper"
    [paper] = score({"g": made}, real, presets=["paper"], **FAST)["TMMD"]
    assert "dependent-pairs" in {n.code for n in paper.notes}


def changed(**fields) -> FeatureSet:
    return dataclasses.replace(SETS["far"], **fields)


PICTURES = np.random.default_rng(0).integers(0, 256, (12, 32, 32, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("generated", "options", "words"),
    [
        (SETS["far"], {"sigma": "ten"}, "`sigma` must be positive, .* Got 'ten'"),
        (SETS["far"], {"sigma": -1}, "`sigma`"),
        (changed(encoder="f" * 64), {}, "one encoder"),
        (changed(features=SETS["far"].features[:, :3]), {"normalize": True}, "same width"),
        (SETS["far"], {"permutations": -1}, "`permutations` must be a whole number"),
        (SETS["far"], {"companions": ["ssim"]}, "`companions` must need no images"),
        (SETS["far"], {"companions": ["sism"]}, "`companions` must be among"),
        (SETS["far"], {"encoder": "palpate/mini"}, "`encoder` must go with images"),
        (SETS["far"], {"clip": "x"}, "`clip` must go with images"),
        (SETS["far"], {"cache": "c"}, "`cache` must go with images"),
        (SETS["far"], {"group": "contact"}, "`group` must be known"),
        (changed(features=2 * SETS["far"].features), {}, "generated.* must be L2-norm"),
        (changed(groups=["", *GROUPS[1:]]), {}, "must be known for every row"),
        (PICTURES, {}, "`encoder` must be given for images"),
        (PICTURES, {"companions": ["contact"]}, "`companions` must need no background images"),
        (PICTURES, {"companions": ["lpips"]}, "`lpips` must hold .* alexnet-owt"),
        (PICTURES, {"companions": ["fid"]}, "without an encoder. Got fid.* inception-2015"),
        (PICTURES, {"companions": ["cmmd"]}, "clip-vit-large-patch14-336"),
    ],
)
def test_arguments_that_contradict_each_other(generated, options, words):
    reference = PICTURES if isinstance(generated, np.ndarray) else SETS["real"]
    fails(words, score, generated, reference, **options)


def test_nan_is_named_by_generator_and_id(tmp_path):
    x = SETS["far"].features.copy()
    x[7] = np.nan
    np.savez(tmp_path / "nan.npz", features=x, ids=np.array(IDS))
    with pytest.raises(PalpateError, match=r"nan\.npz: Features must be finite.*7: 'v1/1'"):
        score(tmp_path / "nan.npz", SETS["real"])


def test_scores_of_two_references_do_not_share_a_column():
    few = SETS["real"].take(IDS[:30])
    options = FAST | {"companions": ["kid"], "presets": ["grouped"]}
    first, second = (
        by_key(score({"g": SETS["far"]}, real, **options)) for real in (SETS["real"], few)
    )
    for key, s in first.items():
        if key[0].startswith(("TMMD", "KID")):
            assert s.reference == SETS["real"].digest
            fails("must agree in reference", require_comparable, [s, second[key]])
        else:
            require_comparable([s, second[key]])


# Images


def test_paired_differences_of_pixels_are_those_of_the_images(tmp_path, small_manifest):
    ids, contacts = small_manifest.ids, small_manifest.column("contact")
    a, b = (paint(tmp_path / name, ids, seed) for seed, name in enumerate("ab", 5))
    made = [tmp_path / "a", tmp_path / "b"]
    scores = by_key(score(made, small_manifest, companions=["psnr", "ms-ssim", "contact"]))
    files = zip(ids, small_manifest.paths("tactile"), strict=True)
    real = {i: np.asarray(Image.open(path)) for i, path in files}

    def psnr(x, i):
        return -10 * np.log10(((x[i] / 255 - real[i] / 255) ** 2).mean())

    values = {i: psnr(a, i) for i in ids}
    assert scores["PSNR", "a", None].value == pytest.approx(np.mean([*values.values()]), rel=1e-12)
    delta = {i: values[i] - psnr(b, i) for i in ids}
    difference = scores["PSNR difference", "a - b", None]
    assert difference.value == pytest.approx(np.mean([*delta.values()]), abs=1e-9)
    rows = [*zip(ids, contacts, strict=True)]  # six videos are too few
    means = [np.mean([delta[i] for i, c in rows if c == w]) for w in {*contacts}]
    p = stats.ttest_1samp(means, 0).pvalue
    assert difference.details["p_value"] == pytest.approx(p, rel=1e-9)
    assert difference.details["better"] == ("a" if difference.value > 0 else "b")
    assert {"MS-SSIM", "contact residual", "contact IoU difference"} <= {m for m, _, _ in scores}


def test_images_in_memory_pair_by_position_on_request():
    made = 255 - PICTURES
    [s] = score([Image.fromarray(x) for x in made], PICTURES, companions=["ssim"])
    assert s.value == pytest.approx(ssim(made, PICTURES).value, abs=1e-12)


def test_lpips_is_the_mean_over_pairs(tmp_path, small_manifest):
    pytest.importorskip("torch")
    from forge.models import random_states, save_states
    from palpate.encoders.perceptual import load_lpips, lpips_per_image

    made = {n: paint(tmp_path / n, small_manifest.ids, seed) for seed, n in enumerate("ab", 5)}
    files = save_states(random_states(), tmp_path)
    folders = [tmp_path / n for n in made]
    scores = by_key(score(folders, small_manifest, companions=["lpips"], lpips=files))
    network = load_lpips(*files)
    real = np.stack([np.asarray(Image.open(p)) for p in small_manifest.paths("tactile")])
    values = {
        n: lpips_per_image(np.stack([images[i] for i in small_manifest.ids]), real, network)
        for n, images in made.items()
    }
    for n, v in values.items():
        assert scores["LPIPS", n, None].value == pytest.approx(v.mean(), rel=1e-5)
    difference = scores["LPIPS difference", "a - b", None].value
    assert difference == pytest.approx((values["a"] - values["b"]).mean(), rel=1e-3, abs=1e-6)


def test_unpaired_images_are_an_error_and_disjoint_ones_a_note(tmp_path):
    pytest.importorskip("torch")
    for seed, (name, ids) in enumerate({"real": "123", "some": "124", "other": "789"}.items()):
        paint(tmp_path / name, [*ids], seed)
    real = tmp_path / "real"
    words = r"ids of some and .*1 not in some: '3'; 1 not in reference: '4'"
    fails(words, score, tmp_path / "some", real, companions=["ssim"])
    options = {"encoder": "palpate/mini", "presets": ["paper"], "permutations": 0}
    results = score(tmp_path / "other", real, **options)
    assert "no-pairs" in codes(results)
    assert not {m for m, _, _ in by_key(results)} & {"SSIM", "PSNR"}


def test_images_of_several_sizes(tmp_path):
    for name, side in (("real", 32), ("small", 16), ("same", 32)):
        paint(tmp_path / name, ["1", "2"], 0, side=side)
    paint(tmp_path / "mixed", ["1"], 0, side=32)
    paint(tmp_path / "mixed", ["2"], 0, side=16)
    real, psnr = tmp_path / "real", {"companions": ["psnr"]}
    fails("small 16, same 32", score, [tmp_path / "small", tmp_path / "same"], real, **psnr)
    fails(r"1\.png of 32 x 32 and 2\.png of 16 x 16", score, tmp_path / "mixed", real, **psnr)
    [_, resized] = score(tmp_path / "small", real, **psnr).notes
    assert (resized.code, resized.params) == ("resized", {"size": 16, "side": 32})
    assert codes(score(tmp_path / "same", real, **psnr)) == ["groups-unknown"]
    (tmp_path / "same" / "2.png").write_bytes(b"\x89PNG broken")
    fails(r"2\.png", score, tmp_path / "same", real, **psnr)


def test_the_digest_of_images_is_that_of_a_copy_and_not_that_of_others(tmp_path):
    for seed, name in enumerate(("real", "made", "other")):
        paint(tmp_path / name, ["v/1", "v/2", "v/3"], seed)
    shutil.copytree(tmp_path / "real", tmp_path / "copy")
    digests = {}
    for name in ("real", "copy", "other"):
        results = score(tmp_path / "made", tmp_path / name, companions=["psnr"])
        digests[name] = results.settings["digests"]["reference"]
        assert {s.reference for s in results} == {digests[name]}
    assert digests["real"] == digests["copy"] != digests["other"]


@pytest.fixture(scope="module")
def mini():
    pytest.importorskip("torch")
    from palpate.encoders.encoder_set import EncoderSet

    return EncoderSet.load("palpate/mini")


@pytest.fixture
def split(small_manifest) -> Split:
    ids, rule = small_manifest.ids, {"group": "video"}
    return Split.from_ids(train=ids[:24], test=ids[24:], rule=rule, manifest=small_manifest.digest)


def embedded(manifest, mini, groups="video", like=None):
    """By the shipped ruler, standardized by ``like``, a part of the same reference."""
    from palpate.encoders.embed import embed
    from palpate.metrics.retrieval import standardized

    rows = embed(manifest, mini, "tactile", groups=groups, raw=True)
    (x,), _ = standardized([rows.features], embed(like or manifest, mini, raw=True).features)
    return dataclasses.replace(rows, features=x)


def test_images_are_embedded_and_scored_as_their_features(tmp_path, small_manifest, mini):
    from palpate.encoders.embed import embed

    for seed, name in enumerate("ab"):
        paint(tmp_path / name, small_manifest.ids, seed)
    results = score([tmp_path / "a", tmp_path / "b"], small_manifest, encoder=mini, permutations=19)
    scores = by_key(results)
    shown = [str(tmp_path / "a" / f"{i}.png") for i in small_manifest.ids]
    table = small_manifest.table.with_columns(tactile=pl.Series(shown))
    made = dataclasses.replace(small_manifest, table=table, guarded=False)
    by_reference = (embedded(m, mini, "contact", small_manifest) for m in (made, small_manifest))
    by_card = (embed(m, mini, groups="contact") for m in (made, small_manifest))
    both = (
        compare({"a": a}, b, floor=b, preset="grouped", permutations=19).scores
        for a, b in (by_reference, by_card)
    )
    for compared, alone in zip(*both, strict=True):
        s = compared if compared.metric == "TMMD" else alone
        got = scores[label_of(s), "a", "grouped"].value
        # Blocks of other sizes round float32 features otherwise. None: not defined.
        want = s.value and pytest.approx(s.value, rel=1e-5, abs=1e-6)
        assert got == want, label_of(s)
    metrics = {m for m, _, _ in scores}
    pixels = {"SSIM", "MS-SSIM", "contact residual"}
    assert {"FID (tactile) difference", "Precision (tactile)", *pixels} <= metrics
    assert not [m for m in metrics if m.startswith(("CMMD", "LPIPS", "material"))]
    assert results.settings["digests"]["tactile encoder"] == mini.digest("tactile")
    assert len(results.gallery) == 40
    cmmd = by_key(score(tmp_path / "a", small_manifest, companions=["cmmd"], clip="palpate/mini"))
    assert cmmd["CMMD (CLIP)", "a", "cmmd"].encoder == mini.digest("vision")


def test_a_split_scores_controls_and_a_material_probe(tmp_path, small_manifest, mini, split):
    paint(tmp_path / "g", split.ids("test"), 1)
    options = {"encoder": mini, "split": split, "permutations": 0, "companions": ["ssim"]}
    results = score(tmp_path / "g", small_manifest, **options)
    scores = by_key(results)
    tested = small_manifest.part(split, "test")
    real = embedded(small_manifest, mini, like=tested)
    test, train = (real.take(small_manifest.part(split, part).ids) for part in ("test", "train"))
    floor = distance(train.features, test.features).value
    assert scores["TMMD", "g", "paper"].floor == pytest.approx(floor, abs=1e-6)
    controls = {"background only", "real, same material"}
    assert {subject for m, subject, _ in scores if m == "TMMD"} == {"g", *controls}
    table = small_manifest.table.with_columns(tactile=pl.col("background"))
    gel = embedded(Manifest(table, small_manifest.root), mini, like=tested).take(test.ids)
    want = distance(gel.features, test.features).value
    assert scores["TMMD", "background only", "paper"].value == pytest.approx(want, abs=1e-4)
    probed = {subject for m, subject, _ in scores if m == "material accuracy"}
    assert probed == {"g", "background only", "real"}
    assert not [m for m, _, _ in scores if "difference" in m]
    doubts = [n.code for n in scores["TMMD", "g", "paper"].notes]
    assert doubts == ["synthetic-encoder"], "palpate/mini says which images it has seen: none"
    fewer = by_key(score(tmp_path / "g", small_manifest, controls=False, **options))
    assert {subject for _, subject, _ in fewer} == {"g", "real"}
    for key, s in fewer.items():
        assert scores[key].value == s.value or s.value == pytest.approx(scores[key].value), key
    with pytest.raises(PalpateError, match=r"`names` must not be .*'real'"):
        score({"real": tmp_path / "g"}, small_manifest, **options)


@pytest.mark.parametrize(
    ("facts", "sensor", "real"),
    [({"synthetic": "yes"}, None, None), ({}, "GelSight", True), ({}, None, False)],
)
def test_an_encoder_of_simulated_images_says_so_in_every_score(
    tmp_path, small_manifest, mini, facts, sensor, real
):
    paint(tmp_path / "g", small_manifest.ids, 1)
    table = small_manifest.table.with_columns(pl.lit(sensor, pl.String).alias("sensor"))
    reference = Manifest(table, small_manifest.root, facts)
    results = score(tmp_path / "g", reference, encoder=mini, permutations=0)
    notes = {
        label_of(s): [n.params["real"] for n in s.notes if n.code == "synthetic-encoder"]
        for s in results
        if s.encoder
    }
    assert {"TMMD", "TMMD (σ multi)", "I-TMMD E", "FID (tactile)"} <= {*notes}
    assert all(found == ([] if real is None else [real]) for found in notes.values())
    assert not [n for s in results if not s.encoder for n in s.notes if "encoder" in n.code]


def test_one_background_stands_for_all_images_of_a_folder(tmp_path, small_manifest):
    real = tmp_path / "real"
    for row in small_manifest.table.iter_rows(named=True):
        file = real / f"{row['id']}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(small_manifest.path(row["tactile"]), file)
    paint(tmp_path / "g", small_manifest.ids, 1)
    gel = small_manifest.path(small_manifest.table["background"][0])
    contact = {"companions": ["contact"]}
    results = score(tmp_path / "g", real, background=gel, **contact)
    pixels = [np.asarray(Image.open(f).convert("RGB")) for f in (gel, *sorted(real.rglob("*.png")))]
    made = [np.asarray(Image.open(f)) for f in sorted((tmp_path / "g").rglob("*.png"))]
    want = contact_scores(np.stack(made), np.stack(pixels[1:]), pixels[0])
    for s in want:
        got = results[label_of(s), "g"]
        assert got.value == pytest.approx(s.value)
        assert got.settings["background"] == s.settings["background"]
    fails(r"background='gel\.png'", score, tmp_path / "g", real, **contact)
    fails("`background` must go with images", score, SETS["far"], SETS["real"], background=gel)


def test_clusters_stand_in_for_materials_and_say_so(tmp_path, small_manifest, mini):
    bare = {k: dataclasses.replace(SETS[k], labels=None) for k in ("near", "far", "real")}
    results = score({"a": bare["near"], "b": bare["far"]}, bare["real"], labels="cluster:3", **FAST)
    for metric, marked in {"TMMD": False, "I-TMMD": False, "CI-TMMD": True, "D-TMMD": True}.items():
        for s in [*results[metric], *results[f"{metric} difference"]]:
            assert ("pseudo-labels" in {n.code for n in s.notes}) == marked
            assert (s.settings.get("labels") == "cluster:3 of the reference's features") == marked
    assert {*results["CI-TMMD"][0].details["classes"]} <= {f"cluster {k}" for k in (1, 2, 3)}
    again = score(bare["near"], bare["real"], labels="cluster:3", **FAST)
    assert again["D-TMMD", "generated"].value == results["D-TMMD", "a"].value
    paint(tmp_path / "g", small_manifest.ids, 1)
    options = {"encoder": mini, "labels": "cluster:2", **FAST}
    of_photos = score(tmp_path / "g", small_manifest, **options)["CI-TMMD", "g"]
    assert of_photos.settings["labels"] == "cluster:2 of photos"
    ruler = {**options, "encoder": "palpate/handcrafted"}
    by_ruler = score(tmp_path / "g", small_manifest, **ruler)["CI-TMMD", "g"]  # it sees no photo
    assert by_ruler.settings["labels"] == "cluster:2 of the reference's features"
    for labels, made, words in (
        ("cluster:x", bare["far"], "cluster: and a number"),
        ("cluster:40", bare["far"], "four samples a cluster"),
        ("cluster:3", bare["far"].features, "share no ids"),
    ):
        fails(words, score, made, bare["real"], labels=labels, **FAST)


def test_tactile_images_without_photos_are_scored(tmp_path, small_manifest, mini):
    paint(tmp_path / "g", small_manifest.ids, 1)
    table = small_manifest.table.with_columns(vision=pl.lit(None, pl.String))
    reference = Manifest(table, small_manifest.root)
    ids = small_manifest.ids
    split = Split.from_ids(train=ids[:24], test=ids[24:], rule={}, manifest=reference.digest)
    results = score(tmp_path / "g", reference, encoder=mini, split=split, permutations=0)
    subjects = {subject_of(s) for s in results["TMMD"]}
    assert subjects == {"g", "background only", "real, same material"}
    results.to_html(tmp_path / "page.html")
    labels = score(tmp_path / "g", reference, encoder=mini, labels="cluster:2", **FAST)
    assert labels["CI-TMMD", "g"].settings["labels"] == "cluster:2 of the reference's features"


def test_an_interrupted_run_goes_on_from_its_embeddings(
    tmp_path, monkeypatch, small_manifest, mini
):
    for seed, name in enumerate("ab"):  # of one size and time
        paint(tmp_path / name, small_manifest.ids, seed, ".bmp")
        for file in (tmp_path / name).rglob("*.bmp"):
            os.utime(file, ns=(10**18, 10**18))
    made = [tmp_path / "a", tmp_path / "b"]
    options = {"encoder": mini, "companions": ["psnr"], "permutations": 0}
    plain = by_key(score(made, small_manifest, **options))
    cache = tmp_path / "cache"
    with monkeypatch.context() as stop:
        stop.setattr(scorers, "compare", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            score(made, small_manifest, cache=cache, **options)
    embedded_once = {*cache.rglob("tactile-*.npy")}
    assert len(embedded_once) == 3
    monkeypatch.setattr(samples, "IN_MEMORY", 0)  # every image in a file of the cache
    monkeypatch.setattr(type(mini), "encode", lambda *_, **__: pytest.fail("embedded again"))
    again = by_key(score(made, small_manifest, cache=cache, **options))
    assert again.keys() == plain.keys()
    for key, s in plain.items():
        assert again[key].value == s.value or again[key].value == pytest.approx(s.value, abs=1e-6)
    assert len({*cache.rglob("tactile-*.npy")} - embedded_once) == 3  # the images


@pytest.mark.parametrize("column", ["tactile", "background"])
def test_another_image_of_the_same_name_size_and_time_is_not_taken_from_the_cache(
    tmp_path, monkeypatch, small_manifest, column
):
    """Decoded images in a cache are of the bytes of now."""
    monkeypatch.setattr(samples, "IN_MEMORY", 0)
    some = small_manifest.take(small_manifest.ids[:4])
    paths = [tmp_path / "root" / f"{column}{k}.bmp" for k in range(4)]
    for path, old in zip(paths, some.paths(column), strict=True):
        Image.open(old).save(path)
        os.utime(path, ns=(10**18, 10**18))
    real = Manifest(some.table.with_columns(pl.Series(column, [p.name for p in paths])), some.root)
    paint(tmp_path / "g", some.ids, 0)

    def values(cache=None):
        results = score(tmp_path / "g", real, companions=["psnr", "contact"], cache=cache)
        return [s.value for s in results]

    before = values()
    assert values(tmp_path / "cache") == before
    for path in paths:
        Image.open(path).point(lambda v: min(255, v + 40)).save(path)
        os.utime(path, ns=(10**18, 10**18))
    after = values()
    assert after != before
    assert values(tmp_path / "cache") == after


def test_pairs_without_a_finite_value_are_excluded_from_a_difference():
    from palpate.metrics.paired import mean_differences

    rng = np.random.default_rng(0)
    a, b = rng.normal(30, 1, 20), rng.normal(28, 1, 20)
    a[3], b[5] = np.inf, np.nan
    kept = [k for k in range(20) if k not in (3, 5)]
    scores = {name: Score("PSNR", name, 1.0, higher_is_better=True) for name in "ab"}
    [difference] = mean_differences(scores, {"a": a, "b": b}, None)
    assert difference.value == pytest.approx((a - b)[kept].mean(), rel=1e-12)
    assert (difference.details["better"], difference.details["decided"]) == ("a", True)
