"""Near-duplicates: the similarity against a slow one, calibration, causes, groups, bad files."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from PIL import Image

from leakage_fixtures import MATERIALS, NoiseVideo, crop, make_leaky, save
from palpate.core import PalpateError, quiet
from palpate.data.manifest import Manifest
from palpate.leakage import calibration, near
from palpate.leakage.background import remove_background
from palpate.leakage.correlation import REACH, band_pass, similarities, similarity_grid
from palpate.leakage.matches import Entries, Matcher, Matches
from palpate.leakage.near import near_duplicates, near_groups
from palpate.leakage.pool import quantized
from palpate.leakage.similarity import ImageSimilarity, best_matches
from palpate.leakage.thumbnails import SIDE, thumbnail, thumbnails

DROPPED = ("video", "contact", "object", "session", "material", "sensor", "domain")


def anonymous(manifest):
    table = manifest.table.with_columns(
        pl.lit(None, pl.String).alias(c) for c in DROPPED
    ).with_columns(frame=pl.lit(None, pl.Int64))
    return Manifest(table, manifest.root)


def fields(n, seed=0, sigma=2.0):
    from scipy import ndimage

    x = ndimage.gaussian_filter(
        np.random.default_rng(seed).standard_normal((n, 3, 48, 48)), (0, 0, sigma, sigma)
    )
    return (40 * x / x.std()).astype(np.float32)


def test_similarity_is_the_best_overlap_at_whole_offsets_and_more_between():
    x = quantized(band_pass(fields(6)[:, :, :SIDE, :SIDE]))
    i, j = np.array([0, 0, 1, 2, 4]), np.array([0, 1, 2, 3, 5])
    flags = similarities(x, i, j)
    for s, a, b in zip(flags, i, j, strict=True):
        t = x[a, :, REACH:-REACH, REACH:-REACH].astype(float)
        t -= t.mean((1, 2), keepdims=True)
        best = -1.0
        for dy in range(2 * REACH + 1):
            for dx in range(2 * REACH + 1):
                w = x[b, :, dy : dy + t.shape[1], dx : dx + t.shape[2]].astype(float)
                w = w - w.mean((1, 2), keepdims=True)
                best = max(best, float((t * w).sum() / np.sqrt((t**2).sum() * (w**2).sum())))
        assert best - 1e-3 <= s <= best + 0.12
    assert flags[0] == pytest.approx(1, abs=1e-3)
    grid = similarity_grid(x, i, np.arange(6))
    assert grid[np.arange(5), j] == pytest.approx(flags, abs=1e-5)


def test_similarity_survives_gain_offset_and_shift_and_tells_others_apart():
    big = fields(20)
    a, b = big[:, :, 2:34, 2:34], 1.3 * big[:, :, 4:36, 1:33] + 17
    plates = quantized(band_pass(np.concatenate([a, b])))
    n = np.arange(20)
    assert similarities(plates, n, n + 20).min() > 0.9
    assert similarities(plates, n, (n + 1) % 20 + 20).max() < 0.6


def test_background_leaves_contact_alone_and_takes_shifted_markers_off():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:36, :36]
    gel = np.stack([100 + x, 90 + y, 120 - x], 0).astype(np.float32)
    for cy in range(3, 36, 8):
        for cx in range(3, 36, 8):
            gel -= 60 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 3)
    contact = np.zeros_like(gel)
    contact[:, 12:20, 14:22] = rng.normal(0, 12, (3, 8, 8))
    touch = 1.05 * gel + contact
    for dy, dx in ((0, 0), (1, -1)):
        t, b = touch[None, :, 2:34, 2:34], gel[None, :, 2 + dy : 34 + dy, 2 + dx : 34 + dx]
        left = remove_background(t, b)[0]
        outside = np.ones((32, 32), bool)
        outside[8:20, 10:22] = False
        inner = np.s_[:, 4:28, 4:28]
        assert np.abs(left[inner])[:, outside[4:28, 4:28]].mean() < 1.0
        assert (
            np.corrcoef(left[:, 10:18, 12:20].ravel(), contact[:, 12:20, 14:22].ravel())[0, 1] > 0.9
        )


def gel_with_markers(size=136):
    """(size, size, 3): a gel of soft colors with 8 x 8 dots, about a thumbnail pixel wide."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:size, :size].astype(float)
    gel = np.stack([120 + 0.2 * x, 110 + 0.1 * y, 125 - 0.15 * x], -1)
    for cy in np.arange(7, size, 15.3):
        for cx in np.arange(5, size, 15.3):
            away = np.hypot(y - cy - rng.normal(0, 0.7), x - cx - rng.normal(0, 0.7))
            gel *= 1 - 0.9 * np.clip(rng.uniform(1.6, 2.6) + 0.5 - away, 0, 1)[..., None]
    return gel


