"""``palpate score`` of pictures: folders of images, manifests and folders of generate, with an encoder and without."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from palpate.core import Split
from palpate.metrics import compare, distance
from score_calls import call, score


def paint(folder: Path, names, seed: int, suffix: str = ".png", side: int = 32):
    rng = np.random.default_rng(seed)
    out = {}
    for name in names:
        path = folder / f"{name}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        out[name] = rng.integers(90, 160, (side, side, 3)).astype(np.uint8)
        Image.fromarray(out[name]).save(path)
    return out


def test_pictures_pair_by_relative_name_whatever_the_suffix(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["a/1", "a/2", "b [x]/1", "grün/\n1", "b/x.y"]
    real = paint(tmp_path / "real", names, 0, ".bmp")
    made = paint(tmp_path / "made", reversed(names), 1)
    found, data = score(
        capsys, "--generated", "made", "--reference", "real", "--companions", "psnr", "ssim"
    )
    assert {m for m, _, _ in found} == {"PSNR", "SSIM"}  # without an encoder pixels alone
    psnr = [-10 * np.log10((((made[n] / 255.0) - real[n] / 255.0) ** 2).mean()) for n in names]
    assert found["PSNR", "made", None]["value"] == pytest.approx(np.mean(psnr), rel=1e-12)
    assert len(data["gallery"]) == len(names)
    item = next(g for g in data["gallery"] if g["sample"]["id"] == "b [x]/1")
    assert (item["generated"], item["sample"]["tactile"]) == (
        str(tmp_path / "made" / "b [x]" / "1.png"),
        str(tmp_path / "real" / "b [x]" / "1.bmp"),
    )


def test_scores_of_pixels_need_no_torch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("real", "a", "b")):
        paint(tmp_path / name, ["1", "2", "3"], seed)
    code = (
        "import sys; from palpate.cli import main\n"
        "status = main(['score', '--generated', 'a', 'b', '--reference', 'real', '--companions', 'ssim', 'psnr', 'ms-ssim'])\n"
        "assert 'torch' not in sys.modules, sorted(sys.modules)\n"
        "sys.exit(status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "MS-SSIM" in done.stdout


def test_paired_differences_of_pixels_are_those_of_the_images(
    capsys, tmp_path, monkeypatch, small_manifest
):
    monkeypatch.chdir(tmp_path)
    small_manifest.save(Path("m/manifest.parquet"))
    a, b = (paint(tmp_path / name, small_manifest.ids, seed) for seed, name in enumerate("ab", 5))
    found, _ = score(
        capsys,
        "--generated",
        "a",
        "b",
        "--reference",
        "m",
        "--companions",
        "psnr",
        "ms-ssim",
        "contact",
    )
    real = {
        i: np.asarray(Image.open(p)) / 255.0
        for i, p in zip(small_manifest.ids, small_manifest.paths("tactile"), strict=True)
    }
    delta = {
        i: -10
        * np.log10(((a[i] / 255.0 - real[i]) ** 2).mean() / ((b[i] / 255.0 - real[i]) ** 2).mean())
        for i in real
    }
    d = found["PSNR difference", "a - b", None]
    assert d["value"] == pytest.approx(np.mean(list(delta.values())), abs=1e-9)
    per_video: dict[str, list[float]] = {}
    for i, video in zip(small_manifest.ids, small_manifest.column("video"), strict=True):
        per_video.setdefault(video, []).append(delta[i])
    means = np.array(
        [np.mean(v) for v in per_video.values()]
    )  # equal sizes: the t interval over video means
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert d["interval"][1] - d["interval"][0] == pytest.approx(2 * 2.570582 * error, rel=1e-5)
    assert d["details"]["p_value"] == pytest.approx(stats.ttest_1samp(means, 0).pvalue, rel=1e-9)
    ahead = "a" if d["value"] > 0 else "b"
    assert d["details"]["better"] == ahead
    assert (d["details"]["p_better"] > 0.5) == (ahead == "a")
    assert d["interval_method"].startswith("paired, cluster-robust over groups")
    assert {m for m, _, _ in found} >= {
        "MS-SSIM",
        "contact residual",
        "contact IoU difference",
        "contact MS-SSIM difference",
    }


def test_lpips_of_files_is_that_of_the_pictures_and_of_their_contact(
    capsys, tmp_path, monkeypatch, small_manifest
):
    from lpips_files import random_states, save_states
    from palpate.encoders.perceptual import load_lpips, lpips_per_image
    from palpate.metrics import contact_images

    monkeypatch.chdir(tmp_path)
    small_manifest.save(Path("m/manifest.parquet"))
    made = {
        name: paint(tmp_path / name, small_manifest.ids, seed) for seed, name in enumerate("ab", 5)
    }
    files = save_states(random_states(), tmp_path)
    where = (
        "--generated",
        "a",
        "b",
        "--reference",
        "m",
        "--companions",
        "lpips",
        "--lpips",
        *map(str, files),
    )
    found, _ = score(capsys, *where)
    network = load_lpips(*files)
    real, gel = (
        np.stack([np.asarray(Image.open(p)) for p in small_manifest.paths(k)])
        for k in ("tactile", "background")
    )
    whole, contact = {}, {}
    for name, pictures in made.items():
        images = np.stack([pictures[i] for i in small_manifest.ids])
        whole[name] = lpips_per_image(images, real, network)
        pairs = contact_images(images, real, gel)
        contact[name] = lpips_per_image(pairs.generated, pairs.reference, network, mask=pairs.mask)
    pairs = contact_images(gel, real, gel)
    empty = lpips_per_image(pairs.generated, pairs.reference, network, mask=pairs.mask)
    for metric, values in (("LPIPS", whole), ("contact LPIPS", contact)):
        for name in "ab":
            assert found[metric, name, None]["value"] == pytest.approx(
                np.nanmean(values[name]), rel=1e-5
            )
            assert found[metric, name, None]["higher_is_better"] is False
        difference = found[f"{metric} difference", "a - b", None]
        assert difference["value"] == pytest.approx(
            np.nanmean(values["a"] - values["b"]), rel=1e-3, abs=1e-6
        )
    assert found["contact LPIPS", "a", None]["details"]["empty"] == pytest.approx(
        np.nanmean(empty), rel=1e-5
    )
    assert ("show no contact" in found["contact LPIPS", "a", None]["note"]) == bool(
        np.isnan(empty).any()
    )


def test_unequal_ids_are_an_error_and_disjoint_ones_leave_pairs_out(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paint(tmp_path / "real", ["1", "2", "3"], 0)
    paint(tmp_path / "some", ["1", "2", "4"], 1)
    paint(tmp_path / "twice", ["1"], 1)
    paint(tmp_path / "twice", ["1"], 1, ".bmp")
    for args, word in (
        (
            ("--generated", "some", "--companions", "ssim"),
            "1 not generated: '3'; 1 without reference: '4'",
        ),
        (("--generated", "twice", "--companions", "ssim"), "'1.bmp' and '1.png'"),
        (("--generated", "real", "--companions", "contact"), "gel without contact"),
        (("--generated", "real", "--companions", "lpips"), "alexnet-owt-7be5be79.pth"),
        (("--generated", "real", "--companions", "fid"), "inception-2015-12-05.pt"),
        (("--generated", "real", "--companions", "cmmd"), "openai/clip-vit-large-patch14-336"),
        (("--generated", "real", "--companions", "fid", "--inception", "no.pt"), "no.pt"),
    ):
        status, _, err = call(capsys, *args, "--reference", "real", "--names", "g")
        assert (status, word in err) == (2, True), err


def test_generators_of_two_sizes_and_broken_pictures_are_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, side in (("real", 32), ("small", 16), ("same", 32)):
        paint(tmp_path / name, ["1", "2"], 0, side=side)
    status, _, err = call(
        capsys, "--generated", "small", "same", "--reference", "real", "--companions", "psnr"
    )
    assert (status, "small 16, same 32" in err) == (2, True)
    paint(tmp_path / "mixed", ["1"], 0, side=32)
    paint(tmp_path / "mixed", ["2"], 0, side=16)
    status, _, err = call(
        capsys, "--generated", "mixed", "--reference", "real", "--companions", "psnr"
    )
    assert (status, "1.png of 32 x 32 and 2.png of 16 x 16" in err) == (2, True)
    _, data = score(capsys, "--generated", "small", "--reference", "real", "--companions", "psnr")
    assert any("compared at 16 x 16" in note and "32 px" in note for note in data["notes"])
    _, data = score(capsys, "--generated", "same", "--reference", "real", "--companions", "psnr")
    assert not any("compared at" in note for note in data["notes"])
    (tmp_path / "same" / "2.png").write_bytes(b"\x89PNG broken")
    status, _, err = call(
        capsys, "--generated", "same", "--reference", "real", "--companions", "psnr"
    )
    assert (status, "2.png" in err, "Traceback" in err) == (2, True, False)


def test_a_folder_of_generate_that_climbs_is_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paint(tmp_path / "real", ["1"], 0)
    paint(tmp_path / "out" / "images", ["1"], 1)
    index = {
        "format": "palpate-generated/1",
        "complete": True,
        "settings": {},
        "digest": "",
        "notice": "",
        "skipped": [],
    }
    for name, good in (("1.png", True), ("../../real/1.png", False), ("/etc/hostname", False)):
        (tmp_path / "out" / "index.json").write_text(json.dumps(index | {"images": {"1": name}}))
        status, _, err = call(
            capsys, "--generated", "out", "--reference", "real", "--companions", "psnr"
        )
        assert (status, "must lie in images/" in err) == (0 if good else 2, not good), err


@pytest.fixture(scope="module")
def mini():
    """The shipped encoders, loaded once."""
    from palpate.encoders.encoder_set import EncoderSet

    return EncoderSet.load("palpate/mini")


def test_pictures_with_an_encoder(capsys, tmp_path, monkeypatch, small_manifest, mini):
    from palpate.encoders.embed import embed
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    for seed, name in enumerate("ab"):
        paint(tmp_path / name, small_manifest.ids, seed)
    shutil.copytree("a", "elsewhere/x")
    found, data = score(
        capsys,
        "--generated",
        "a",
        "b",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--permutations",
        "19",
    )
    real = embed(small_manifest, mini, "tactile")
    made = small_manifest.from_rows(
        [
            {"id": i, "tactile": f"{i}.png", "material": m, "video": v}
            for i, m, v in zip(
                small_manifest.ids,
                small_manifest.column("material"),
                small_manifest.column("video"),
                strict=True,
            )
        ],
        tmp_path / "a",
    )
    want = compare(
        {"a": embed(made, mini, "tactile")}, real, floor=real, preset="grouped", permutations=19
    ).scores
    for s in want:
        assert found[s.metric, "a", "grouped"]["value"] == pytest.approx(
            s.value, rel=1e-6, abs=1e-6
        ), s.metric
    assert found["TMMD", "a", "grouped"]["encoder"] == mini.digest("tactile")
    for metric in (
        "FID (touch)",
        "FID (touch) difference",
        "SSIM",
        "MS-SSIM",
        "contact residual",
        "Precision (touch)",
        "TMMD difference",
        "SSIM difference",
    ):
        assert [k for k in found if k[0] == metric], metric
    assert not [k for k in found if k[0].startswith(("CMMD", "LPIPS"))]
    assert data["settings"]["digests"]["tactile encoder"] == mini.digest("tactile")
    status, out, err = call(
        capsys,
        "--generated",
        "elsewhere",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--presets",
        "paper",
    )
    assert (status, "share no id" in out) == (0, True), err
    # CMMD on a CLIP of one's own: the shipped one stands in.
    found, _ = score(
        capsys,
        "--generated",
        "a",
        "--reference",
        "m",
        "--companions",
        "cmmd",
        "--clip",
        "palpate/mini",
    )
    assert found["CMMD (CLIP)", "a", "cmmd"]["encoder"] == mini.digest("vision")
    # A split of the manifest: its train part is the floor.
    ids = small_manifest.ids
    Split.from_ids(
        train=ids[:16], test=ids[16:], rule={"group": "video"}, manifest=small_manifest.digest
    ).save(Path("s.json"))
    for i in ids[:16]:
        (tmp_path / "a" / f"{i}.png").unlink()
    found, _ = score(
        capsys,
        "--generated",
        "a",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--split",
        "s.json",
        "--companions",
        "none",
    )
    s = found["TMMD", "a", "paper"]
    assert s["floor"] == pytest.approx(
        distance(real.features[:16], real.features[16:]).value, abs=1e-6
    )
    assert (s["n"], s["m"]) == (32, 32)


def test_a_split_parts_the_generated_pictures_as_well(
    capsys, tmp_path, monkeypatch, small_manifest, mini
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    ids = small_manifest.ids
    Split.from_ids(
        train=ids[:16], test=ids[16:], rule={"group": "video"}, manifest=small_manifest.digest
    ).save(Path("s.json"))
    paint(tmp_path / "a", ids, 0)
    args = (
        "--generated",
        "a",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--split",
        "s.json",
        "--companions",
        "psnr",
        "--permutations",
        "0",
        "--presets",
        "grouped",
    )
    whole, data = score(capsys, *args)
    assert (
        data["notes"][0]
        == "a: 16 of 48 touches lie outside the split's test part, and were left out"
    )
    for i in ids[:16]:
        (tmp_path / "a" / f"{i}.png").unlink()
    part, data = score(capsys, *args)
    assert part["TMMD", "a", "grouped"]["n"] == 32
    assert not any("left out" in note for note in data["notes"])
    for key, s in part.items():
        assert whole[key]["n"] == s["n"]
        assert whole[key]["value"] == pytest.approx(s["value"], abs=1e-6), key
    assert (
        part["CI-TMMD E", "a", "grouped"]["value"] is not None
    )  # material and video are the manifest's
    (tmp_path / "a" / f"{ids[-1]}.png").unlink()
    status, _, err = call(capsys, *args)
    assert (status, f"Got 1 of 32 missing, first {ids[-1]!r}" in err) == (2, True), err


def test_one_stray_picture_does_not_take_the_videos_from_all(
    capsys, tmp_path, monkeypatch, small_manifest, mini
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    paint(tmp_path / "a", [*small_manifest.ids, "v0/stray"], 0)
    args = (
        "--generated",
        "a",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--companions",
        "none",
        "--permutations",
        "0",
    )
    status, out, err = call(capsys, *args)
    assert (status, out, "Got 1 of 49 without, first 'v0/stray'" in err) == (2, "", True), err
    rows = zip(
        [*small_manifest.ids, "v0/stray"], [*small_manifest.column("video"), "v0"], strict=True
    )
    Path("c.csv").write_text("id,material,video\n" + "".join(f"{i},Wood,{v}\n" for i, v in rows))
    found, _ = score(capsys, *args, "--labels", "c.csv")
    assert found["TMMD", "a", "grouped"]["n"] == 49


def test_scores_of_pictures_name_their_reference_the_same_after_a_copy(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("real", "made")):
        paint(tmp_path / name, ["1", "2", "3"], seed)
    shutil.copytree("real", "again")
    paint(tmp_path / "other", ["1", "2", "3"], 7, side=40)
    told = {}
    for name in ("real", "again", "other"):
        found, data = score(
            capsys, "--generated", "made", "--reference", name, "--companions", "psnr"
        )
        told[name] = found["PSNR", "made", None]["reference"]
        assert told[name] == data["settings"]["digests"]["reference"]
        assert set(data["settings"]["digests"]["generated"]) == {"made"}
    assert told["real"] == told["again"] != told["other"]


def test_a_stopped_run_goes_on_from_its_embeddings_and_leaves_nothing_when_done(
    capsys, tmp_path, monkeypatch, small_manifest, mini
):
    from palpate.encoders.encoder_set import EncoderSet
    from palpate.evaluation import touches

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    for seed, name in enumerate("ab"):
        paint(
            tmp_path / name, small_manifest.ids, seed, suffix=".bmp"
        )  # of one size, and of one time
        for file in (tmp_path / name).rglob("*.bmp"):
            os.utime(file, ns=(10**18, 10**18))
    args = (
        "--generated",
        "a",
        "b",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--companions",
        "psnr",
        "--permutations",
        "0",
    )
    plain, _ = score(capsys, *args)
    with monkeypatch.context() as stop:
        stop.setattr(
            touches, "compare_features", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        status, _, err = call(capsys, *args, "-o", "s.json")
    assert (status, "goes on from what is done" in err) == (130, True)
    kept = sorted(Path(".s.json.work").rglob("touch-*.npz"))
    assert len(kept) == 3
    calls = []
    with monkeypatch.context() as count:
        count.setattr(EncoderSet, "encode", lambda *_, **__: calls.append(1))
        found, _ = score(capsys, *args, "-o", "s.json")
    assert not calls
    assert not Path(".s.json.work").exists()
    assert Path("s.json").is_file()
    monkeypatch.setattr(touches, "HELD", 0)  # every picture in a file of the cache
    again, _ = score(capsys, *args, "--cache", "kept")
    for one in (found, again):
        assert {k: s["value"] for k, s in one.items()} == pytest.approx(
            {k: s["value"] for k, s in plain.items()}, rel=1e-6, abs=1e-9
        )
    assert len(list(Path("kept").rglob("tactile-*.npy"))) == 3


def test_other_pictures_of_the_same_name_size_and_time_are_embedded_again(
    capsys, tmp_path, monkeypatch, small_manifest, mini
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    args = (
        "--generated",
        "a",
        "--reference",
        "m",
        "--encoder",
        "palpate/mini",
        "--companions",
        "none",
        "--permutations",
        "0",
    )
    values = []
    for seed in (0, 1):
        paint(tmp_path / "a", small_manifest.ids, seed, suffix=".bmp")
        for file in (tmp_path / "a").rglob("*.bmp"):
            os.utime(file, ns=(10**18, 10**18))
        found, _ = score(capsys, *args, "--cache", "kept")
        values.append(found["TMMD", "a", "grouped"]["value"])
        assert values[-1] == pytest.approx(
            score(capsys, *args)[0]["TMMD", "a", "grouped"]["value"], rel=1e-6
        )
    assert values[0] != values[1]


def test_a_manifest_is_embedded_again_when_a_real_picture_is_another_one(
    capsys, tmp_path, monkeypatch, small_manifest, mini
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    small_manifest.save(Path("m/manifest.parquet"))
    ids = small_manifest.ids
    split = Split.from_ids(
        train=ids[:16], test=ids[16:], rule={"group": "video"}, manifest=small_manifest.digest
    )
    split.save(Path("s.json"))
    paint(tmp_path / "g" / "images", ids[16:], 1)
    index = {
        "format": "palpate-generated/1",
        "complete": True,
        "settings": {},
        "digest": "",
        "notice": "",
        "skipped": [],
    }
    Path("g/index.json").write_text(
        json.dumps(index | {"images": {i: f"{i}.png" for i in ids[16:]}})
    )
    args = (
        "m",
        "--split",
        "s.json",
        "--encoder",
        "palpate/mini",
        "--generated",
        "g",
        "--companions",
        "none",
        "--permutations",
        "0",
    )
    changing = [
        small_manifest.take([ids[0], ids[-1]]).paths("tactile")[k] for k in (0, 1)
    ]  # of train, which is the floor, and of test

    def rewrite(path: Path, seed: int) -> int:
        picture = np.random.default_rng(seed).integers(90, 160, (32, 32, 3)).astype(np.uint8)
        Image.fromarray(picture).save(path, compress_level=0)  # of one size
        os.utime(path, ns=(10**18, 10**18))
        return path.stat().st_size

    sizes, seen = {rewrite(path, 0) for path in changing}, []
    for k in range(3):
        if k:
            sizes.add(rewrite(changing[k - 1], k))
        told = [
            score(capsys, *args, "--controls", "False", *more)[0]["TMMD", "g", "grouped"]
            for more in (("--cache", "kept"), ())
        ]
        assert [told[0][name] for name in ("value", "floor")] == pytest.approx(
            [told[1][name] for name in ("value", "floor")], rel=1e-6
        )
        seen.append((told[0]["value"], told[0]["floor"]))
    assert len(sizes) == 1
    assert seen[1][0] == seen[0][0]  # a train touch changes the floor alone
    assert len({floor for _, floor in seen}) == 3
    assert seen[2][0] != seen[1][0]


def test_contact_scores_without_the_gel_are_refused_before_anything_is_embedded(
    capsys, tmp_path, monkeypatch, mini
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: mini)
    calls = []
    monkeypatch.setattr(EncoderSet, "encode", lambda *_, **__: calls.append(1))
    for seed, name in enumerate(("real", "made")):
        paint(tmp_path / name, ["1", "2", "3"], seed)
    args = (
        "--generated",
        "made",
        "--reference",
        "real",
        "--encoder",
        "palpate/mini",
        "--companions",
        "contact",
    )
    status, out, err = call(capsys, *args)
    assert (status, out, "must have the gel without contact" in err, calls) == (2, "", True, []), (
        err
    )
