"""Memorization: planted copies are reported, real images of other videos are not."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge import commands
from forge.errors import fails
from palpate.core import FeatureSet
from palpate.evaluation.memorization import contact_rows, memorization, nearest_train
from palpate.metrics.intervals import jackknife_error

RNG = np.random.default_rng(0)


def rows(videos, frames=4, prefix="v", width=6):
    """Frames around the center of each video."""
    centers = np.repeat(RNG.normal(size=(videos, width)), frames, 0)
    x = centers + 0.2 * RNG.normal(size=centers.shape)
    groups = [f"{prefix}{k // frames}" for k in range(len(x))]
    ids = [f"{g}/{k}" for k, g in enumerate(groups)]
    return FeatureSet(ids, x.astype(np.float32), None, groups)


TRAIN, TEST, OTHER = rows(60, prefix="train"), rows(60, prefix="test"), rows(60, prefix="other")


def planted(share):
    """Test rows of which a share of the videos is replaced by train rows, with a little noise."""
    x, count = OTHER.features.copy(), int(share * len(OTHER.ids))
    x[:count] = TRAIN.features[:count] + 0.01 * RNG.normal(size=(count, x.shape[1]))
    return FeatureSet(TEST.ids, x, None, TEST.groups)


def test_distances_are_those_of_a_loop():
    distance, at = nearest_train(TEST.features, TRAIN.features)
    for k, row in enumerate(TEST.features):
        each = [float(np.linalg.norm(row - other)) for other in TRAIN.features]
        assert distance[k] == pytest.approx(min(each), abs=1e-6)
        assert at[k] == int(np.argmin(each))


def test_half_of_them_copied_is_reported_and_other_videos_are_not():
    share, area = memorization(planted(0.5), TEST, TRAIN)
    assert share.value > 0.45
    assert share.interval[0] > share.floor == 0.05
    assert area.interval[0] > area.floor == 0.5
    pair = share.details["nearest"][0]
    assert pair["train"].startswith("train")
    assert pair["distance"] < share.details["quantile distance"]
    share, area = memorization(planted(0.0), TEST, TRAIN)
    assert share.interval[0] <= 0.05 <= share.interval[1] or share.value <= 0.1
    assert area.interval[0] <= 0.5 <= area.interval[1]
    noise = FeatureSet(TEST.ids, 9 + OTHER.features, None, TEST.groups)
    share, area = memorization(noise, TEST, TRAIN)
    assert (share.value, area.value) == (0, 0)


def test_real_images_score_their_floors_and_the_area_is_that_of_all_pairs():
    share, area = memorization(TEST, TEST, TRAIN)
    assert share.value == pytest.approx(share.floor, abs=1 / len(TEST.ids))
    assert area.value == 0.5
    made = planted(0.3)
    d, r = (
        nearest_train(made.features, TRAIN.features)[0],
        nearest_train(TEST.features, TRAIN.features)[0],
    )

    def statistic(d, r):
        return float(((d[:, None] < r) + 0.5 * (d[:, None] == r)).mean())

    area = memorization(made, TEST, TRAIN)[1]
    assert area.value == pytest.approx(statistic(d, r))
    groups = np.array(TEST.groups)
    without = [statistic(d[groups != g], r[groups != g]) for g in sorted(set(TEST.groups))]
    error = jackknife_error(np.array(without))
    assert area.interval[1] - area.value == pytest.approx(2.001 * error, rel=1e-3)  # 59 df


def test_pixels_lose_their_gel_and_are_averaged():
    gel = RNG.integers(60, 120, (64, 64, 3), dtype=np.uint8)
    touch = np.zeros((2, 64, 64, 3), int)
    touch[0, :32], touch[1, 32:] = 20, 40
    images = np.clip(gel + touch, 0, 255).astype(np.uint8)
    x = contact_rows(images, gel)
    small = (touch / 255).reshape(2, 32, 2, 32, 2, 3).mean(axis=(2, 4))
    want = np.sqrt(((small[0] - small[1]) ** 2).mean())
    assert np.linalg.norm(x[0] - x[1]) == pytest.approx(want, rel=1e-5)
    assert np.abs(contact_rows(gel[None], gel)).max() == 0
    # Another gel of the same touch is the same row.
    other = np.clip(gel.astype(int) + 30, 0, 255).astype(np.uint8)
    moved = contact_rows(np.clip(other + touch, 0, 255).astype(np.uint8), other[None].repeat(2, 0))
    assert np.allclose(moved, x, atol=1e-6)


def test_mistakes_are_named():
    fails("train images", memorization, TEST, TEST, FeatureSet([], np.zeros((0, 6), np.float32)))
    fails("one width", memorization, TEST, TEST, FeatureSet(["a"], np.zeros((1, 3), np.float32)))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Folders train, real and copies (half of them train images), of videos of the world."""
    from palpate.sim import World, WorldOptions

    top = tmp_path_factory.mktemp("world")
    world = World(WorldOptions(seed=3, size=32, materials=4, tile=64, mixed=0.0))
    names = {}
    for k in range(len(world)):
        sample = world[k]
        part = "train" if int(sample["video"][-2:]) % 2 else "real"
        path = top / part / sample["video"] / f"{sample['frame']:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(sample["tactile"]).save(path)
        names.setdefault(part, []).append(path)
    train, real = (sorted(names[part]) for part in ("train", "real"))
    far = RNG.permutation(len(real))
    for k, path in enumerate(real):
        video_even = int(path.parent.name[-2:]) // 2 % 2 == 0
        for folder, source in (
            ("copies", train[k % len(train)] if video_even else real[far[k]]),
            ("others", real[far[k]]),
        ):
            target = top / folder / path.relative_to(top / "real")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    return top