def test_markers_do_not_hide_a_faint_print_in_a_shifted_copy():
    gel = gel_with_markers()
    y, x = np.mgrid[:136, :136]
    waves = np.stack([np.sin(x / 5 + y / 9), np.sin(y / 6 - x / 11), np.cos(x / 7)], -1)
    touch = gel + 8 * np.exp(-((y - 60) ** 2 + (x - 75) ** 2) / 900)[..., None] * waves
    small = lambda p: np.asarray(  # noqa: E731
        Image.fromarray(np.clip(p + 0.5, 0, 255).astype(np.uint8))
        .resize((SIDE, SIDE), Image.Resampling.BILINEAR)
        .convert("YCbCr")
    )
    background = np.moveaxis(small(crop(gel)), -1, 0)[None].astype(np.float32)
    moves = [(0, 0), (1, 2), (2, -3), (-4, 4), (4, 1), (-1, -2)]
    left = [
        remove_background(
            np.moveaxis(small(crop(touch, *m)), -1, 0)[None].astype(np.float32), background
        )[0]
        for m in moves
    ]
    plates = quantized(band_pass(np.stack(left)))
    assert similarities(plates, np.zeros(5, np.int64), np.arange(1, 6)).min() > 0.88


def test_candidates_find_what_comparing_all_finds(monkeypatch):
    big = fields(300, sigma=3)
    rng = np.random.default_rng(1)
    shift = rng.integers(0, 5, (300, 2))
    copies = np.stack(
        [big[k, :, a : a + 32, b : b + 32] for k, (a, b) in enumerate(shift)]
    ) + rng.normal(0, 3, (300, 3, 32, 32))
    comparer = ImageSimilarity(
        quantized(band_pass(np.concatenate([big[:, :, 2:34, 2:34], copies.astype(np.float32)])))
    )
    queries, base = np.arange(300, 600), np.arange(300)
    exact, s = best_matches(comparer, queries, base)
    monkeypatch.setattr("palpate.leakage.similarity.EXHAUSTIVE", 0)
    flags, t = best_matches(comparer, queries, base)
    assert (exact == base).mean() > 0.995
    assert (flags == exact).mean() > 0.995
    assert t[flags == exact] == pytest.approx(s[flags == exact], abs=1e-5)


def test_copies_across_videos_do_not_move_the_threshold():
    rng = np.random.default_rng(0)
    clean = rng.gumbel(0.3, 0.05, 3000).astype(np.float32)
    plain = calibration.other_videos(clean, 0.001)
    assert 0.0002 < (calibration.score(clean) >= plain.threshold).mean() + 0.0003 < 0.004
    mixed = np.concatenate([clean, rng.uniform(1.5, 3, 600).astype(np.float32)])
    assert calibration.other_videos(mixed, 0.001).threshold == pytest.approx(
        plain.threshold, abs=0.05
    )


def test_random_pairs_are_carried_over_to_the_whole_train_part():
    rng = np.random.default_rng(0)
    z = rng.gumbel(0.1, 0.09, (1500, 64)).astype(np.float32)
    flags = calibration.random_pairs(z, 5000, 0.001)
    exact = 0.1 + 0.09 * (np.log(5000) - np.log(-np.log1p(-0.001)))
    assert np.arctanh(flags.threshold) == pytest.approx(exact, rel=0.12)


@pytest.fixture(scope="module")
def leaky(tmp_path_factory):
    return make_leaky(
        tmp_path_factory.mktemp("leaky"),
        5,
        objects=3,
        materials=MATERIALS[:6],
        kinds=("near-duplicate",),
    )


