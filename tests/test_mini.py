"""Models by name: shipped, in a folder, on the hub; 16-bit weights; model cards."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from forge.errors import fails
from forge.models import arrays, make_encoders, make_pipeline, write_shipped
from forge.pictures import photos
from palpate.core import PalpateError, digest_folder
from palpate.diffusion.autoencoder import load_autoencoder
from palpate.diffusion.pipeline import TactilePipeline
from palpate.encoders import models as shipped
from palpate.encoders.encoder_set import EncoderSet, load_clip
from palpate.encoders.models import (
    PARTS,
    SHIPPED,
    is_hub_id,
    round_to_half,
    shipped_folder,
    shipped_root,
)
from palpate.training.cards import model_card, write_model_cards

MINI = shipped_root() / "mini"
LOADERS = [load_clip, EncoderSet.load, load_autoencoder, TactilePipeline.from_pretrained]


@pytest.fixture
def no_network(monkeypatch):
    """Counts attempts to reach anything; each fails."""
    attempts: list[object] = []

    def block(*args, **kwargs):
        attempts.append(args)
        raise OSError("no network here")

    for name in ("getaddrinfo", "create_connection"):
        monkeypatch.setattr(socket, name, block)
    monkeypatch.setattr(socket.socket, "connect", block)
    return attempts


@pytest.fixture
def mini(tmp_path, monkeypatch):
    """``palpate/mini`` as tests write it, and the working directory next to it."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return write_shipped(tmp_path / "root", monkeypatch)


def test_every_loader_takes_the_shipped_name_without_a_network(mini, no_network):
    clip, encoders, autoencoder, pipeline = (load("palpate/mini") for load in LOADERS)
    assert clip.name == encoders.name == "palpate/mini"
    sets = (clip, encoders, pipeline.encoders, mini.encoders)
    assert len({each.digest("vision") for each in sets}) == 1
    assert encoders.tactile is not None
    assert autoencoder.digest == pipeline.autoencoder.digest
    assert pipeline.digest == mini.digest
    assert np.array_equal(arrays(pipeline(photos(3), seed=1)), arrays(mini(photos(3), seed=1)))
    assert no_network == []


def test_a_folder_of_the_same_name_does_not_shadow_what_ships(mini):
    here = make_encoders(seed=5)
    here.save(Path("palpate/mini"))
    assert EncoderSet.load("palpate/mini").digest("tactile") != here.digest("tactile")
    folder = Path("palpate/mini")
    for own in ("./palpate/mini", folder, folder.resolve(), str(folder.resolve())):
        assert EncoderSet.load(own).digest("tactile") == here.digest("tactile")


@pytest.mark.parametrize("load", LOADERS)
def test_names_of_no_model_are_explained(mini, load, no_network):
    message = r"must be one of palpate/mini(, palpate/handcrafted)?\. Got 'palpate/"
    message += r".*folder .* is written \./palpate"
    for name in ("palpate/maxi", "palpate/", "palpate/mini/", "palpate/mini/../mini"):
        fails(message, load, name)
    for name in ("no-such", "a/b/c", "../x", "", "./palpate/mini"):
        error = fails("", load, name)
        assert error.got == f"no folder {name or repr('')}"
    assert no_network == []


def test_an_installation_without_the_files_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "shipped_root", lambda: tmp_path)
    words = r"palpate/mini must lie in the installed package\. Got no encoders in"
    fails(words, EncoderSet.load, "palpate/mini")


def test_what_may_be_asked_of_the_hub(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "owner" / "local").mkdir(parents=True)
    for name in ("owner/name", "openai/clip-vit-large-patch14", "a.b/c_d-1.0"):
        assert is_hub_id(name)
    others = ("owner/local", "palpate/mini", "name", "a/b/c", "../a", "/a/b", "./a/b", "")
    assert not any(map(is_hub_id, (*others, Path("owner/name"))))
    assert shipped_folder(Path("palpate/mini"), "clip") is None


def test_a_hub_id_works_like_a_folder(mini, tmp_path, monkeypatch):
    requested = []
    places = {
        "o/encoders": shipped_folder("palpate/mini", "encoders"),
        "o/generator": shipped_folder("palpate/mini", "generator"),
    }

    def snapshot(name, allow_patterns, **_):
        requested.append((name, tuple(allow_patterns)))
        return str(places[name])

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    named, shipped_set = (EncoderSet.load(name) for name in ("o/encoders", "palpate/mini"))
    assert named.digest("tactile") == shipped_set.digest("tactile")
    assert TactilePipeline.from_pretrained("o/generator").digest == mini.digest
    assert [name for name, _ in requested] == ["o/encoders", "o/generator"]
    assert not any(".bin" in p or p == "*" for _, patterns in requested for p in patterns)


def test_a_hub_out_of_reach_is_a_mistake_in_one_line(monkeypatch, no_network):
    words = r"o/none must be a hub id within reach, a local folder or a shipped model"
    for load in LOADERS:
        caught = fails(words, load, "o/none")
        assert "\n" not in str(caught)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    (file,) = folder.glob("*model*.safetensors")
    return load_file(file)