def call(capsys, *args):
    return commands.call(capsys, "score", *args, "--companions", "none", "--permutations", "0")


def test_the_command_reports_planted_copies(capsys, world):
    args = ("--generated", world / "copies", world / "others", "--reference", world / "real")
    args = (*args, "--train", world / "train", "--encoder", "palpate/mini", "--allow-seen")
    status, out, err = call(capsys, *args, "--json")
    assert status == 0, err
    data = json.loads(out)
    assert len(data["settings"]["digests"]["train"]) == 64
    scores = {(s["metric"], s["features"], s["a"]): s for s in data["scores"]}
    for space in ("contact pixels", "tactile features"):
        copied = scores["memorized share", space, "copies"]
        assert 0.4 < copied["value"] < 0.65, space
        assert scores["memorized share", space, "others"]["value"] <= 0.1, space
        assert scores["nearness to train", space, "copies"]["value"] > 0.7, space
        assert scores["nearness to train", space, "others"]["value"] == pytest.approx(0.5), space
    assert "TMMD" in {metric for metric, *_ in scores}
    pair = copied["details"]["nearest"][0]
    # Not 0: the copy is read against the gel of the sample that it stands for.
    assert pair["distance"] < 0.2
    assert (Path(world) / "train" / f"{pair['train']}.png").is_file()


def test_embeddings_take_embeddings_of_train(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    unit = {"train": TRAIN, "real": TEST, "made": planted(0.5)}
    for name, x in unit.items():
        rows_ = x.features / np.linalg.norm(x.features, axis=1, keepdims=True)
        FeatureSet(x.ids, rows_.astype(np.float32), None, x.groups, "e" * 64).save(
            Path(f"{name}.npz")
        )
    args = ("--generated", "made.npz", "--reference", "real.npz", "--train", "train.npz", "--json")
    status, out, err = call(capsys, *args)
    assert status == 0, err
    shares = {
        s["features"]: s["value"]
        for s in json.loads(out)["scores"]
        if s["metric"] == "memorized share"
    }
    assert shares["tactile features"] > 0.4
    assert "contact pixels" not in shares
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.png").rename(tmp_path / "folder" / "a.png")
    status, _, err = call(capsys, *args[:4], "--train", "folder")
    assert status == 2
    assert "folder (images)" in err