@pytest.mark.parametrize("modality", ["vision", "tactile"])
@pytest.mark.parametrize("known", [True, False])
def test_planted_copies_are_found_and_others_are_not(leaky, modality, known):
    train, test = (
        (leaky.train, leaky.test) if known else (anonymous(leaky.train), anonymous(leaky.test))
    )
    flags = near_duplicates(train, test, modality)
    truth = leaky.truth("near-duplicate")
    missed = [leaky.change[i] for i, t in zip(test.ids, truth & ~flags.flag, strict=True) if t]
    # A print of half a gray level is no more than what JPEG 60 changes in it, so without videos
    # some copies stay below any safe threshold.
    assert len(missed) <= (0.25 if modality == "tactile" and not known else 0.1) * truth.sum()
    assert all("jpeg" in how for how in missed)
    assert flags.flag[~truth].mean() <= 0.03
    source = [
        leaky.planted["near-duplicate"][i]
        for i, t in zip(test.ids, truth & flags.flag, strict=True)
        if t
    ]
    assert [train.ids[k] for k in flags.nearest[truth & flags.flag]] == source
    assert set(flags.cause) <= {"", "content", "nothing touched", "sensor drift"}
    assert sum(flags.matches) == np.isfinite(flags.score).sum() == len(test)
    assert len(flags.edges) == len(flags.unrelated) + 1


def test_groups_join_copies_and_nothing_else(leaky):
    both = Manifest.join(leaky.train, leaky.test)
    label = dict(zip(both.ids, near_groups(both, "vision").tolist(), strict=True))
    pairs = leaky.planted["near-duplicate"].items()
    assert all(label[a] == label[b] >= 0 for a, b in pairs)
    allowed = {
        frozenset(i.split("/")[0] for i in pair) for pair in pairs
    }  # videos that a planted pair joins
    joined = {
        frozenset((a.split("/")[0], b.split("/")[0]))
        for a in label
        for b in label
        if label[a] == label[b] >= 0
    }
    assert (
        sum(len(pair) == 2 and pair not in allowed for pair in joined) <= 4
    )  # a video between two others joins them


def test_groups_join_faint_touches_that_the_slow_part_finds_too(tmp_path, monkeypatch):
    leaky = make_leaky(tmp_path, 12, objects=3, materials=MATERIALS[:6], kinds=("near-duplicate",))
    both = Manifest.join(leaky.train, leaky.test)
    label = dict(zip(both.ids, near_groups(both, "tactile").tolist(), strict=True))
    pairs = leaky.planted["near-duplicate"].items()
    assert all(label[a] == label[b] >= 0 for a, b in pairs)
    monkeypatch.setattr("palpate.leakage.near.AGREED", 1.0)
    alone = dict(zip(both.ids, near_groups(both, "tactile").tolist(), strict=True))
    assert not all(alone[a] == alone[b] >= 0 for a, b in pairs)
    allowed = {frozenset(i.split("/")[0] for i in pair) for pair in pairs}
    joined = {
        frozenset((a.split("/")[0], b.split("/")[0]))
        for a in label
        for b in label
        if label[a] == label[b] >= 0
    }
    assert sum(len(pair) == 2 and pair not in allowed for pair in joined) <= 2


def rows(root, name, images, background=None):
    out = []
    for k, image in enumerate(images):
        save(root / f"{name}{k}.jpg", image)
        out.append(
            {
                "id": f"{name}/{k}",
                "video": name,
                "frame": 10 * k,
                "vision": f"{name}{k}.jpg",
                "tactile": f"{name}{k}.jpg",
                "background": background,
            }
        )
    return out


def gels(root, count=6):
    """Videos of noise tactile images, each with backgrounds of its own, and their makers."""
    made, samples = [], []
    for v in range(count):
        video = NoiseVideo(np.random.default_rng([9, v]), 104)
        made.append(video)
        for t in range(8):
            save(root / f"v{v}b{t}.jpg", crop(video.background()))
            save(root / f"v{v}t{t}.jpg", crop(video.touch(t)))
            samples.append(
                {
                    "id": f"v{v}/{t}",
                    "video": f"v{v}",
                    "frame": 10 * t,
                    "tactile": f"v{v}t{t}.jpg",
                    "background": f"v{v}b{t}.jpg",
                }
            )
    return made, samples


def test_untouched_gel_is_named_and_is_no_leak(tmp_path):
    videos, samples = gels(tmp_path)
    for k in range(2):
        save(tmp_path / f"blank{k}.jpg", crop(videos[0].background()))
    blank = [
        {
            "id": f"blank{k}",
            "video": f"v{k}",
            "frame": 500,
            "tactile": f"blank{k}.jpg",
            "background": "v0b0.jpg",
        }
        for k in range(2)
    ]
    train = Manifest.from_rows([*samples[:24], blank[0]], tmp_path)
    test = Manifest.from_rows([*samples[24:], blank[1]], tmp_path)
    flags = near_duplicates(train, test, "tactile")
    assert flags.cause[-1] == "nothing touched"
    assert not flags.flag.any()
    assert flags.nearest[-1] == 24
    assert "blank-images" in [note.code for note in flags.notes]


