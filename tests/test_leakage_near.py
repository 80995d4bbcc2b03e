"""Near-duplicates: the similarity against a slow one, calibration, causes, groups, bad files."""

from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image
from threadpoolctl import threadpool_limits

from forge.leaks import MATERIALS, NoiseVideo, crop, make_leaky, save
from palpate.data.images import check_image
from palpate.data.manifest import Manifest
from palpate.leakage.calibration import Tail, beyond_chance
from palpate.leakage.descriptors import OFFSET, EditIndex, Whitened
from palpate.leakage.near import near_duplicates, near_groups
from palpate.leakage.thumbnails import thumbnail, thumbnails

DROPPED = ("video", "contact", "object", "session", "material", "sensor", "domain")


def anonymous(manifest):
    nulls = {c: pl.lit(None, pl.String) for c in DROPPED}
    return Manifest(
        manifest.table.with_columns(frame=pl.lit(None, pl.Int64), **nulls), manifest.root
    )


def photo(*seed, side=72):
    """A photo of smooth noise, 8 pixels smaller than ``side``."""
    return crop(NoiseVideo(np.random.default_rng(seed), side).photo(0))


@pytest.fixture(scope="module")
def leaky(tmp_path_factory):
    folder = tmp_path_factory.mktemp("leaky")
    return make_leaky(folder, 5, materials=MATERIALS[:6], kinds=("near-duplicate",))


@pytest.mark.parametrize("modality", ["vision", "tactile"])
@pytest.mark.parametrize("known", [True, False])
def test_planted_copies_are_found_and_others_are_not(leaky, modality, known):
    parts = leaky.train, leaky.test
    train, test = parts if known else map(anonymous, parts)
    flags = near_duplicates(train, test, modality, false_positives=0.01)
    truth = leaky.truth("near-duplicate")
    found, copies = truth & flags.flag, np.flatnonzero(truth)
    assert flags.flag[~truth].mean() <= 0.03
    # In 45 videos little is learned of the gel: faint copies stay below a safe threshold.
    assert found.sum() >= (0.4 if modality == "tactile" else 0.9) * truth.sum()
    order = np.argsort(-flags.score)
    assert truth[order[: round(0.5 * truth.sum())]].all()
    still = [k for k in copies if flags.flag[k] or "shift" not in leaky.change[test.ids[k]]]
    sources = [leaky.planted["near-duplicate"][test.ids[k]] for k in still]
    assert [train.ids[k] for k in flags.nearest[still]] == sources
    assert flags.verdict == "leaks"
    assert flags.expected == pytest.approx(0.01 * len(test), abs=0.01)
    assert set(flags.cause) <= {"", "content", "nothing touched"}
    assert sum(flags.matches) == np.isfinite(flags.score).sum() == len(test)
    assert len(flags.edges) == len(flags.unrelated) + 1


def test_scores_do_not_depend_on_the_number_of_threads(leaky):
    def scores(threads):
        with threadpool_limits(threads, user_api="blas"):
            return near_duplicates(leaky.train, leaky.test, "vision").score

    assert np.array_equal(scores(1), scores(2))


def test_groups_join_copies_and_nothing_else(leaky):
    both = Manifest.join(leaky.train, leaky.test)
    label = dict(zip(both.ids, near_groups(both, "vision").tolist(), strict=True))
    pairs = leaky.planted["near-duplicate"].items()
    assert all(label[a] == label[b] >= 0 for a, b in pairs)
    video = lambda i: i.split("/")[0]
    allowed = {frozenset(map(video, pair)) for pair in pairs}  # that a planted pair joins
    joined = {
        frozenset((video(a), video(b))) for a in label for b in label if label[a] == label[b] >= 0
    }
    # A video between two others joins them.
    assert sum(len(pair) == 2 and pair not in allowed for pair in joined) <= 4


