"""Rulers: residuals, what is subtracted where the right image is missing, and numbers without
training, against loops written here.
"""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image

from forge.errors import fails
from forge.worlds import by_video, six_videos
from palpate import probe, score
from palpate.core import FeatureSet, rng_for
from palpate.data.manifest import Manifest
from palpate.data.residuals import Residual, with_gels
from palpate.encoders import Encoder, EncoderSet
from palpate.encoders.embed import embed
from palpate.encoders.rulers import Handcrafted
from palpate.evaluation import power as module
from palpate.evaluation.power import power
from palpate.metrics import tmmd
from palpate.report.notes import sentence
from palpate.report.tables import families
from palpate.studies.verifying import verify

SIDE = 24
NAME = "palpate/handcrafted"


@pytest.fixture(scope="module")
def handcrafted():
    return EncoderSet.load(NAME)


def touches(folder, n=24, *, seed=0, gel=None, **columns):
    """A manifest of touches (a bump on a gel of colored light), with columns k -> value."""
    rng, rows = np.random.default_rng(seed), []
    y, x = np.mgrid[:SIDE, :SIDE]
    gel = np.stack([90 + 3 * x, 140 - 2 * y, 100 + x + y], 2) if gel is None else gel
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(gel.astype(np.uint8)).save(folder / "gel.png")
    for k in range(n):
        cy, cx = rng.uniform(6, 18, 2)
        bump = 30 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / rng.uniform(4, 20))
        image = (
            gel + (bump * np.sin(x * rng.uniform(0.5, 2)))[..., None] + rng.normal(0, 1, gel.shape)
        )
        Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(folder / f"{k}.png")
        row = {"id": f"{k}", "tactile": f"{k}.png"}
        rows.append(row | {name: of(k) for name, of in columns.items()})
    return Manifest.from_rows(rows, folder)


def files(manifest):
    return [p and str(manifest.path(p)) for p in manifest.column("background")]


def pixels(manifest, rows=None):
    paths = manifest.paths("tactile")
    return np.stack([np.asarray(Image.open(paths[k])) for k in rows or range(len(paths))])


def test_a_residual_keeps_what_averages_of_8_bits_lose():
    gel = np.full((8, 12, 3), 100, np.uint8)
    image = gel.copy()
    image[::2, 2:10, 1] += 1  # half a gray level on average
    prepared = Residual(4, 4).prepare(Image.fromarray(image), Image.fromarray(gel))
    assert prepared.dtype == np.float16
    assert prepared.shape == (4, 4, 3)
    assert prepared[1:3, :, 1].mean() == pytest.approx(0.5, abs=0.02)
    assert not prepared[..., [0, 2]].any()
    # Negative and large differences are not cut.
    dark = Residual(4, 4).prepare(Image.fromarray(gel * 0), Image.fromarray(gel))
    assert (dark == -100).all()


def test_without_a_background_low_frequencies_go_and_an_offset_with_them():
    y, x = np.mgrid[:64, :64]
    light = 60 + x + y / 2
    grain = 20 * np.sin(x * 1.5)
    image = Image.fromarray(np.repeat((light + grain)[..., None], 3, 2).round().astype(np.uint8))
    plain = Image.fromarray(np.repeat(light[..., None], 3, 2).round().astype(np.uint8))
    left, none = (Residual(64, 64).prepare(i).astype(float) for i in (image, plain))
    assert left.std() > 12
    assert np.abs(none[8:-8, 8:-8]).max() < 2


LEVELS = {
    "no contact": {"background": lambda k: "gel.png"},
    "other objects": {
        "sensor": lambda k: "g1",
        "session": lambda k: f"day {k % 2}",
        "object": lambda k: f"o{k // 2}",
    },
    "own video": {"video": lambda k: f"v{k // 8}"},
    "whole set": {"video": lambda k: f"v{k // 2}"},
}


@pytest.mark.parametrize("kind", LEVELS)
def test_the_best_background_that_there_is(tmp_path, kind):
    real = touches(tmp_path / "r", 48, **LEVELS[kind])
    generated = replace(real, table=real.table.select("id", "tactile")).table
    generated = Manifest.from_rows(generated.to_dicts(), real.root).take(real.ids[:5])
    got, (r, g) = with_gels(real, [generated], tmp_path / "gels")
    assert got == kind
    assert files(g) == files(r)[:5]  # of the real images that they stand for
    gels = [np.asarray(Image.open(f)) for f in files(r)]
    rows = {
        "other objects": [k for k in range(48) if k % 2 == 0],
        "own video": range(8),
        "whole set": range(48),
    }
    if kind == "no contact":
        assert {*files(r)} == {str((tmp_path / "r" / "gel.png").resolve())}
    else:
        middle = np.median(pixels(real, [*rows[kind]]), axis=0)
        assert np.abs(gels[0] - middle).max() <= 0.5