def test_drift_of_the_gel_is_named_and_is_no_leak(tmp_path):
    videos, samples = gels(tmp_path)
    scar = np.zeros((104, 104, 1))
    scar[30:34, 20:80], scar[50:80, 60:64], scar[60:63, 15:50] = 45, -45, 45
    worn = [np.clip(videos[0].background() + scar, 0, 255).astype(np.uint8) for _ in range(3)]
    save(tmp_path / "worn.jpg", crop(worn[2]))
    later = []
    for k in range(2):
        save(tmp_path / f"scar{k}.jpg", crop(worn[k]))
        later.append(
            {
                "id": f"scar{k}",
                "video": "v0",
                "frame": 500 + k,
                "tactile": f"scar{k}.jpg",
                "background": "v0b0.jpg",
            }
        )
    other = {
        "id": "after",
        "video": "v0",
        "frame": 900,
        "tactile": "v0t7.jpg",
        "background": "worn.jpg",
    }
    flags = near_duplicates(
        Manifest.from_rows([*samples[:24], later[0], other], tmp_path),
        Manifest.from_rows([*samples[24:], later[1]], tmp_path),
        "tactile",
    )
    assert flags.cause[-1] == "sensor drift"
    assert not flags.flag.any()


def test_a_score_near_the_threshold_counts_where_the_slow_part_matches_the_same_image(monkeypatch):
    n = 4
    score = np.array([0.5, 0.5, 0.3, 0.5], np.float32)  # 0.8 of the threshold is 0.458, as z
    limit, items = calibration.Calibration(0.55), np.arange(n)
    none, content = np.full(n, "", "<U15"), np.array(["content"] * 3 + [""], "<U15")
    fine = Matches(score, items, np.full(n, 0.8, np.float32), none, limit, True)
    slow = replace(
        fine, score=np.full(n, 0.7, np.float32), place=np.array([0, 3, 2, 3]), cause=content
    )
    images = np.zeros((n, 3, SIDE, SIDE), np.int8)
    pool = SimpleNamespace(
        blank=np.zeros(n, bool), backgrounds=None, filtered=lambda **_: (images, None)
    )
    monkeypatch.setattr(Matcher, "match", lambda *_: slow)
    matcher, entries = Matcher(None, 0.001, None, quiet), Entries.of(items, items)
    named = near._name_drift(fine, pool, matcher, entries, entries)
    assert list(named.cause) == ["content", "sensor drift", "sensor drift", ""]
    assert named.score == pytest.approx([0.55, 0.7, 0.7, 0.5])
    assert list(named.place) == [0, 3, 2, 3]
    without = near._name_drift(replace(fine, by_videos=False), pool, matcher, entries, entries)
    assert list(without.cause) == ["sensor drift"] * 3 + [""]


def test_black_photos_show_nothing(tmp_path):
    black = rows(tmp_path, "black", [np.full((64, 64, 3), 3, np.uint8)] * 4)
    others = [
        rows(
            tmp_path,
            f"n{v}",
            [crop(NoiseVideo(np.random.default_rng([v, 1]), 72).photo(0)) for _ in range(4)],
        )
        for v in range(12)
    ]
    train = Manifest.from_rows(
        [*black[:2], *(row for rows_ in others[:6] for row in rows_)], tmp_path
    )
    test = Manifest.from_rows(
        [*black[2:], *(row for rows_ in others[6:] for row in rows_)], tmp_path
    )
    flags = near_duplicates(train, test, "vision")
    assert list(flags.cause[:2]) == ["nothing touched"] * 2
    assert not flags.flag.any()