def rows(root, name, images):
    out = []
    for k, image in enumerate(images):
        save(root / f"{name}{k}.jpg", image)
        out.append(
            {"id": f"{name}/{k}", "video": name, "frame": 10 * k, "vision": f"{name}{k}.jpg"}
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
            files = {"tactile": f"v{v}t{t}.jpg", "background": f"v{v}b{t}.jpg"}
            samples.append({"id": f"v{v}/{t}", "video": f"v{v}", "frame": 10 * t, **files})
    return made, samples


def test_untouched_gel_is_named_and_is_no_leak(tmp_path):
    videos, samples = gels(tmp_path)
    blank = []
    for k in range(2):
        save(tmp_path / f"blank{k}.jpg", crop(videos[0].background()))
        files = {"tactile": f"blank{k}.jpg", "background": "v0b0.jpg"}
        blank.append({"id": f"blank{k}", "video": f"v{k}", "frame": 500, **files})
    train = Manifest.from_rows([*samples[:24], blank[0]], tmp_path)
    test = Manifest.from_rows([*samples[24:], blank[1]], tmp_path)
    flags = near_duplicates(train, test, "tactile")
    assert flags.cause[-1] == "nothing touched"
    assert not flags.flag.any()
    assert flags.nearest[-1] == -1
    assert np.isnan(flags.score[-1])
    assert "blank-images" in [note.code for note in flags.notes]


def test_black_photos_show_nothing(tmp_path):
    black = rows(tmp_path, "black", [np.full((64, 64, 3), 3, np.uint8)] * 4)
    parts = [black[:2], black[2:]]
    for v in range(12):
        parts[v // 6] += rows(tmp_path, f"n{v}", [photo(v, 1) for _ in range(4)])
    train, test = (Manifest.from_rows(part, tmp_path) for part in parts)
    flags = near_duplicates(train, test, "vision")
    assert list(flags.cause[:2]) == ["nothing touched"] * 2
    assert not flags.flag.any()


def test_rubbish_files_and_modes_are_told_and_never_raised(tmp_path):
    image = Image.fromarray(photo(3))
    image.save(tmp_path / "a.jpg", quality=95)
    modes = {"gray.png": "L", "alpha.png": "RGBA", "palette.gif": "P", "cmyk.jpg": "CMYK"}
    for name, mode in {**modes, "gray.jpg": "L"}.items():
        image.convert(mode).save(tmp_path / name)
    deep = np.asarray(image.convert("L")).astype(np.uint16) * 257
    Image.fromarray(deep).save(tmp_path / "deep.png")
    image.resize((301, 97)).save(tmp_path / "wide.jpg")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:600])
    (tmp_path / "text.jpg").write_text("no image")
    names = sorted(p.name for p in tmp_path.iterdir())
    for name in ("gray.png", "alpha.png", "deep.png", "gray.jpg", "wide.jpg"):
        seen = thumbnail(tmp_path / name)
        assert isinstance(seen, np.ndarray)
        assert seen.shape == (32, 32, 3)
        luma = [x @ [0.299, 0.587, 0.114] for x in (seen, thumbnail(tmp_path / "a.jpg"))]
        assert np.abs(luma[0] - luma[1]).mean() < 6
    cells = [*({"id": n, "vision": n} for n in [*names, "absent.jpg"]), {"id": "none"}]
    manifest = Manifest.from_rows(cells, tmp_path)
    flags = near_duplicates(manifest, manifest, "vision")
    bad = [i in ("empty.jpg", "cut.jpg", "text.jpg", "absent.jpg", "none") for i in manifest.ids]
    assert np.array_equal(np.isnan(flags.score), bad)
    assert not flags.flag[bad].any()
    assert "images-unreadable" in [note.code for note in flags.notes]


def test_why_an_image_cannot_be_read(tmp_path):
    path = tmp_path / "cut.jpg"
    Image.fromarray(photo(3)).save(path)
    path.write_bytes(path.read_bytes()[:600])
    assert thumbnail(path) == check_image(path).problem


def test_equal_images_of_a_null_are_finite():
    """Cosines of 1 are far out in the tail, not infinitely far."""
    tail = Tail.of(np.append(np.linspace(0.1, 0.8, 40), [1.0, 1.0]), np.arange(42), 1.0)
    assert np.isfinite([tail.scale, tail.surprise(1.0), tail.surprise_at(0.01)]).all()
    assert tail.surprise(1.0) > tail.surprise(0.9)


