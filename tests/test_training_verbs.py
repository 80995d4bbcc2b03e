"""`train_encoder` and `train_generator`, in Python and on the command line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from forge.errors import fails
from palpate.cli import main
from palpate.core import PalpateError, Split, digest_folder
from palpate.data.manifest import Manifest
from palpate.diffusion import TactilePipeline, train_generator
from palpate.diffusion.presets import MINI, TINY
from palpate.encoders import EncoderSet, train_encoder
from palpate.training.processes import connect, place
from palpate.training.run import work_folder


def stop_at(what, step):
    def progress(name, done, total, remark=""):
        if name == what and done == step:
            raise KeyboardInterrupt

    return progress


def test_encoders_and_a_generator_from_the_command_line(tag, tmp_path, capsys):
    common = ["tag", "--split", "split.json", "--preset", "tiny", "--json"]
    assert main(["train", "encoder", *common, "-o", "encoders"]) == 0
    facts = json.loads(capsys.readouterr().out)
    encoders = EncoderSet.load(tmp_path / "encoders")
    assert facts["tactile"] == encoders.digest("tactile")
    assert facts["split"] == encoders.card["split"] == tag[1].digest
    (row,) = encoders.card["scores"]
    assert facts["test_material_accuracy"] == row["value"]
    assert row["value"] >= 0
    assert "linear probe of material" in (tmp_path / "encoders" / "README.md").read_text()
    options = ["--clip", "encoders", "--steps", "2", "-o", "model"]
    assert main(["train", "generator", *common, *options, "--dry-run"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert not (tmp_path / "model").exists()
    assert main(["train", "generator", *common, *options]) == 0
    facts = json.loads(capsys.readouterr().out)
    pipeline = TactilePipeline.from_pretrained(tmp_path / "model")
    assert (facts["digest"], facts["steps"], facts["source"]) == (pipeline.digest, 2, "text")
    assert (plan["parameters"], plan["steps"]) == (facts["parameters"], 2)
    assert pipeline.encoders.digest("vision") == encoders.digest("vision")
    assert pipeline.training["ceiling"]["n"] == len(tag[1].ids("test"))
    # Of eight test samples: photo, real and generated.
    (drawn,) = (tmp_path / "model" / "samples" / "denoiser").iterdir()
    assert Image.open(drawn).size == (8 * 32, 3 * 32)
    photo = tag[0].paths("vision")[0]
    assert main(["generate", str(photo), "--model", "model", "-o", "t.png"]) == 0
    assert not [p.name for p in tmp_path.iterdir() if p.name.endswith(".work")]
    # From the command's own model: its encoders and autoencoder, and its record goes with it.
    capsys.readouterr()
    started = ["train", "generator", *common, "--start", "model", "-o", "on"]
    for idle in ("sampler.guidance=2", "unet.layers=3"):  # one is as in the preset
        assert main([*started, "--set", idle]) == 2
        error = " ".join(capsys.readouterr().err.split())
        assert f"--set {idle} must be left out with a generator to go on from" in error
    assert (
        main(["train", "generator", *common, "--start", "model", "--steps", "1", "-o", "on"]) == 0
    )
    tuned = TactilePipeline.from_pretrained(tmp_path / "on")
    assert tuned.denoiser.policy == pipeline.denoiser.policy
    page = (tmp_path / "on" / "README.md").read_text()
    both = page[page.index("## Data") : page.index("## Digests")]
    assert "## Data of the models that it went on from" in both
    assert both.count(str(len(tag[1].ids("train")))) >= 2
    seen = tag[0].part(tag[1], "train")
    videos = len({*seen.column("video")})
    assert f"Trained on {len(seen)} samples of {videos} videos, after another model." in page
    assert tuned.autoencoder.digest == pipeline.autoencoder.digest
    assert tuned.encoders.digest("text") == encoders.digest("text")
    assert tuned.training["start"] == pipeline.digest != tuned.digest
    assert tuned.training["start_record"]["loop"]["steps"] == 2
    capsys.readouterr()
    # The same again has nothing left to do, and overwrites nothing.
    before = digest_folder(tmp_path)
    for verb, words in (("encoder", []), ("generator", options[:-2])):
        out = {"encoder": "encoders", "generator": "model"}[verb]
        assert main(["train", verb, *common[:-1], *words, "-o", out]) == 0
        assert f"Finished before: {out} is" in capsys.readouterr().err
    assert digest_folder(tmp_path) == before
    for other in (["--seed", "1"], ["--set", "loop.lr=2e-3"], ["--clip", "palpate/mini"]):
        words = ["train", "generator", *common, *options, *other]
        assert main(words) == 2
        assert "the result of another training" in capsys.readouterr().err
    image = tag[0].paths("tactile")[0]
    Image.open(image).rotate(180).save(image)  # another under the same name
    assert main(["train", "generator", *common, *options]) == 2
    assert "the result of another training" in capsys.readouterr().err


def test_a_loss_that_is_no_number_ends_a_generator_in_one_line(tag, tmp_path, capsys):
    command = ["train", "generator", "tag", "--split", "split.json", "--preset", "tiny", "--quiet"]
    options = ["--set", "condition.source=resnet", "condition.photo_size=16"]
    options += ["condition.photo_width=4"]
    harm = ["--set", "loop.lr=1e30", "loop.warmup=0", "--steps", "4"]
    assert main([*command, *options, *harm, "-o", "model"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "of generator must be finite. Got nan at step" in line
    assert "with v" in line  # names the samples
    assert not (tmp_path / "model").exists()


def test_an_interrupted_training_ends_as_an_uninterrupted_one(tag, tmp_path):
    manifest, split = tag
    common = {"preset": "tiny", "device": "cpu"}
    whole = train_encoder(manifest, split, **common)
    stop = stop_at("training the tactile encoder", 3)
    with pytest.raises(KeyboardInterrupt):
        train_encoder(manifest, split, output=tmp_path / "e", progress=stop, **common)
    assert not (tmp_path / "e").exists()
    again = train_encoder(manifest, split, output=tmp_path / "e", **common)
    assert again.digest("tactile") == whole.digest("tactile")
    assert again.card["scores"] == whole.card["scores"]
    small = replace(MINI, size=32, sampler=replace(MINI.sampler, steps=2))
    options = {"steps": 4, "autoencoder": "palpate/mini", "preset": small, "device": "cpu"}
    whole_pipeline = train_generator(manifest, split, whole, **options)
    with pytest.raises(KeyboardInterrupt):
        train_generator(
            manifest,
            split,
            whole,
            output=tmp_path / "g",
            progress=stop_at("generator", 2),
            **options,
        )
    pipeline = train_generator(manifest, split, whole, output=tmp_path / "g", **options)
    assert pipeline.digest == whole_pipeline.digest
    photo = manifest.paths("vision")[0]
    one, other = (np.asarray(p(photo, steps=2).images[0]) for p in (pipeline, whole_pipeline))
    assert np.array_equal(one, other)


def test_a_set_of_encoders_or_a_clip_conditions_a_generator(tag, tmp_path):
    encoders = train_encoder(*tag, preset="tiny", device="cpu")
    encoders.save(tmp_path / "set")
    made = [
        train_generator(*tag, clip, preset="tiny", steps=1, device="cpu")
        for clip in (tmp_path / "set", tmp_path / "set" / "clip")
    ]
    assert made[0].digest == made[1].digest


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, s: train_encoder(m, s, preset="huge"), "`preset` must be one of tiny, mini"),
        (lambda m, s: train_encoder(m, s, epochs=0), "`epochs` must be a positive number"),
        (lambda m, s: train_encoder(m, s, clip="nowhere"), "no folder nowhere"),
        (lambda m, s: train_encoder(m, Split.from_ids(test=m.ids)), "train part"),
        (lambda m, s: train_generator(m, s, "nowhere", preset="tiny"), "no folder nowhere"),
        (lambda m, s: train_generator(m, s, "palpate/mini", steps=0), "`steps` must be at least 1"),
        (
            lambda m, s: train_generator(m, s, "palpate/mini", preset="paper"),
            "`autoencoder` must be given for the preset paper",
        ),
        (
            lambda m, s: train_generator(m, s, start="palpate/mini", background=True),
            "another background",
        ),
        (
            lambda m, s: train_generator(
                m, s, preset=replace(TINY, unet="u"), start="palpate/mini"
            ),
            "`start` must be left out for a preset with a trained U-Net",
        ),
    ],
)
def test_mistakes_are_explained(tag, call, message):
    fails(message, call, *tag)


def test_the_split_that_lies_with_the_data_is_the_default(tag, tmp_path, capsys):
    common = ["train", "encoder", "tag", "--preset", "tiny", "--clip", "palpate/mini", "-o", "e"]
    assert main(common) == 2
    assert "--split must be given unless one lies with the data" in capsys.readouterr().err
    (tmp_path / "tag" / "splits").mkdir()
    shared = {i: "test" if k % 4 == 0 else "train" for k, i in enumerate(tag[1].parts)}
    split = Split(shared, {"name": "Orig", "method": "official"})
    split.save(tmp_path / "tag" / "splits" / "Orig.json")
    assert main([*common, "--dry-run"]) == 0
    assert main([*common, "--epochs", "0.1"]) == 0
    assert main([*common, "--epochs", "0.2"]) == 2  # no advice to remove what took days
    card = EncoderSet.load(tmp_path / "e").card
    assert card["split"] == split.digest
    # What the split shares is said, and stays with the model.
    words = " ".join(capsys.readouterr().err.split())
    assert "the result of another training: it cannot go on. Train from the start" in words
    assert "Videos: from the column video; contacts: from the column contact" in words
    assert "The split 'Orig' is not NoLeak: 6 of 6 videos of its test part are in train" in words
    assert card["split_rule"]["shared"] == {"video": [6, 6]}
    assert '"shared": {"video": [6, 6]}' in (tmp_path / "e" / "README.md").read_text()


def test_what_is_rejected_leaves_no_folder_and_keeps_another_run_s(tag, tmp_path):
    manifest, split = tag
    bare = Manifest.from_rows(
        [{**row, "tactile": None} for row in manifest.table.iter_rows(named=True)], manifest.root
    )
    with pytest.raises(PalpateError, match="tactile"):
        train_encoder(bare, split, preset="tiny", clip="palpate/mini", output=tmp_path / "out")
    assert not list(tmp_path.glob(".out*"))
    with work_folder(tmp_path / "out") as work:
        with pytest.raises(PalpateError, match="must be written by one run"):
            train_encoder(manifest, split, preset="tiny", output=tmp_path / "out")
        assert work.is_dir()


def test_several_processes_need_torch_with_its_distributed_part(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(torch.distributed, "is_available", lambda: False)
    fails("a build without it", connect, "cpu")
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert connect("cpu") == "cpu"
    assert place() == (0, 1)