def test_half_is_rounded_first_and_read_back_to_the_same_digest(tmp_path):
    encoders, exact = make_encoders(), make_encoders()
    encoders.save(tmp_path / "t", half=True)
    again = EncoderSet.load(tmp_path / "t")
    stored = [
        *weights(tmp_path / "t" / "clip").values(),
        *weights(tmp_path / "t" / "tactile").values(),
    ]
    assert {v.dtype for v in stored} == {torch.float16}
    assert {p.dtype for m in (again.clip, again.tactile) for p in m.parameters()} == {torch.float32}
    for name in ("vision", "text", "tactile"):
        assert again.digest(name) == encoders.digest(name) != exact.digest(name)
    for mine, before in zip(encoders.tactile.parameters(), exact.tactile.parameters(), strict=True):
        assert torch.equal(mine, before.half().float())
    # The same weights in 32 bits are the same model; 16 bits are half the file.
    encoders.save(tmp_path / "full")
    assert EncoderSet.load(tmp_path / "full").digest("tactile") == encoders.digest("tactile")
    sizes = [
        sum(f.stat().st_size for f in (tmp_path / n).rglob("*.safetensors")) for n in ("t", "full")
    ]
    assert sizes[0] < 0.6 * sizes[1]
    model = make_pipeline().autoencoder
    full = model.digest
    model.save(tmp_path / "a", half=True)
    assert load_autoencoder(tmp_path / "a").digest == model.digest != full
    stored = weights(tmp_path / "a")["quantize.embedding.weight"]
    assert stored.dtype == torch.float16
    assert torch.equal(stored.float(), model.net.quantize.embedding.weight)
    rounded = model.digest
    model.halve()
    assert model.digest == rounded  # rounded once is rounded for good


def test_rounding_is_refused_where_it_makes_infinity():
    module = torch.nn.Linear(3, 1, bias=False)
    module.weight.data = torch.tensor([[1.0, 1.0 + 2**-11 + 2**-20, 1e-9]])
    round_to_half({"m": module})
    assert module.weight.tolist() == [[1.0, 1.0 + 2**-10, 0.0]]
    for bad in (70000.0, float("nan"), float("inf")):
        other = torch.nn.Linear(2, 1, bias=False)
        other.weight.data = torch.tensor([[0.1, 0.2]])
        module.weight.data = torch.tensor([[bad, 0.1, 0.1]])
        fails(r"finite and below 65,520.*m\.weight", round_to_half, {"a": other, "m": module})
        assert other.weight.tolist() == torch.tensor([[0.1, 0.2]]).tolist()


def test_a_generator_that_refers_carries_no_copies_and_checks_what_it_finds(
    mini, tmp_path, monkeypatch
):
    folder = shipped_folder("palpate/mini", "generator")
    files = ["README.md", "model_index.json", "palpate.json", "scheduler", "unet"]
    assert sorted(p.name for p in folder.iterdir()) == files
    about = json.loads((folder / "palpate.json").read_text())
    assert (about["shared"], about["autoencoder"], about["encoders"]) == (
        "palpate/mini",
        mini.autoencoder.digest,
        mini.encoders.digest("vision"),
    )
    other = replace(mini, encoders=make_encoders(seed=9))
    with pytest.raises(PalpateError, match="must use its autoencoder and vision encoder"):
        other.save(tmp_path / "other", shared="palpate/mini")
    assert not (tmp_path / "other").exists()
    with pytest.raises(PalpateError, match="`shared` must be one of palpate/mini"):
        mini.save(tmp_path / "other", shared=str(tmp_path))
    # A later version of the package ships other encoders.
    import shutil

    place = shipped_folder("palpate/mini", "encoders")
    shutil.rmtree(place)
    make_encoders(seed=7).save(place, half=True)
    with pytest.raises(PalpateError, match="must find the parts of palpate/mini that it was train"):
        TactilePipeline.from_pretrained("palpate/mini")
    (folder / "palpate.json").write_text(json.dumps(about | {"shared": "../../encoders"}))
    fails("`shared` must be one of palpate/mini", TactilePipeline.from_pretrained, "palpate/mini")


def test_a_card_is_made_of_the_json_alone(mini):
    folder = shipped_folder("palpate/mini", "encoders").parent
    files = {p: p.read_text() for p in folder.rglob("README.md")}
    folders = [".", "autoencoder", "encoders", "encoders/clip", "generator"]
    assert sorted(p.parent.relative_to(folder).as_posix() for p in files) == folders
    for path, text in files.items():
        if path.parent != folder:
            assert text == model_card(json.loads(path.with_name("palpate.json").read_text()))
        path.unlink()
    write_model_cards(folder)
    assert {p: p.read_text() for p in folder.rglob("README.md")} == files
    contents = (folder / "README.md").read_text()
    for line in (
        "| [encoders/clip](encoders/clip/README.md) | Vision and text encoders | 0.0 |",
        "| [generator](generator/README.md) | From a photo",
    ):
        assert line in contents


