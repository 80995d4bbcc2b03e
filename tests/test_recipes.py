"""The recipe of the shipped models, in small; zero-shot classification against a loop."""

import importlib
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mini_scores import zero_shot_accuracy

from forge.models import make_encoders
from palpate.core import FeatureSet, digest_folder, read_json
from palpate.encoders import models as shipped_module
from palpate.sim.presets import MINI_SEEDS

RECIPES = Path(__file__).parents[1] / "recipes"


@pytest.fixture
def mini(monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))
    names = ("mini", "mini_scores", "mini_cards")
    modules = [importlib.import_module(name) for name in names]
    yield modules[0]
    for name in names:
        sys.modules.pop(name)


@pytest.fixture
def small(mini, monkeypatch, tmp_path):
    """The recipe with worlds and trainings of a few seconds, shipping into a folder of the test."""
    few = {
        "materials": ("Wood", "Brick", "Grass"),
        "objects_per_material": 4,
        "contacts_per_video": 2,
    }
    monkeypatch.setattr(
        mini, "WORLDS", {name: replace(options, **few) for name, options in mini.WORLDS.items()}
    )
    monkeypatch.setattr(mini, "CLIP_EPOCHS", 1.0)
    course = replace(mini.TACTILE.tactile_course, steps=3, batch=8, evaluations=1)
    monkeypatch.setattr(mini, "TACTILE", replace(mini.TACTILE, image=32, tactile_course=course))
    monkeypatch.setattr(mini, "AUTOENCODER", replace(mini.AUTOENCODER, steps=3))
    monkeypatch.setattr(mini, "GENERATOR_STEPS", 3)
    monkeypatch.setattr(mini, "CONTACTS_STEPS", 3)
    monkeypatch.setattr(sys.modules["mini_scores"], "GENERATED", 8)
    monkeypatch.setattr(sys.modules["mini_scores"], "POOL", 10)
    ruler = shipped_module.RULERS["palpate/handcrafted"]
    (tmp_path / "package" / ruler).parent.mkdir(parents=True)
    shutil.copy(shipped_module.shipped_root() / ruler, tmp_path / "package" / ruler)
    monkeypatch.setattr(shipped_module, "shipped_root", lambda: tmp_path / "package")
    monkeypatch.setattr(mini, "shipped_root", lambda: tmp_path / "package")
    monkeypatch.setattr(mini, "PAGE", tmp_path / "mini.md")
    (tmp_path / "mini.md").write_text(
        "before\n<!-- scores of the cards -->\nold\n<!-- end of the scores -->\nafter\n"
    )
    return mini


def test_the_page_has_the_scores_of_the_cards(mini):
    target = shipped_module.shipped_root() / "mini"
    assert sys.modules["mini_cards"].scores_table(target) in (
        RECIPES.parent / "docs" / "concepts" / "mini.md"
    ).read_text(encoding="utf-8")


def test_only_reserved_seeds_are_read_and_none_twice(mini):
    seeds = [options.seed for options in mini.WORLDS.values()]
    assert len(set(seeds)) == len(seeds)
    assert all(seed in MINI_SEEDS for seed in seeds)


