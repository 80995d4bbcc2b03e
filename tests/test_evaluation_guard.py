"""The guard: an encoder does not judge images that it was trained on."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file

from forge.errors import fails
from forge.models import make_encoders
from forge.worlds import by_video, six_videos
from palpate import audit, probe, score
from palpate.data.manifest import Manifest
from palpate.encoders import Encoder, EncoderSet, train_encoder
from palpate.encoders.guard import guard
from palpate.encoders.models import digest_images, union
from palpate.report.notes import COMMAND_LINE, sentence
from palpate.report.terminal import audit_text

FAST = {"permutations": 0, "companions": []}


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Tiny encoders that were trained on the videos v0, v1 and v2, and their split."""
    manifest = six_videos(tmp_path_factory.mktemp("trained"))
    split = by_video(manifest, "v0", "v1", "v2")
    return train_encoder(manifest, split, preset="tiny", device="cpu"), split


def test_training_keeps_which_images_it_saw_by_pixels_not_by_names(
    trained, small_manifest, tmp_path
):
    encoders, split = trained
    encoders.save(tmp_path / "e")
    again = EncoderSet.load(tmp_path / "e")
    train, test = (small_manifest.part(split, part) for part in ("train", "test"))
    renamed = tmp_path / "other lab"
    renamed.mkdir()
    for k, path in enumerate([*train.paths("tactile")[:2], *test.paths("tactile")[:1]]):
        shutil.copy(path, renamed / f"{k}.png")
    for modality in ("vision", "tactile"):  # the fresh vision encoder has seen the photos
        encoder = Encoder(again, modality)
        assert again.knows_seen(modality)
        assert encoder.saw(train).all()
        assert not encoder.saw(test).any()
    assert encoder.saw(renamed).tolist() == [True, True, False]
    pixels = np.asarray(Image.open(train.paths("tactile")[0]))
    assert encoder.saw(np.stack([pixels, 255 - pixels])).tolist() == [True, False]
    assert not Encoder(make_encoders(), "tactile").saw(train).any()  # nothing is known


def test_seen_test_images_are_refused_in_probe_and_score_unless_allowed(
    trained, small_manifest, tmp_path
):
    encoders, own = trained
    some = by_video(small_manifest, "v0", "v1", "v3")
    whole = by_video(small_manifest, "v3", "v4", "v5")
    clean = by_video(small_manifest, "v0", "v1", "v2", "v3")
    files = shutil.copytree(small_manifest.root, tmp_path / "g")
    made = Manifest(small_manifest.table, files)
    for split, refused in ((own, 0), (clean, 0), (some, 8), (whole, 24)):
        n = len(split.ids("test"))
        runs = {
            "probe": lambda s=split, **k: probe(small_manifest, s, encoder=encoders, top=(), **k),
            "score": lambda s=split, **k: score(
                made, small_manifest, split=s, encoder=encoders, **FAST, **k
            ),
        }
        for name, run in runs.items():
            if refused:
                fails(f"{refused} of {n} that it was trained on", run)
            results = run(allow_seen=bool(refused))
            notes = [[x for x in s.notes if x.code == "seen-images"] for s in results if s.encoder]
            assert notes, name
            assert all(bool(x) == bool(refused) for x in notes), name
            assert not [x for s in results for x in s.notes if x.code.startswith("encoder-")]
            for note in (note for some in notes for note in some):
                assert (note.params["seen"], note.params["n"]) == (refused, n)


def test_the_impact_of_a_leak_is_not_measured_by_an_encoder_that_saw_the_samples(
    trained, small_manifest, tmp_path
):
    encoders, split = trained
    encoders.save(tmp_path / "e")
    options = {"split": split, "images": False, "impact": True, "encoder": tmp_path / "e"}
    result = audit(small_manifest, **options)
    assert result.impact is None
    (note,) = (note for note in result.notes if note.code == "impact-failed")
    assert "24 of 48 that it was trained on" in sentence(note)
    assert sentence(note, COMMAND_LINE).endswith("E.g. --allow-seen")
    result = audit(small_manifest, **options, allow_seen=True)
    rows = {(row.features, row.seen) for row in result.impact.rows}
    assert rows == {("vision encoder", True), ("tactile encoder", True)}
    page = tmp_path / "page.html"
    result.to_html(page)
    for text in (result.impact.headline, audit_text(result), page.read_text()):
        assert "trained on some of these images" in text
    assert "The tactile encoder was trained on 24 of the 48 images" in audit_text(result)
    result = audit(small_manifest, **options | {"encoder": "palpate/mini"})
    rows = {(row.features, row.seen) for row in result.impact.rows}
    assert rows == {("vision encoder", False), ("tactile encoder", False)}


def test_a_declared_data_set_is_refused(encoders, small_manifest):
    public = replace(encoders)
    facts = SimpleNamespace(name="X", license="MIT", trained_on=("Touch and Go", "YCB-Slide"))
    public.origin = lambda modality: facts
    for dataset, refused in (("Touch and Go", 1), ("HCT + YCB-Slide", 1), ("VisGel", 0), ("", 0)):
        manifest = Manifest(small_manifest.table, small_manifest.root, {"dataset": dataset})
        if refused:
            fails("with which its authors trained it", guard, public, "tactile", manifest)
        notes = guard(public, "tactile", manifest, allow_seen=True)
        codes = [n.code for n in notes]
        rest = ["encoder-license"] + ["pretraining-sets"] * (not refused)
        assert codes == ["seen-dataset"] * refused + rest


def test_an_encoder_of_another_split_is_doubted_only_where_its_images_are_unknown(
    trained, small_manifest
):
    encoders, _ = trained
    other = by_video(small_manifest, "v0", "v1", "v2", "v3")
    test = small_manifest.part(other, "test")

    def codes(**changes):
        return [n.code for n in guard(replace(encoders, **changes), "tactile", test, split=other)]

    assert codes() == []
    assert codes(seen={}) == ["encoder-of-other-split"]
    assert codes(card={**encoders.card, "seen_in_part": True}) == ["encoder-of-other-split"]
    assert codes(seen={}, card={}) == ["encoder-without-split"]
    assert codes(seen={}, card={"split": other.digest}) == []


@pytest.mark.parametrize("damage", ["gone", "cut", "fewer", "no file of tensors"])
def test_a_lost_record_of_seen_images_is_an_error(trained, tmp_path, damage):
    trained[0].save(tmp_path / "e")
    file = tmp_path / "e" / "tactile" / "seen.safetensors"
    match damage:
        case "gone":
            file.unlink()
        case "cut":
            file.write_bytes(file.read_bytes()[:-8])
        case "fewer":
            save_file({"digests": trained[0].seen["tactile"][1:]}, file)
        case _:
            file.write_text("{}")
    fails("must hold the digests of the 24 images", EncoderSet.load, tmp_path / "e")


def test_digests():
    images = np.random.default_rng(0).integers(0, 256, (5, 8, 8, 3), dtype=np.uint8)
    images[3] = images[1]
    digests = digest_images(images)
    assert digests[3] == digests[1]
    assert len(union(digests, None)) == 4
    assert union(None).shape == (0,)
    changed = images[0].copy()
    changed[7, 7, 2] ^= 1  # one bit
    assert digest_images(changed[None])[0] != digests[0]