def test_cache_and_processes_change_nothing(tmp_path, monkeypatch):
    paths = [tmp_path / f"{k}.jpg" for k in range(6)]
    for k, path in enumerate(paths):
        save(path, photo(k % 5))
    order: list[Path | None] = [paths[2], paths[0], None, paths[2], *paths]
    plain = thumbnails(order)
    # The last file is the first one's image again.
    assert list(plain.row) == [2, 0, -1, 2, 0, 1, 2, 3, 4, 0]
    assert len(plain.pixels) == 5
    monkeypatch.setattr("palpate.leakage.thumbnails.PIECE", 2)
    cached = thumbnails(order, cache=tmp_path / "cache")
    again = thumbnails(order, cache=tmp_path / "cache")
    pieces = sorted((tmp_path / "cache").glob("*.npz"))
    assert len(pieces) == 3
    pieces[0].unlink()  # as after a stop: what is there is used, the rest decoded
    pieces[1].write_bytes(b"half")
    repaired = thumbnails(order, cache=tmp_path / "cache")
    for other in (cached, again, repaired):
        assert np.array_equal(other.row, plain.row)
        assert np.array_equal(other.pixels, plain.pixels)


def test_many_rows_of_one_image_and_tiny_sets_are_answered(tmp_path):
    save(tmp_path / "a.jpg", photo(0))
    cells = [{"id": str(k), "vision": "a.jpg", "video": "v"} for k in range(20_000)]
    many = Manifest.from_rows(cells, tmp_path)
    flags = near_duplicates(many, many, "vision")
    assert flags.flag.all()
    assert flags.verdict == "leaks"
    assert "cannot-tell-no-null" in [note.code for note in flags.notes]
    empty = Manifest(many.table.clear(), tmp_path)
    assert len(near_duplicates(many, empty, "vision").score) == 0
    few = Manifest(many.table.head(3), tmp_path)
    assert np.isnan(near_duplicates(empty, few, "vision").score).all()


@pytest.mark.nightly
def test_real_clips_without_metadata(real_data, tmp_path):
    from palpate.data.importing import import_dataset

    clips = real_data / "touch_and_go" / "clips"
    manifest = import_dataset(clips, tmp_path, format="touch-and-go").manifest
    odd = np.arange(len(manifest)) % 2 == 1
    hidden = anonymous(manifest)
    part = lambda keep: Manifest(hidden.table.filter(pl.Series(keep)), hidden.root)
    videos = np.array(manifest.column("video"))
    for modality, least in (("vision", 0.97), ("tactile", 0.9)):
        flags = near_duplicates(part(~odd), part(odd), modality)
        assert flags.flag.mean() >= least
        same = videos[~odd][flags.nearest[flags.flag]] == videos[odd][flags.flag]
        assert same.all()
        for clip in np.unique(videos):
            parts = part(videos != clip), part(videos == clip)
            assert not near_duplicates(*parts, modality).flag.any()


def uploads(folder, seeds, name, count, *, copied=False):
    """``count`` images of each video, copies brighter and saved again at quality 60."""
    rows = []
    for seed in seeds:
        video = NoiseVideo(np.random.default_rng(seed), 72)
        for k in range(count):
            path = folder / f"{name}{seed}-{k}.{'jpg' if copied else 'png'}"
            image = crop(video.photo(40 * k))
            if copied:
                brighter = np.clip(image * 1.05, 0, 255).astype(np.uint8)
                Image.fromarray(brighter).save(path, quality=60)
            else:
                save(path, image)
            rows.append({"id": path.stem, "video": f"{name}{seed}", "vision": path.name})
    return rows


#: Images a video, videos of train, and those that train and that test copies.
COPIES = {
    "eleven videos": (4, range(11), (), range(11)),  # fewer than a hundred images, all copied
    "one video": (20, range(1), (), range(1)),
    "train twice": (5, range(8), range(3), range(3)),  # what test copies has two names in train
    "most of train twice": (4, range(12), range(4, 12), range(4)),
}