def test_sets_that_stand_for_no_real_image_take_the_same_kind(tmp_path):
    own = touches(tmp_path / "r", 48, video=lambda k: f"v{k // 8}")
    other = touches(tmp_path / "g", 30, seed=1)
    other = replace(other, table=other.table.with_columns(id="new " + pl.col("id")))
    kind, (r, g) = with_gels(own, [other], tmp_path / "gels")
    assert kind == "whole set"  # of the reference: never of generated images
    assert {*files(r)} == {*files(g)}
    kind, (r, g) = with_gels(own.take(own.ids[:19]), [other], tmp_path / "gels")
    assert kind == "low-pass"
    assert {*files(r), *files(g)} == {None}
    recorded = touches(tmp_path / "x", 5, background=lambda k: "gel.png")
    assert with_gels(recorded, [other], tmp_path / "gels")[0] == "no contact"  # one gel for all
    # What a set states of itself goes before what the real images of its ids have.
    elsewhere = touches(tmp_path / "y", 3, seed=2, background=lambda k: "gel.png")
    kind, (r, g) = with_gels(recorded, [elsewhere], tmp_path / "gels")
    assert {*elsewhere.ids} <= {*recorded.ids}
    assert (kind, {*files(g)}) == ("no contact", {str(tmp_path / "y" / "gel.png")})
    # One object touched often is no background of its touches.
    same = touches(tmp_path / "s", 48, object=lambda k: "one")
    assert with_gels(same, [], tmp_path / "gels")[0] == "low-pass"


def test_other_real_images_keep_their_own_gel_whatever_ids_they_share(tmp_path):
    real = touches(tmp_path / "r", 6, background=lambda k: "gel.png")
    train = touches(tmp_path / "t", 12, seed=1, background=lambda k: "gel.png")
    kind, (_, t) = with_gels(real, [train], tmp_path / "gels", real=[0])
    assert kind == "no contact"
    assert {*files(t)} == {str((tmp_path / "t" / "gel.png").resolve())}


def test_scores_without_a_reference_name_the_medians_of_it(tmp_path, handcrafted):
    sides = {n: touches(tmp_path / n, 30, seed=s) for s, n in enumerate("abg")}
    options = OPTIONS | {"presets": ["paper"]}
    found = [score(pixels(sides["g"]), pixels(sides[n]), **options) for n in "ab"]
    digests = [r["I-TMMD", "generated"].encoder for r in found]
    assert digests[0] != digests[1]
    again = score(pixels(sides["g"]), pixels(sides["a"]), **options)
    assert again["I-TMMD", "generated"].encoder == digests[0]


def numbers_of(residuals):
    encoder = Handcrafted({"center": torch.zeros(149)})
    return encoder.numbers(torch.tensor(residuals, dtype=torch.float32)).numpy()


def test_the_numbers_of_a_residual_are_those_of_loops():
    r = np.random.default_rng(0).normal(0, 5, (3, 96, 96))
    numbers = numbers_of(r[None])[0]
    assert numbers.shape == (149,)
    gray, side = r.mean(0), 96
    # The seventh ring of the spectrum of gray.
    edges = [0.5, 1.5, 2.5, 3.5, 4.5, *np.geomspace(5.5, 48, 13)]
    window = [0.5 - 0.5 * math.cos(2 * math.pi * k / (side - 1)) for k in range(side)]
    power = np.abs(np.fft.fft2((gray - gray.mean()) * np.outer(window, window))) ** 2 / side**2
    inside = []
    for i in range(side):
        for j in range(side):
            radius = math.hypot(min(i, side - i), min(j, side - j))
            if edges[6] <= radius < edges[7]:
                inside.append(power[i, j])
    assert numbers[6] == pytest.approx(math.log(np.mean(inside) + 1e-4), rel=1e-4)
    # The area above 4 gray levels, of a field that is blurred by (1, 4, 6, 4, 1) / 16.
    colors = np.stack([gray, r[0] - r[1], (r[0] + r[1]) / 2 - r[2]])
    small = colors.reshape(3, 48, 2, 48, 2).mean((2, 4))
    for axis in (1, 2):
        turned = np.moveaxis(small, axis, 0)
        padded = np.pad(turned, ((2, 2), (0, 0), (0, 0)), mode="reflect")
        weights = (1, 4, 6, 4, 1)
        blurred = sum(w / 16 * padded[k : k + 48] for k, w in enumerate(weights))
        small = np.moveaxis(blurred, 0, axis)
    assert numbers[51 + 36] == pytest.approx((np.sqrt((small**2).sum(0)) > 1).mean(), abs=1e-3)
    # Binary patterns of single pixels.
    counts = np.zeros(10)
    ring = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]
    for i in range(1, side - 1):
        for j in range(1, side - 1):
            above = [gray[i + a, j + b] >= gray[i, j] for a, b in ring]
            changes = sum(above[k] != above[k - 1] for k in range(8))
            counts[sum(above) if changes <= 2 else 9] += 1
    assert numbers[119:129] == pytest.approx(counts / counts.sum(), abs=1e-5)