def test_rubbish_files_and_modes_are_told_and_never_raised(tmp_path):
    image = crop(NoiseVideo(np.random.default_rng(3), 72).photo(0))
    image = Image.fromarray(image)
    image.save(tmp_path / "a.jpg", quality=95)
    for mode, name in (
        ("L", "gray.png"),
        ("RGBA", "alpha.png"),
        ("P", "palette.gif"),
        ("CMYK", "cmyk.jpg"),
        ("L", "gray.jpg"),
    ):
        image.convert(mode).save(tmp_path / name)
    Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 257).save(
        tmp_path / "deep.png"
    )
    image.resize((301, 97)).save(tmp_path / "wide.jpg")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:600])
    (tmp_path / "text.jpg").write_text("no image")
    names = sorted(p.name for p in tmp_path.iterdir())
    for name in ("gray.png", "alpha.png", "deep.png", "gray.jpg", "wide.jpg"):
        seen = thumbnail(tmp_path / name)
        assert isinstance(seen, np.ndarray)
        assert seen.shape == (32, 32, 3)
        assert np.abs(seen[..., 0].astype(float) - thumbnail(tmp_path / "a.jpg")[..., 0]).mean() < 6
    manifest = Manifest.from_rows(
        [*({"id": n, "vision": n} for n in [*names, "absent.jpg"]), {"id": "none"}], tmp_path
    )
    flags = near_duplicates(manifest, manifest, "vision")
    bad = [i in ("empty.jpg", "cut.jpg", "text.jpg", "absent.jpg", "none") for i in manifest.ids]
    assert np.array_equal(np.isnan(flags.score), bad)
    assert not flags.flag[bad].any()
    assert "images-unreadable" in [note.code for note in flags.notes]


def test_cache_and_processes_change_nothing(tmp_path, monkeypatch):
    paths = [tmp_path / f"{k}.jpg" for k in range(6)]
    for k, path in enumerate(paths):
        save(path, crop(NoiseVideo(np.random.default_rng(k % 5), 72).photo(0)))
    order: list[Path | None] = [paths[2], paths[0], None, paths[2], *paths]
    plain = thumbnails(order)
    assert list(plain.row) == [
        2,
        0,
        -1,
        2,
        0,
        1,
        2,
        3,
        4,
        0,
    ]  # the last file is the first one's image again
    assert len(plain.pixels) == 5
    monkeypatch.setattr("palpate.leakage.thumbnails.PIECE", 2)
    cached = thumbnails(order, cache=tmp_path / "cache", threads=2)
    again = thumbnails(order, cache=tmp_path / "cache")
    pieces = sorted((tmp_path / "cache").glob("*.npz"))
    assert len(pieces) == 3
    pieces[0].unlink()  # as after a stop: what is there is used, the rest decoded
    pieces[1].write_bytes(b"half")
    repaired = thumbnails(order, cache=tmp_path / "cache")
    for other in (cached, again, repaired):
        assert np.array_equal(other.row, plain.row)
        assert np.array_equal(other.pixels, plain.pixels)


def test_embeddings_and_their_mistakes(tmp_path):
    rng = np.random.default_rng(0)
    train, test = rng.standard_normal((200, 32)), rng.standard_normal((80, 32))
    test[:20] = train[:20] + 0.05 * rng.standard_normal((20, 32))
    parts = [
        Manifest.from_rows([{"id": f"{p}{k}", "video": f"{p}{k // 4}"} for k in range(n)], tmp_path)
        for p, n in (("a", 200), ("b", 80))
    ]
    flags = near_duplicates(parts[0], parts[1], "vision", features=(train, test))
    assert list(np.flatnonzero(flags.flag)) == list(range(20))
    assert list(flags.nearest[:20]) == list(range(20))
    for wrong in ((train[1:], test), (train, test[:, :3]), (np.full_like(train, np.nan), test)):
        with pytest.raises(PalpateError):
            near_duplicates(parts[0], parts[1], "vision", features=wrong)


def test_many_rows_of_one_image_and_tiny_sets_are_answered(tmp_path):
    save(tmp_path / "a.jpg", crop(NoiseVideo(np.random.default_rng(0), 72).photo(0)))
    table = pl.DataFrame({"id": [str(k) for k in range(20_000)]}).with_columns(
        vision=pl.lit("a.jpg"), video=pl.lit("v")
    )
    many = Manifest(
        Manifest.from_rows([], tmp_path)
        .table.clear(20_000)
        .with_columns(id=table["id"], vision=table["vision"], video=table["video"]),
        tmp_path,
    )
    flags = near_duplicates(many, many, "vision")
    assert flags.flag.all()
    assert "threshold-default" in [note.code for note in flags.notes]
    empty = Manifest(many.table.clear(), tmp_path)
    assert len(near_duplicates(many, empty, "vision").score) == 0
    assert np.isnan(
        near_duplicates(empty, Manifest(many.table.head(3), tmp_path), "vision").score
    ).all()