@pytest.mark.parametrize("case", COPIES)
def test_copies_are_found_however_many_they_are(tmp_path, case):
    count, videos, again, copies = COPIES[case]
    train = uploads(tmp_path, videos, "a", count)
    train += uploads(tmp_path, again, "c", count, copied=True)
    test = uploads(tmp_path, copies, "b", count, copied=True)
    parts = (Manifest.from_rows(part, tmp_path) for part in (train, test))
    flags = near_duplicates(*parts, "vision")
    if case in ("one video", "most of train twice"):  # what is chance cannot be known
        assert flags.verdict == "cannot tell"
        assert flags.expected is None
    else:
        assert flags.flag.mean() >= 0.75, flags.notes
        assert flags.verdict == "leaks"
    copied = [train[k]["id"][1:] for k in flags.nearest]
    assert np.mean([a == row["id"][1:] for a, row in zip(copied, test, strict=True)]) >= 0.95


def test_equal_pictures_score_one_however_many_there_are(tmp_path):
    save(tmp_path / "still.png", photo(0))
    names = product(range(40), range(500))
    cells = [{"id": f"{v}/{k}", "video": f"v{v}", "vision": "still.png"} for v, k in names]
    whole = Manifest.from_rows(cells, tmp_path)
    train, test = (Manifest(whole.table[a:b], tmp_path) for a, b in ((0, 16_000), (16_000, 20_000)))
    flags = near_duplicates(train, test, "vision")
    assert flags.flag.all()
    assert set(flags.score.tolist()) == {1.0}


def test_a_changed_file_is_decoded_again_and_cameras_may_be_held_upright(tmp_path):
    path = tmp_path / "a.jpg"
    save(path, photo(0))
    before = thumbnails([path], cache=tmp_path / "cache").pixels.copy()
    save(path, photo(1))
    after = thumbnails([path], cache=tmp_path / "cache").pixels
    assert np.abs(after.astype(int) - before).mean() > 5
    image = Image.open(path).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: shown rotated by a quarter, clockwise
    image.save(tmp_path / "turned.png", exif=exif)
    image.transpose(Image.Transpose.ROTATE_270).save(tmp_path / "upright.png")
    turned, upright = thumbnail(tmp_path / "turned.png"), thumbnail(tmp_path / "upright.png")
    assert np.array_equal(turned, upright)
    assert not np.array_equal(turned, thumbnail(path))


def test_many_frames_of_few_videos_are_more_than_chance():
    """Frames of a video are flagged in lumps: a look-alike is chance, whole videos are not."""
    flags = np.zeros(3000, bool)
    videos = np.arange(3000) // 1500
    flags[:180] = flags[1500:1690] = True
    assert beyond_chance([(flags, 0.001)], videos, 3000)
    one = np.zeros(1200, bool)
    one[:100] = one[300:304] = True
    assert not beyond_chance([(one, 0.01)], np.arange(1200) // 100, 1200)
    assert not beyond_chance([(np.zeros(9, bool), 0.01)], np.arange(9), 9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_groups_of_images_that_show_nothing(tmp_path, count):
    rows = [{"id": str(k), "vision": f"{k}.png"} for k in range(count)]
    for row in rows:
        Image.new("RGB", (40, 40), "gray").save(tmp_path / row["vision"])
    assert (near_groups(Manifest.from_rows(rows, tmp_path), "vision") == -1).all()


@pytest.mark.parametrize("gray", [False, True])
def test_no_edit_is_more_than_equal(gray):
    """Of images without length, whose least length is 0, too; implausible edits lose."""
    pixels = np.random.default_rng(0).integers(0, 256, (80, 32, 32, 3), dtype=np.uint8)
    pixels[40:] = np.where(np.arange(40) % 2, 255, 0)[:, None, None, None]
    rows = np.arange(len(pixels))
    descriptors = Whitened(pixels, rows, None, gray=gray, fit=rows)
    near, cosines = EditIndex(descriptors, rows[:60]).closest(rows, 3)
    assert np.abs(cosines[near >= 0]).max() <= 1 + 1e-5


def test_gray_descriptors_see_the_luminance_of_an_image():
    pixels = np.random.default_rng(0).integers(0, 256, (80, 32, 32, 3), dtype=np.uint8)
    rows = np.arange(len(pixels))
    logs = Whitened(pixels, rows, None, gray=True, fit=rows)._log(rows)
    luminance = np.stack([np.asarray(Image.fromarray(image).convert("L")) for image in pixels])
    apart = np.exp(logs.reshape(luminance.shape)) - luminance - OFFSET
    assert np.abs(apart).max() < 0.51  # rounding to bytes