def test_numbers_are_finite_where_nothing_touches_and_turn_with_the_light():
    assert np.isfinite(numbers_of(np.zeros((1, 3, 96, 96)))).all()
    r = np.random.default_rng(1).normal(0, 4, (1, 3, 96, 96))
    a, b = numbers_of(r)[0], numbers_of(r[..., ::-1, :].copy())[0]
    same = [*range(51), *range(87, 98)]  # spectrum, areas and strengths know no up
    assert a[same] == pytest.approx(b[same], abs=2e-3)


OPTIONS = {"companions": [], "permutations": 0, "encoder": NAME, "presets": ["paper"], "sigma": 10}


def test_a_folder_with_and_one_without_backgrounds(tmp_path, handcrafted):
    columns = {"video": lambda k: f"v{k // 4}"}
    bare = touches(tmp_path / "r", 48, **columns)
    known = touches(tmp_path / "k", 48, background=lambda k: "gel.png", **columns)
    fakes = [touches(tmp_path / name, 48, seed=s) for name, s in (("g", 7), ("h", 8))]
    for name in "gh":
        (tmp_path / name / "gel.png").unlink()  # in a folder every image is a sample
    results = [score(tmp_path / "g", r, **OPTIONS) for r in (bare, known)]
    words = [" ".join(sentence(n) for n in r.notes) for r in results]
    assert "the median of the whole reference" in words[0]
    assert "their no-contact images" in words[1]
    digests = [r["TMMD", "g"].encoder for r in results]
    assert len({*digests, handcrafted.digest("tactile")}) == 3
    bare.save(tmp_path / "r" / "manifest.parquet")
    loaded = score(tmp_path / "g", tmp_path / "r" / "manifest.parquet", **OPTIONS)
    assert loaded["TMMD", "g"].value == results[0]["TMMD", "g"].value  # medians lie elsewhere
    # Features of other kinds of background are those of another encoder: never in one column.
    again = score(tmp_path / "h", known, **OPTIONS)
    assert again["TMMD", "h"].encoder == digests[1]
    # Generators that all make one image are as bad as any: their residual is that of their image.
    one = np.repeat(pixels(fakes[0], [0]), 48, axis=0)
    collapsed = score({"good": pixels(fakes[1]), "one": one}, pixels(known), **OPTIONS)
    good, bad = (collapsed["TMMD", n].value for n in ("good", "one"))
    assert bad > 2 * abs(good)


def test_one_background_for_all_and_arrays_in_memory(tmp_path):
    real, other = (touches(tmp_path / n, 30, seed=s) for n, s in (("r", 0), ("g", 1)))
    gel = np.asarray(Image.open(tmp_path / "r" / "gel.png"))
    options = OPTIONS | {"background": gel}
    memory = score(pixels(other), pixels(real), **options)
    assert any("no-contact" in sentence(n) for n in memory.notes)
    known = real.table.with_columns(background=pl.lit("gel.png"))
    direct = score({"generated": pixels(other)}, replace(real, table=known), **OPTIONS)
    assert memory["TMMD", "generated"].value == pytest.approx(
        direct["TMMD", "generated"].value, abs=1e-6
    )


def test_probe_and_embeddings_by_a_ruler(tmp_path, handcrafted):
    manifest = six_videos(tmp_path)
    split = by_video(manifest, "v0", "v1", "v2")
    results = probe(manifest, split, encoder=[NAME, "palpate/mini"], top=())
    assert results["material accuracy, 20-NN", "handcrafted"].value == 1.0  # three levels of gray
    assert any(note.code == "background-kind" for note in results.notes)
    rows = embed(manifest, handcrafted).features
    assert rows.shape == (48, 149)
    encoder = Encoder(handcrafted, "tactile")
    assert encoder.license == "Apache-2.0"
    assert not encoder.saw(manifest).any()