@pytest.mark.slow
def test_real_clips_without_metadata(real_data, tmp_path):
    from palpate.data.formats.touch_and_go import import_touch_and_go

    manifest = import_touch_and_go(real_data / "touch_and_go" / "clips", tmp_path).manifest
    odd = np.arange(len(manifest)) % 2 == 1
    hidden = anonymous(manifest)
    part = lambda keep: Manifest(hidden.table.filter(pl.Series(keep)), hidden.root)  # noqa: E731
    videos = np.array(manifest.column("video"))
    for modality, least in (("vision", 0.99), ("tactile", 0.9)):
        flags = near_duplicates(part(~odd), part(odd), modality)
        assert flags.flag.mean() >= least
        same = videos[~odd][flags.nearest[flags.flag]] == videos[odd][flags.flag]
        assert same.all()
        for clip in np.unique(videos):
            assert not near_duplicates(
                part(videos != clip), part(videos == clip), modality
            ).flag.any()


def uploads(
    folder: Path, seeds: range, name: str, count: int, *, copied: bool = False
) -> list[dict[str, str]]:
    """``count`` images of each video, copies brighter and saved again at quality 60."""
    rows: list[dict[str, str]] = []
    for seed in seeds:
        video = NoiseVideo(np.random.default_rng(seed), 72)
        for k in range(count):
            path = folder / f"{name}{seed}-{k}.{'jpg' if copied else 'png'}"
            image = crop(video.photo(40 * k))
            if copied:
                Image.fromarray(np.clip(image * 1.05, 0, 255).astype(np.uint8)).save(
                    path, quality=60
                )
            else:
                save(path, image)
            rows.append({"id": path.stem, "video": f"{name}{seed}", "vision": path.name})
    return rows


@pytest.mark.parametrize(
    "case", ["eleven videos", "one video", "train twice", "most of train twice"]
)
def test_copies_are_found_however_many_they_are(tmp_path, case):
    if case == "eleven videos":  # fewer than a hundred train images, and all of test copies
        train, test = (
            uploads(tmp_path, range(11), "a", 4),
            uploads(tmp_path, range(11), "b", 4, copied=True),
        )
    elif case == "one video":
        train, test = (
            uploads(tmp_path, range(1), "a", 20),
            uploads(tmp_path, range(1), "b", 20, copied=True),
        )
    elif case == "train twice":  # what test copies stands in train under two names
        train = uploads(tmp_path, range(8), "a", 5) + uploads(
            tmp_path, range(3), "c", 5, copied=True
        )
        test = uploads(tmp_path, range(3), "b", 5, copied=True)
    else:
        train = uploads(tmp_path, range(12), "a", 4) + uploads(
            tmp_path, range(4, 12), "c", 4, copied=True
        )
        test = uploads(tmp_path, range(4), "b", 4, copied=True)
    flags = near_duplicates(
        Manifest.from_rows(train, tmp_path), Manifest.from_rows(test, tmp_path), "vision"
    )
    assert flags.flag.mean() >= 0.95, flags.notes


def test_equal_pictures_score_one_however_many_there_are(tmp_path):
    save(tmp_path / "still.png", crop(NoiseVideo(np.random.default_rng(0), 72).photo(0)))
    rows = [
        {"id": f"{v}/{k}", "video": f"v{v}", "vision": "still.png"}
        for v in range(40)
        for k in range(500)
    ]
    whole = Manifest.from_rows(rows, tmp_path)
    train, test = (Manifest(whole.table[a:b], tmp_path) for a, b in ((0, 16_000), (16_000, 20_000)))
    flags = near_duplicates(train, test, "vision")
    assert flags.flag.all()
    assert set(flags.score.tolist()) == {1.0}


def test_a_changed_file_is_decoded_again_and_cameras_may_be_held_upright(tmp_path):
    path = tmp_path / "a.jpg"
    save(path, crop(NoiseVideo(np.random.default_rng(0), 72).photo(0)))
    before = thumbnails([path], cache=tmp_path / "cache").pixels.copy()
    save(path, crop(NoiseVideo(np.random.default_rng(1), 72).photo(0)))
    assert (
        np.abs(thumbnails([path], cache=tmp_path / "cache").pixels.astype(int) - before).mean() > 5
    )
    image = Image.open(path).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: shown rotated by a quarter, clockwise
    image.save(tmp_path / "turned.png", exif=exif)
    image.transpose(Image.Transpose.ROTATE_270).save(tmp_path / "upright.png")
    turned, upright = thumbnail(tmp_path / "turned.png"), thumbnail(tmp_path / "upright.png")
    assert np.array_equal(turned, upright)
    assert not np.array_equal(turned, thumbnail(path))
