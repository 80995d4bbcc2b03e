"""Pictures and ids: whose picture is compared with which, whose video it has, and which real touches a score was made against."""

import os
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from palpate.core import PalpateError, Split, require_comparable
from palpate.data.manifest import Manifest
from palpate.diffusion.generate import Generated
from palpate.encoders.encoder_set import EncoderSet
from palpate.evaluation import touches as touches_module
from palpate.evaluation.comparing import Asked
from palpate.evaluation.embeddings import Columns
from palpate.evaluation.score_inputs import completed, read_touches
from palpate.evaluation.scoring import compare_generated
from palpate.evaluation.touches import compare_touches, files_digest
from palpate.metrics import ssim


def pictures(folder: Path, ids, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    out = {}
    for i in ids:
        (folder / i).parent.mkdir(parents=True, exist_ok=True)
        out[i] = rng.integers(60, 200, (32, 32, 3)).astype(np.uint8)
        Image.fromarray(out[i]).save(folder / f"{i}.png")
    return out


def test_every_generated_picture_is_compared_with_that_of_its_id(tmp_path, small_manifest):
    ids = small_manifest.ids
    split = Split.from_ids(
        train=ids[:16], test=ids[16:], rule={"group": "video"}, manifest=small_manifest.digest
    )
    made = pictures(tmp_path / "made" / "images", ids[16:], 1)
    folder = Generated(tmp_path / "made", {i: f"{i}.png" for i in reversed(ids[16:])})
    found = compare_generated(
        small_manifest,
        split,
        {"g": folder},
        EncoderSet.load("palpate/mini"),
        Asked(presets=("paper",), permutations=0),
        controls=False,
        companions=("ssim",),
    )
    real = small_manifest.part(split, "test")
    images = np.stack([np.asarray(Image.open(p)) for p in real.paths("tactile")])
    want = ssim(np.stack([made[i] for i in real.ids]), images, ids=real.ids)
    [got] = [s for s in found.scores if s.metric == "SSIM"]
    assert got.value == pytest.approx(want.value, abs=1e-12)
    digest = files_digest(real.ids, real.paths("tactile"))
    compared = {"TMMD", "SSIM"}
    assert {s.metric: s.reference for s in found.scores} == {
        s.metric: digest if s.metric in compared else None for s in found.scores
    }
    assert {s.metric for s in found.scores} > compared


@pytest.mark.parametrize("name", ["real", "background only", "real, same material"])
def test_no_generator_bears_the_name_of_a_control(tmp_path, small_manifest, name):
    ids = small_manifest.ids
    split = Split.from_ids(
        train=ids[:16], test=ids[16:], rule={"group": "video"}, manifest=small_manifest.digest
    )
    pictures(tmp_path / "made", ids[16:], 1)
    folder = Generated(tmp_path / "made", {i: f"{i}.png" for i in ids[16:]})
    with pytest.raises(PalpateError, match=f"name of a control. Got '{name}'"):
        compare_generated(
            small_manifest,
            split,
            {name: folder},
            EncoderSet.load("palpate/mini"),
            Asked(presets=("paper",)),
        )


def test_the_digest_of_pictures_is_that_of_a_copy_and_not_that_of_others(tmp_path):
    pictures(tmp_path / "a", ["v/1", "v/2"], 0)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    read = lambda name: read_touches(tmp_path / name)  # noqa: E731
    digest = lambda m: files_digest(m.ids, m.paths("tactile"))  # noqa: E731
    assert digest(read("a")) == digest(read("b")) == digest(read("b").take(["v/2", "v/1"]))
    assert digest(read("b").take(["v/1"])) != digest(read("a"))
    with open(tmp_path / "b" / "v" / "1.png", "ab") as file:
        file.write(b"\0")
    assert digest(read("a")) != digest(read("b"))


def test_pairs_that_were_asked_for_by_name_must_be_there(tmp_path):
    for seed, name in enumerate(("real", "made")):
        pictures(tmp_path / name, [f"{name}{k}" for k in range(3)], seed)
    made, real = {"g": read_touches(tmp_path / "made")}, read_touches(tmp_path / "real")
    with pytest.raises(PalpateError, match=r"g: .* id"):
        compare_touches(made, real, None, Asked(), companions=("ssim",))
    found = compare_touches(made, real, None, Asked())
    assert found.scores == []
    assert found.remarks == [
        "Scores of pairs of pictures left out: generated and real touches share no id"
    ]


def test_videos_and_materials_are_taken_by_id_and_never_lost_for_one_stray_picture(tmp_path):
    rows = [
        {"id": f"{v}/{k}", "tactile": "x.png", "video": v, "material": v.upper()}
        for v in "cab"
        for k in (1, 0)
    ]
    like = Manifest.from_rows(rows, tmp_path)  # in another order than the folder
    pictures(tmp_path / "made", [r["id"] for r in rows[:-1]], 0)
    made = read_touches(tmp_path / "made")
    found = completed(made, group="video", like=like)
    assert found.column("video") == [i[0] for i in found.ids]
    assert found.column("material") == [i[0].upper() for i in found.ids]
    pictures(tmp_path / "made", ["b/stray"], 1)
    made = read_touches(tmp_path / "made")
    with pytest.raises(
        PalpateError, match=r"gives material and video by id\. Got 1 of 6 without, first 'b/stray'"
    ):
        completed(made, group="video", like=like)
    columns = Columns(tmp_path / "c.csv", made.ids, ["Wood"] * 6, ["v"] * 6)  # which cover it
    assert completed(made, group="video", columns=columns, like=like).column("video") == ["v"] * 6
    bare = Manifest.from_rows(
        ({"id": r["id"], "tactile": "x.png"} for r in rows), tmp_path
    )  # which has nothing to give
    assert completed(made, group="video", like=bare).ids == made.ids
    pictures(tmp_path / "own", ["1", "2"], 1)  # names of their own
    assert completed(read_touches(tmp_path / "own"), group="video", like=like).column("video") == [
        None,
        None,
    ]


def test_contacts_are_those_against_the_gel_of_now(small_manifest, tmp_path, monkeypatch):
    """Decoded pictures in a cache are of the bytes of now, also the empty gel's, whatever name, size and time it has."""
    monkeypatch.setattr(touches_module, "HELD", 0)
    root = tmp_path / "gel"
    root.mkdir()
    some = small_manifest.take(small_manifest.ids[:4])
    paths = []
    for k, path in enumerate(some.paths("background")):
        paths.append(root / f"{k}.bmp")
        Image.open(path).save(paths[-1])
    real = Manifest(
        some.table.with_columns(pl.Series("background", [str(p) for p in paths])), some.root
    )
    made = Manifest(
        some.table.with_columns(
            pl.Series("tactile", list(reversed(some.table["tactile"].to_list())))
        ),
        some.root,
    )

    def scores(cache):
        found = compare_touches(
            {"g": made}, real, None, Asked(), companions=("contact",), cache=cache
        ).scores
        assert len(found) == 5
        return found

    for path in paths:
        os.utime(path, (10**9, 10**9))
    before, cache = scores(None), tmp_path / "cache"
    assert [s.value for s in scores(cache)] == [s.value for s in before]
    for path in paths:
        Image.open(path).point(lambda v: min(255, v + 40)).save(path)
        os.utime(path, (10**9, 10**9))
    after = scores(None)
    assert [s.value for s in after] != [s.value for s in before]
    assert [s.value for s in scores(cache)] == [s.value for s in after]
    with pytest.raises(PalpateError, match="agree in settings"):  # another gel, another contact
        require_comparable([before[0], after[0]])