def test_power_is_the_share_of_draws_that_tell_two_classes_apart(monkeypatch):
    monkeypatch.setattr(module, "DRAWS", 16)
    rng, quiet = np.random.default_rng(0), lambda *_: None
    recordings = np.repeat(np.arange(50), 3)  # 20 of a, 30 of b
    x = rng.normal(size=(150, 6))
    x[recordings >= 20] += 4  # as the classes are, far apart
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    noise = rng.normal(size=(150, 6))
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    labels = ["a" if r < 20 else "b" for r in recordings]
    groups = [f"v{r}" for r in recordings]
    ids = [str(k) for k in range(150)]
    sets = {n: FeatureSet(ids, f, labels, groups) for n, f in (("sees", x), ("blind", noise))}
    means = power(sets, "hardness", progress=quiet)
    names = [(m.score.metric, m.score.features) for m in means["sees"]]
    power_at = "power of TMMD, {} recordings a side"
    assert names == [(power_at.format(n), "hardness") for n in (5, 10)]  # 20 would be all of a
    assert [m.score.value for m in means["sees"]] == [1, 1]
    assert max(m.score.value for m in means["blind"]) <= 0.25
    # The share by hand: the same draws, one test each.
    hits = []
    for draw in range(16):
        draws = rng_for(0, "power", f"hardness 5 {draw}")
        sides = [
            draws.choice(np.array(sorted({*g})), 5, replace=False)
            for g in ([v for v, c in zip(groups, labels, strict=True) if c == k] for k in "ab")
        ]
        rows = [[k for k, v in enumerate(groups) if v in side] for side in sides]
        first, second = (noise[r] for r in rows)
        of = [[groups[k] for k in r] for r in rows]
        test = tmmd(
            first,
            second,
            groups=of[0],
            reference_groups=of[1],
            preset="grouped",
            permutations=199,
            seed=draw,
        )
        hits.append(test.details["p_value"] <= 0.05)
    assert means["blind"][0].score.value == np.mean(hits)
    # A recording with both classes stands for neither: of four recordings none has five.
    both = [labels[k] if k % 3 else "a" for k in range(150)]
    assert not power({"sees": replace(sets["sees"], labels=both)}, "hardness", progress=quiet)[
        "sees"
    ]


def test_probe_of_one_encoder_against_another(tmp_path, monkeypatch):
    manifest = touches(
        tmp_path, 96, video=lambda k: f"v{k // 3}", material=lambda k: f"m{k // 3 % 2}"
    )
    monkeypatch.setattr(module, "DRAWS", 16)
    split = by_video(manifest, *(f"v{k}" for k in range(10)))
    results = probe(manifest, split, encoder=NAME, against="palpate/mini", top=())
    power_of = [s for s in results.scores if s.metric.startswith("power")]
    assert {s.a for s in power_of} == {"handcrafted", "mini"}
    assert {(s.metric, s.features) for s in power_of} == {
        ("power of TMMD, 5 recordings a side", "material")
    }
    assert any(s.b for s in power_of)  # paired
    assert any(note.code == "verdict-of-two" for note in results.notes)
    assert "Power of material" in [family.title for family in families(results.scores)]
    manifest.save(tmp_path / "manifest.parquet")
    split.save(tmp_path / "split.json")
    files = (tmp_path / "manifest.parquet", tmp_path / "split.json")
    probe(*files, encoder=NAME, against="palpate/mini", top=()).save(tmp_path / "results.json")
    counts = verify(tmp_path / "results.json").counts  # what it records can be called again
    assert counts["same"] > 0 == counts["differs"] == counts["cannot check"]
    fails("against", probe, manifest, split, encoder=[NAME, NAME + "/"], against="palpate/mini")


def test_a_second_opinion_by_the_ruler_without_training(tmp_path):
    columns = {"video": lambda k: f"v{k // 4}", "background": lambda k: "gel.png"}
    real, fake = (touches(tmp_path / n, 48, seed=s, **columns) for n, s in (("r", 0), ("g", 1)))
    options = OPTIONS | {"encoder": "palpate/mini"}
    results = score(fake, real, check_ruler=True, **options)
    second = results["TMMD (handcrafted)", "generated"]
    direct = score(fake, real, **OPTIONS | {"presets": None, "sigma": None})
    assert second.value == pytest.approx(direct["TMMD", "generated"].value)
    assert second.encoder != results["TMMD", "generated"].encoder
    fails("palpate/handcrafted", score, fake, real, check_ruler=True, **OPTIONS)


def test_an_unknown_name_of_palpate_is_refused():
    fails("palpate/mini, palpate/handcrafted", EncoderSet.load, "palpate/other")