@pytest.mark.nightly
@pytest.mark.slow
def test_every_part_is_made_shipped_and_verified(small, tmp_path, capsys):
    recipe = small.Recipe(tmp_path / "work")
    recipe.make("autoencoder")
    assert not (tmp_path / "work" / "clip").exists()  # it does not need the encoders
    recipe.make("scores")
    recipe.ship()
    target = tmp_path / "package" / "mini"
    first = digest_folder(target)
    scores = {
        part: read_json(target / part / "palpate.json", "card")
        for part in ("encoders", "autoencoder", "generator")
    }
    rows = {row["score"]: row for row in scores["encoders"]["card"]["scores"]}
    # Of the materials that have captions in the world of training.
    assert rows["zero-shot material, vision"]["chance"] == pytest.approx(1 / 3)
    assert {"PSNR [dB], gelsight", "PSNR [dB], digit", "SSIM, digit"} <= {
        row["score"] for row in scores["autoencoder"]["card"]["scores"]
    }
    assert any(
        row["score"] == "TMMD, generated" for row in scores["generator"]["training"]["scores"]
    )
    third = scores["generator"]["training"]
    second = third["start_record"]
    assert (third["seed"], second["seed"], second["start_record"]["seed"]) == (2, 1, 0)
    assert scores["generator"]["contact"]["depth"]
    assert second["start_record"]["start"] is None
    exact = small.stored_stage(tmp_path / "work" / "generator").facts["digest"]
    assert second["start"] != exact  # the rounded weights went on
    assert "900050" in (target / "encoders" / "README.md").read_text()
    assert not any(
        "tactile" in row["score"]
        for row in read_json(target / "encoders" / "clip" / "palpate.json", "card")["card"][
            "scores"
        ]
    )
    trained = {
        part: {
            row["seed"]
            for row in (about.get("card") or about["training"])["data"]
            if row["used for"] == "training"
        }
        for part, about in scores.items()
    }
    assert trained == {
        "encoders": {900_000, 900_002, *range(900_010, 900_024)},
        "autoencoder": {900_000, 900_001},
        "generator": {900_000, 900_002, 900_003},
    }
    page = (tmp_path / "mini.md").read_text()
    assert page.startswith("before\n")
    assert page.endswith("after\n")
    assert "old" not in page
    assert "| autoencoder | SSIM, digit |" in page
    # Again: everything is read, nothing trained, and the same bytes are shipped.
    capsys.readouterr()
    again = small.Recipe(tmp_path / "work")
    again.make("scores")
    printed = capsys.readouterr().out
    assert "already done" in printed
    assert "training" not in printed
    for part in scores:
        shutil.rmtree(target / part)
    again.ship()
    assert digest_folder(target) == first
    assert again.verify() == 0
    # A card that promises more than the weights keep is calls.
    about = read_json(target / "autoencoder" / "palpate.json", "card")
    about["card"]["scores"][0]["value"] += 1.0
    from palpate.core import write_json

    write_json(target / "autoencoder" / "palpate.json", about)
    capsys.readouterr()
    assert again.verify() == 1
    assert capsys.readouterr().out.count("DIFFERS") == 1


@pytest.mark.nightly
@pytest.mark.slow
def test_a_stop_between_saving_and_the_end_of_a_part_is_repaired(small, tmp_path, monkeypatch):
    from palpate.encoders.encoder_set import EncoderSet

    save = EncoderSet.save

    def stopped(self, folder, **how):
        save(self, folder, **how)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(EncoderSet, "save", stopped)
        with pytest.raises(KeyboardInterrupt):
            small.Recipe(tmp_path / "work").make("clip")
    recipe = small.Recipe(tmp_path / "work")
    recipe.make("clip")
    assert (tmp_path / "work" / "clip" / "clip" / "clip" / "model.safetensors").is_file()


# --- zero-shot classification

PROMPTS = {
    "Cloth": ["a soft cloth"],
    "Metal": ["smooth cold metal", "cold"],
    "Wall": ["a rough wall", "rough", "wall"],
}


@pytest.fixture(scope="module")
def encoders():
    return make_encoders()


def features(labels, seed=0, groups=None):
    rows = np.random.default_rng(seed).standard_normal((len(labels), 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return FeatureSet([f"s{k}" for k in range(len(labels))], rows, labels, groups, "encoder")


def slow_accuracy(images, encoders):
    right = 0
    for row, label in zip(images.features, images.labels, strict=True):
        best, chosen = -2.0, None
        for name, texts in PROMPTS.items():
            mean = sum(encoders.encode("text", [text])[0].double().numpy() for text in texts) / len(
                texts
            )
            cosine = float(row @ mean / np.sqrt((mean**2).sum()))
            if cosine > best:
                best, chosen = cosine, name
        right += chosen == label
    return right / len(images.labels)


def test_it_equals_a_loop_over_images_classes_and_texts(encoders):
    labels = [sorted(PROMPTS)[k % 3] for k in range(60)]
    images = features(labels, groups=[f"v{k // 6}" for k in range(60)])
    score = zero_shot_accuracy(images, PROMPTS, encoders)
    assert score.value == pytest.approx(slow_accuracy(images, encoders))
    assert 0.1 < score.value < 0.9
    assert score.details["chance"] == pytest.approx(1 / 3)
    assert score.interval[0] < score.value < score.interval[1]


def test_images_that_are_their_text_are_all_named(encoders):
    rows = np.stack([encoders.encode("text", PROMPTS[name])[0].numpy() for name in sorted(PROMPTS)])
    images = FeatureSet(["a", "b", "c"], rows, sorted(PROMPTS), None, "encoder")
    prompts = {name: texts[:1] for name, texts in PROMPTS.items()}
    assert zero_shot_accuracy(images, prompts, encoders).value == 1.0
    moved = FeatureSet(["a", "b", "c"], rows[[1, 2, 0]], sorted(PROMPTS), None, "encoder")
    assert zero_shot_accuracy(moved, prompts, encoders).value == 0.0
