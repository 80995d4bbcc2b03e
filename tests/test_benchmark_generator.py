"""The benchmark of the shipped generator: it compares like with like, and refuses otherwise."""

import io
import sys
from types import SimpleNamespace

import generator
import numpy as np
import pytest
from PIL import Image
from texture import TextureJudge, masked

from palpate.sim import World, WorldOptions


def rows(strength, area, motion, n=50):
    """Measured contacts around three means."""
    rng = np.random.default_rng(0)
    return np.array([strength, area, motion, 0.3]) * rng.uniform(0.8, 1.2, (n, 4))


def test_worlds_that_differ_by_more_than_a_tenth_are_refused():
    same = {"training": rows(20, 0.4, 0.5), "judging": rows(21, 0.42, 0.48)}
    assert generator.unmatched(same) == []
    for k, measure in enumerate(generator.MEASURES[:3]):
        other = same["judging"].copy()
        other[:, k] *= 1.2
        assert [text.split()[0] for text in generator.unmatched({**same, "judging": other})] == [
            measure.split()[0]
        ]
    without = {name: of.copy() for name, of in same.items()}
    without["judging"][:, 2] = np.nan  # a gel without markers
    assert generator.unmatched(without) == []


def test_worlds_of_one_frame_and_of_two_are_refused_with_spaced_phases_and_match_with_drawn_ones():
    found = {}
    for phases in ("spaced", "drawn"):
        of = {}
        for frames in (1, 2):
            shape = {"contacts_per_video": 10, "objects_per_material": 1, "materials": 3}
            options = WorldOptions(
                seed=31, size=48, frames_per_contact=frames, phases=phases, mixed=0.0, **shape
            )
            world = World(options, cache=2)
            videos = [(world.video(row.video), row) for row in world.rows]
            images = np.stack([video.tactile(row.frame) for video, row in videos])
            gels = np.stack([video.background_of(row.contact) for video, row in videos])
            of[f"{frames} frames"] = np.array(generator.contacts(images, gels), float)
        found[phases] = generator.unmatched(of)
    assert any(text.startswith("strength") for text in found["spaced"])
    assert not any(text.startswith("strength") for text in found["drawn"])


def test_images_are_stored_as_the_real_ones_are(tmp_path):
    images = np.random.default_rng(1).integers(0, 256, (2, 32, 32, 3), dtype=np.uint8)
    files = [tmp_path / "real.jpg", tmp_path / "real.png"]
    Image.new("RGB", (32, 32)).save(files[0], "JPEG", quality=90, subsampling=0)
    Image.new("RGB", (32, 32)).save(files[1])
    Image.fromarray(images[0]).save(file := io.BytesIO(), "JPEG", quality=90, subsampling=0)
    expected = np.stack([np.asarray(Image.open(file)), images[1]])
    np.testing.assert_array_equal(generator.stored(images, files), expected)


def stripes(rng, n, periods):
    """Gels with stripes of some periods in any direction, (n, 64, 64, 3) and labels."""
    y, x = np.mgrid[:64, :64]
    labels = rng.integers(len(periods), size=n)
    angles = rng.uniform(0, np.pi, n)
    waves = [
        np.sin(2 * np.pi / periods[k] * (x * np.cos(a) + y * np.sin(a)))
        for k, a in zip(labels, angles, strict=True)
    ]
    noise = rng.normal(0, 1, (n, 64, 64))
    gray = 120 + 3 * np.stack(waves) + noise
    return np.rint(gray)[..., None].repeat(3, 3).astype(np.uint8), labels


def test_the_texture_judge_names_grain_and_noise_masks_what_is_faint():
    rng = np.random.default_rng(2)
    images, labels = stripes(rng, 90, (3, 5, 9))
    others, answers = stripes(rng, 60, (3, 5, 9))
    gel = np.full((1, 64, 64, 3), 120, np.uint8)
    judge = TextureJudge(images, gel.repeat(90, 0), labels)
    assert (judge.names(others, gel.repeat(60, 0)) == answers).mean() > 0.95
    under = masked(others, 3)
    assert (under.astype(int) - others).std() == pytest.approx(4, abs=0.2)
    swapped = judge.names(under, gel.repeat(60, 0))
    assert (swapped == answers).mean() < 0.8


def trial(seed, hits):
    """A judged world, as the tables read it."""
    record, n = {}, len(hits[generator.REAL])
    for name, cnn in hits.items():
        record[name] = {
            **dict.fromkeys(("cnn", "texture", "texture masked"), cnn),
            "tmmd": [0.1, 0.05, 0.15],
            "recall": 0.5,
            "coverage": 0.5,
            "contacts": [[20.0, 0.4, 0.5, 0.3]] * n,
            "markers": 0.25,
        }
    record["from by photo"] = [0] * n
    record |= {f"contacts of {w}": [[20.0, 0.4, 0.5, 0.3]] for w in ("judging", "learning")}
    part = range(100)
    return SimpleNamespace(
        record=record,
        videos=[f"{seed} {k}" for k in range(n)],
        look="gelsight",
        third=SimpleNamespace(part=part),
        work=SimpleNamespace(name=f"world {seed}"),
    )


def test_tables_pool_worlds_and_pair_images():
    names = generator.REAL, generator.NEAREST, generator.BY_PHOTO
    first = trial(1, dict(zip(names, ([1, 1, 1, 0], [1, 0, 1, 0], [1, 1, 0, 0]), strict=True)))
    second = trial(2, dict(zip(names, ([1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]), strict=True)))
    text = generator.section("4 materials", [first, second], names)
    cells = {line.split(" | ")[0].strip("| "): line.split(" | ") for line in text.splitlines()}
    by_photo = next(r for r in text.splitlines() if r.startswith("| by photo")).split(" | ")
    assert by_photo[1].startswith("62.5 ±")
    assert by_photo[2] == "0.71"
    assert by_photo[3].startswith("-25.0 ±")
    assert by_photo[4].startswith("-12.5 ±")
    assert by_photo[8].startswith("-87.5 ±")  # learned from it, against real
    assert "Videos: 8; worlds to judge on: 2" in text
    assert generator.REAL in cells


def test_a_seed_of_the_shipped_models_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["generator.py", "--seeds", "450001"])
    with pytest.raises(SystemExit):
        generator.main()
    assert "--seeds 450001" in capsys.readouterr().err
