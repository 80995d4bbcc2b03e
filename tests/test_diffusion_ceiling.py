"""The ceiling of an autoencoder: what two judges lose, on images of a world and planted losses."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from PIL import Image

from forge.errors import fails
from palpate.cli import main
from palpate.core import Split
from palpate.data.images import load_images
from palpate.data.manifest import Manifest
from palpate.diffusion.autoencoder import load_autoencoder
from palpate.diffusion.autoencoder_training import train_autoencoder
from palpate.diffusion.ceiling import judge_of, measure_ceiling
from palpate.diffusion.training import train_generator
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import digest_images
from palpate.sim import WorldOptions, write_world

SIZE = 64


class Through:
    """Stands in for an autoencoder: what ``change`` makes of the images."""

    def __init__(self, change):
        self.change = change

    def encode(self, images, background=None, batch=64):
        return torch.from_numpy(np.array(images))

    def decode(self, latents, background=None, batch=64):
        return self.change(latents.numpy())


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    shape = {"objects_per_material": 12, "contacts_per_video": 1, "frames_per_contact": 2}
    write_world(folder / "tree", WorldOptions(seed=5, materials=3, **shape))
    return Manifest.load(folder / "tree")


@pytest.fixture(scope="module")
def split(world):
    videos = sorted(set(world.column("video")))
    train = [i for i, v in zip(world.ids, world.column("video"), strict=True) if v in videos[::2]]
    rest = [i for i in world.ids if i not in train]
    return Split.from_ids(train=train, test=rest, manifest=world.digest)


def measured(world, split, change):
    return measure_ceiling(
        Through(change), world, split, SIZE, judge=EncoderSet.load("palpate/mini")
    )


def test_what_loses_nothing_scores_as_real_images_do(world, split):
    found = measured(world, split, lambda x: x)
    assert found["n"] == len(split.ids("test"))
    assert found["psnr"] > 90
    assert found["tmmd"] == pytest.approx(0, abs=1e-3)
    assert found["accuracy"] == found["accuracy_real"] > 0.5


def test_what_is_gone_or_looks_otherwise_is_seen(world, split):
    real = measured(world, split, lambda x: x)["accuracy_real"]
    other = measured(world, split, lambda x: 255 - x)  # all is there, in other colors
    assert other["accuracy"] < real - 0.1
    gone = measured(world, split, lambda x: np.full_like(x, 128))
    assert gone["accuracy"] < 0.5
    assert min(gone["tmmd"], other["tmmd"]) > 1


def test_what_the_data_cannot_give_is_left_out(world, split):
    whole = Split.from_ids(train=world.ids, manifest=world.digest)
    assert measure_ceiling(Through(lambda x: x), world, whole, SIZE) is None
    material = world.column("material")[0]
    same = world.take(
        [i for i, m in zip(world.ids, world.column("material"), strict=True) if m == material]
    )
    parts = Split.from_ids(train=same.ids[:9], test=same.ids[9:], manifest=same.digest)
    found = measured(same, parts, lambda x: x)
    assert {"psnr", "judge"} <= set(found)
    assert not {"accuracy_real", "accuracy"} & set(found)


def test_a_training_is_not_lost_for_a_file_outside_of_it(world, split, tmp_path):
    code, test = load_autoencoder("palpate/mini"), split.ids("test")
    gel = pl.when(pl.col("id") == test[0]).then(None).otherwise(pl.col("background"))
    lacking = replace(world, table=world.table.with_columns(background=gel))
    known = Split.from_ids(train=split.ids("train"), test=test, manifest=lacking.digest)
    assert measure_ceiling(code, lacking, known, SIZE)["n"] == len(test) - 1
    (tmp_path / "cut.png").write_bytes(b"no image")
    path = pl.when(pl.col("id") == test[0]).then(pl.lit(str(tmp_path / "cut.png")))
    broken = replace(
        world, table=world.table.with_columns(tactile=path.otherwise(pl.col("tactile")))
    )
    known = Split.from_ids(train=split.ids("train"), test=test, manifest=broken.digest)
    assert "cut.png" in measure_ceiling(code, broken, known, SIZE)["not_measured"]


def test_a_background_autoencoder_is_given_gels_or_the_stock_gel(world, split):
    code, judge = load_autoencoder("palpate/mini"), EncoderSet.load("palpate/mini")
    given = measure_ceiling(code, world, split, SIZE, judge=judge)
    assert abs(given["accuracy"] - given["accuracy_real"]) < 0.1
    without = replace(world, table=world.table.with_columns(background=None))
    known = Split.from_ids(**{p: split.ids(p) for p in ("train", "test")}, manifest=without.digest)
    assert given["psnr"] > measure_ceiling(code, without, known, SIZE)["psnr"] > 15


def test_samples_are_scored_on_their_own_gels_if_any_has_one_else_on_the_stock_gel(world, split):
    """As they are generated; whether train has gels does not matter."""
    code = load_autoencoder("palpate/mini")
    train, test = split.ids("train"), split.ids("test")

    def score(have):
        own = pl.when(pl.col("id").is_in(have)).then("background")
        mixed = replace(world, table=world.table.with_columns(background=own))
        parts = Split.from_ids(train=train, test=test, manifest=mixed.digest)
        return measure_ceiling(code, mixed, parts, SIZE)

    own, stock = score([*train, *test]), score([])
    assert own == score(test)
    assert stock["psnr"] < score(train)["psnr"] < own["psnr"]  # train's first gel; its median
    assert (stock["n"], score(test[::2])["n"]) == (len(test), len(test[::2]))


def test_a_judge_without_touch_is_rejected_before_the_training(world, split):
    clip = load_clip("palpate/mini")
    fails("`judge` must have a tactile encoder", train_autoencoder, world, split, judge=clip)
    fails("no folder nowhere", train_autoencoder, world, split, judge="nowhere")


def test_a_judge_that_was_trained_on_the_images_does_not_judge_them(world, split):
    judge, test = EncoderSet.load("palpate/mini"), world.part(split, "test")
    plain = judge.preprocess("tactile").plainly
    judge.seen["tactile"] = digest_images(load_images(test.paths("tactile")[:3], plain))
    found = measure_ceiling(Through(lambda x: x), world, split, SIZE, judge=judge)
    assert (found["n"], found["not_judged"]) == (len(test), 3)
    rest = Split.from_ids(train=split.ids("train"), test=test.ids[3:], manifest=world.digest)
    alone = measure_ceiling(Through(lambda x: x), world, rest, SIZE, judge=judge)
    assert "not_judged" not in alone
    for name in ("tmmd", "accuracy_real", "accuracy"):
        assert found[name] == pytest.approx(alone[name], abs=1e-9)
    judge.seen["tactile"] = digest_images(load_images(test.paths("tactile"), plain))
    found = measure_ceiling(Through(lambda x: x), world, split, SIZE, judge=judge)
    assert (found["not_judged"], found["judge"]) == (len(test), judge.digest("tactile"))
    assert found["psnr"] > 90
    assert not {"tmmd", "accuracy"} & set(found)


def test_none_is_no_judge():
    assert judge_of("none") is None


@pytest.mark.nightly
def test_samples_that_are_drawn_have_a_gel_and_whole_files(world, split, tmp_path):
    """What is only drawn and scored costs no training: without gels, or with a broken file."""
    train, test = split.ids("train")[::4], split.ids("test")[-20:]
    own = pl.when(~pl.col("id").is_in(list(test[:-5]))).then("background")
    few = replace(world, table=world.table.with_columns(background=own))
    (tmp_path / "cut.png").write_bytes(world.paths("tactile")[0].read_bytes()[:60])
    cut = pl.when(pl.col("id").is_in([test[-1]])).then(pl.lit(str(tmp_path / "cut.png")))
    broken = replace(world, table=world.table.with_columns(tactile=cut.otherwise("tactile")))
    how = {"clip": "palpate/mini", "autoencoder": "palpate/mini", "steps": 1, "device": "cpu"}
    for name, data in (("few", few), ("broken", broken)):
        parts = Split.from_ids(train=train, test=test, manifest=data.digest)
        made = train_generator(data, parts, output=tmp_path / name, **how)
        drawn = [*(tmp_path / name).glob("samples/*/*.png")]
        if name == "few":
            assert made.training["ceiling"]["n"] == 5
            assert [Image.open(file).size for file in drawn] == [(5 * 64, 3 * 64)]
        else:
            assert "cut.png" in made.training["ceiling"]["not_measured"]
            assert not drawn


@pytest.mark.nightly
def test_trainings_print_the_ceiling_of_the_data_that_they_are_given(
    world, split, tmp_path, capsys
):
    some = {part: split.ids(part)[::2] for part in ("train", "test")}
    Split.from_ids(**some, manifest=world.digest).save(tmp_path / "split.json")
    common = ["--split", str(tmp_path / "split.json"), "--json"]
    start = ["--start", "palpate/mini", "--set", "autoencoder.steps=2"]
    folder = str(world.root)
    assert main(["train", "autoencoder", folder, *common, *start, "-o", str(tmp_path / "a")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ceiling_n"] == len(some["test"])
    assert 0 < found["ceiling_accuracy"] <= 1
    assert load_autoencoder(tmp_path / "a").card["ceiling"]["tmmd"] == found["ceiling_tmmd"]
    assert "| psnr |" in (tmp_path / "a" / "README.md").read_text()
    given = ["--autoencoder", str(tmp_path / "a"), "--clip", "palpate/mini", "--steps", "2"]
    given += ["--set", "sampler.steps=2"]  # of the samples that are drawn
    assert main(["train", "generator", folder, *common, *given, "-o", str(tmp_path / "g")]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["ceiling_psnr"] == pytest.approx(found["ceiling_psnr"], abs=0.01)
    assert "accuracy_real" in (tmp_path / "g" / "README.md").read_text()