def test_a_card_says_what_it_must(mini):
    card = {
        "title": "T",
        "summary": "S.",
        "tags": ["x", "clip"],
        "scores": [
            {"score": "PSNR", "value": 31.234567, "interval": [30.0, 32.5]},
            {"score": "a|b", "n": 3, "value": None},
        ],
        "data": {"seeds": "1-2"},
        "limits": ["Not real."],
        "recipe": "python recipes/r.py",
        "digest of split": "äb",
        "loss": [{"loss": 1.0}] * 50,
    }
    about = {"format": "palpate-clip/1", "digests": {"vision": "00ff"}, "name": "palpate/mini"}
    text = model_card(about | {"card": card})
    head, body = text.split("---\n")[1:3]
    assert head == (
        "library_name: transformers\nlicense: apache-2.0\n"
        "pipeline_tag: zero-shot-image-classification\n"
        "tags:\n- palpate\n- tactile\n- clip\n- x\n"
    )
    lines = ["# T", "S.", "| score | value | interval | n |", "| PSNR | 31.23 | [30, 32.5] |  |"]
    lines += ["| a\\|b |  |  | 3 |", "| seeds |", "- Not real.", "python recipes/r.py"]
    lines += ["- vision: `00ff`", ' "digest of split": "äb",', 'clip = load_clip("palpate/mini")']
    for line in lines:
        assert f"\n{line}\n" in body, line
    assert len(text) < 2500
    fails("`format` must be one of palpate-clip/1", model_card, {"format": "other"})


def size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def test_what_ships_is_small_enough_complete_and_16_bit():
    assert set(SHIPPED) == {"palpate/mini"}
    assert all((MINI / place / "palpate.json").is_file() for place in PARTS.values())
    files = [p for p in MINI.rglob("*") if p.is_file()]
    seen = sum(p.stat().st_size for p in files if p.name == "seen.safetensors")
    assert size(MINI) < 16e6
    assert seen < 5e5  # digests of the images that the encoders were shown
    assert {p.suffix for p in files} <= {".json", ".md", ".png", ".safetensors"}
    for place in ("encoders/clip", "encoders/tactile", "autoencoder", "generator/unet"):
        assert {v.dtype for v in weights(MINI / place).values() if v.is_floating_point()} == {
            torch.float16
        }


def test_what_ships_loads_and_answers_without_a_network(no_network):
    encoders = EncoderSet.load("palpate/mini")
    pipeline = TactilePipeline.from_pretrained("palpate/mini")
    assert encoders.digest("vision") == pipeline.encoders.digest("vision")
    assert "synthetic" in pipeline.notice
    made = arrays(pipeline(photos(1), steps=2))
    assert made.shape == (1, pipeline.size, pipeline.size, 3)
    assert made.std() > 0
    assert no_network == []


@pytest.mark.parametrize("place", sorted(set(PARTS.values())))
def test_the_cards_of_what_ships_are_whole_and_current(place):
    about = json.loads((MINI / place / "palpate.json").read_text())
    card = about.get("card", about.get("training"))
    assert {"title", "summary", "data", "scores", "recipe", "limits"} <= set(card)
    assert (MINI / place / "README.md").read_text() == model_card(about)
    assert "900" in json.dumps(card["data"])  # seeds that no experiment uses


@pytest.mark.nightly
def test_a_fresh_process_with_the_hub_switched_off(tmp_path):
    code = (
        "import socket\n"
        "def no(*a, **k): raise SystemExit('the network was requested')\n"
        "socket.getaddrinfo = socket.create_connection = socket.socket.connect = no\n"
        "import palpate as pp\n"
        "pp.TactilePipeline.from_pretrained('palpate/mini')\n"
        "pp.Encoder.from_pretrained('palpate/mini', modality='text')\n"
    )
    env = {k: v for k, v in os.environ.items() if not k.startswith("HF_")}
    where = {"env": env | {"HF_HOME": str(tmp_path)}, "cwd": tmp_path}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, **where)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("half", [False, True])
def test_equal_encoders_are_equal_files(half, tmp_path):
    made = make_encoders()
    made.save(tmp_path / "a", half=half)
    loaded = EncoderSet.load(tmp_path / "a")
    loaded.name = made.name
    loaded.encode("text", ["a rough wall", "a soft cloth"])  # using it changes nothing
    loaded.save(tmp_path / "b", half=half)
    assert digest_folder(tmp_path / "a") == digest_folder(tmp_path / "b")
    config = json.loads((tmp_path / "a" / "clip" / "config.json").read_text())
    kinds = {part["dtype"] for part in (config, config["text_config"], config["vision_config"])}
    assert kinds == {"float16" if half else "float32"}
    # 16 bits on disk, saved in 32: nothing of where it came from is left.
    other = EncoderSet.load(tmp_path / "b")
    other.name = made.name
    other.save(tmp_path / "c")
    made.save(tmp_path / "d")
    assert digest_folder(tmp_path / "c") == digest_folder(tmp_path / "d")
