"""The VQ autoencoder against a hand-made one; its training, files and latent cache."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import VQModel

from forge.errors import Bomb, fails
from palpate.diffusion.autoencoder import Autoencoder, LatentStats, load_autoencoder, to_bytes
from palpate.diffusion.autoencoder_training import build_autoencoder, fit_autoencoder, k_means
from palpate.diffusion.ceiling import measure_reconstruction
from palpate.diffusion.encoding import encode_latents
from palpate.diffusion.options import AutoencoderOptions
from palpate.encoders.models import digest_tensors, to_unit
from palpate.training.run import TrainingRun

SMALL = AutoencoderOptions(
    patch=4,
    widths=(16,),
    groups=4,
    codes=32,
    steps_free=60,
    steps_quantized=20,
    batch=8,
    crop=8,
    lr=5e-3,
)


def make_images(n: int, size: int = 16, seed: int = 0) -> np.ndarray:
    """Smooth color ramps: easy to compress, all different."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    waves = np.stack([x, y, x * y, np.ones_like(x)], -1)
    return np.clip(waves @ rng.uniform(-120, 120, (n, 1, 4, 3)) + 128, 0, 255).astype(np.uint8)


def random_model(seed: int = 0) -> Autoencoder:
    torch.manual_seed(seed)
    return build_autoencoder(SMALL).eval()


def test_pixels_go_there_and_back():
    images = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), dtype=np.uint8)
    unit = to_unit(images, signed=True)
    assert unit.shape == (3, 3, 8, 8)
    assert unit[1, 2, 3, 4] == pytest.approx(images[1, 3, 4, 2] / 127.5 - 1)
    assert np.array_equal(to_bytes(unit), images)
    assert to_bytes(torch.full((1, 3, 1, 1), 5.0)).max() == 255
    assert torch.equal(to_unit(images), torch.from_numpy(images).permute(0, 3, 1, 2) / 255)


def test_digest_sees_names_shapes_and_values():
    one = {"a": torch.arange(6.0)}
    assert digest_tensors(one) == digest_tensors({"a": torch.arange(6.0)})
    others = [
        {"b": one["a"]},
        {"a": one["a"].reshape(2, 3)},
        {"a": one["a"].double()},
        {"a": one["a"] + 1e-6},
    ]
    assert len({digest_tensors(v) for v in [one, *others]}) == 5


def test_encode_is_before_quantization_and_decode_quantizes():
    model = random_model()
    images = make_images(3)
    z = model.encode(images)
    assert z.shape == (3, 3, 4, 4)
    # By hand: unshuffle patches, run the VQModel's own parts.
    unit = torch.from_numpy(images).permute(0, 3, 1, 2) / 127.5 - 1
    patches = unit.reshape(3, 3, 4, 4, 4, 4).permute(0, 1, 3, 5, 2, 4).reshape(3, 48, 4, 4)
    with torch.no_grad():
        by_hand = model.net.quant_conv(model.net.encoder(patches))
    assert torch.allclose(z, by_hand, atol=1e-6)
    # Quantize by brute force: decoding latents equals decoding their nearest codes.
    codes = model.net.quantize.embedding.weight.detach()
    flat = z.permute(0, 2, 3, 1).reshape(-1, 3)
    nearest = ((flat[:, None] - codes[None]) ** 2).sum(-1).argmin(1)
    snapped = codes[nearest].reshape(3, 4, 4, 3).permute(0, 3, 1, 2)
    # z + (q - z) of the straight-through form is q up to rounding.
    assert np.abs(model.decode(z).astype(int) - model.decode(snapped)).max() <= 1
    with torch.no_grad():
        free = to_bytes(model.image(z, quantize=False)[0])
    assert not np.array_equal(model.decode(z), free)


def test_batches_agree():
    model = random_model()
    images = make_images(7)
    assert torch.allclose(model.encode(images, batch=2), model.encode(images, batch=7), atol=1e-6)
    assert model.encode(images[:0]).shape == (0, 3, 4, 4)
    assert model.decode(torch.zeros(0, 3, 4, 4)).shape == (0, 16, 16, 3)
    fails("multiples of 4", model.encode, np.zeros((1, 18, 16, 3), np.uint8))


def test_saved_model_is_the_same_and_tampering_is_noticed(tmp_path):
    model = random_model()
    model.save(tmp_path / "ae")
    again = load_autoencoder(tmp_path / "ae")
    assert again.digest == model.digest
    assert again.patch == 4
    images = make_images(2)
    assert torch.equal(again.encode(images), model.encode(images))
    assert not any(p.requires_grad for p in again.parameters())
    card = json.loads((tmp_path / "ae" / "palpate.json").read_text())
    card["digest"] = "0" * 64
    (tmp_path / "ae" / "palpate.json").write_text(json.dumps(card))
    fails("must match", load_autoencoder, tmp_path / "ae")


def test_a_plain_vqmodel_folder_loads_with_patch_1(tmp_path):
    torch.manual_seed(0)
    blocks = {
        "down_block_types": ("DownEncoderBlock2D",) * 3,
        "up_block_types": ("UpDecoderBlock2D",) * 3,
    }
    vq = VQModel(
        block_out_channels=(8, 8, 16),
        norm_num_groups=4,
        num_vq_embeddings=16,
        latent_channels=3,
        **blocks,
    )
    vq.save_pretrained(tmp_path / "vq")
    model = load_autoencoder(tmp_path / "vq")
    assert (model.patch, model.factor, model.channels) == (1, 4, 3)
    images = make_images(2)
    with torch.no_grad():
        wanted = vq.eval().encode(to_unit(images, signed=True)).latents
    assert torch.allclose(model.encode(images), wanted, atol=1e-6)


def test_an_old_bin_loads_as_weights_only(tmp_path):
    model = random_model()
    model.save(tmp_path / "vq")
    (tmp_path / "vq" / "diffusion_pytorch_model.safetensors").unlink()
    torch.save(model.net.state_dict(), tmp_path / "vq" / "diffusion_pytorch_model.bin")
    assert load_autoencoder(tmp_path / "vq").digest == model.digest
    torch.save({"x": Bomb()}, tmp_path / "vq" / "diffusion_pytorch_model.bin")
    fails("diffusers VQModel", load_autoencoder, tmp_path / "vq")


def test_other_options_in_the_same_folder_train_anew(tmp_path):
    train = make_images(32)
    short = replace(SMALL, steps_free=5, steps_quantized=5)
    one, other = (TrainingRun(tmp_path / name) for name in "ab")
    fit_autoencoder(train, None, replace(short, lr=1e-3), one)
    second = fit_autoencoder(train, None, short, one)
    assert second.digest == fit_autoencoder(train, None, short, other).digest


def test_k_means_finds_separate_heaps_and_leaves_no_center_unused():
    rng = np.random.default_rng(0)
    middles = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    points = np.concatenate([m + 0.1 * rng.standard_normal((50, 3)) for m in middles])
    centers = k_means(points, 4, np.random.default_rng(1))
    distance = np.linalg.norm(middles[:, None] - centers[None], axis=2)
    assert distance.min(axis=1).max() < 0.2
    many = k_means(points, 60, np.random.default_rng(1))
    used = np.linalg.norm(points[:, None] - many[None], axis=2).argmin(1)
    assert len(np.unique(used)) >= 58


def test_training_learns_and_uses_its_codes(tmp_path):
    train, test = make_images(64), make_images(16, seed=1)
    model = fit_autoencoder(train, None, SMALL, TrainingRun(tmp_path / "a"))
    result = measure_reconstruction(model, test)
    untrained = measure_reconstruction(random_model(), test)
    assert result.psnr > untrained.psnr + 4
    assert len(model.net.quantize(model.encode(test))[2][2].unique()) > 8


def test_latent_statistics_by_hand():
    z = torch.randn(300, 2, 3, 3) * torch.tensor([2.0, 0.5]).reshape(1, 2, 1, 1) + 1
    stats = LatentStats.of(z)
    assert stats.mean == pytest.approx(z.double().mean((0, 2, 3)).tolist(), abs=1e-9)
    assert stats.std == pytest.approx(z.double().std((0, 2, 3), correction=0).tolist(), abs=1e-9)
    normal = stats.normalize(z)
    assert torch.allclose(normal.std((0, 2, 3)), torch.ones(2), atol=1e-3)
    assert torch.allclose(stats.restore(normal), z, atol=1e-5)
    paper = LatentStats.of(z, "one")
    assert paper.std == stats.std
    assert torch.equal(paper.normalize(z), z)


def test_latents_are_encoded_once(tmp_path):
    model = random_model()
    images = make_images(5)
    calls = []

    class Rows(np.ndarray):
        def __getitem__(self, rows):
            calls.append(rows)
            return images[rows]

    rows = images.view(Rows)
    z = encode_latents(model, rows, None, file=tmp_path / "k.npy", batch=2)
    assert torch.allclose(torch.from_numpy(np.array(z)), model.encode(images), atol=1e-6)
    n = len(calls)
    again = encode_latents(model, rows, None, file=tmp_path / "k.npy", batch=2)
    assert len(calls) == n
    assert np.array_equal(z, again)
    encode_latents(model, rows, None, file=tmp_path / "other.npy", batch=2)
    assert len(calls) > n


def test_a_card_that_cannot_be_used_is_reported(tmp_path):
    random_model().save(tmp_path / "ae")
    file = tmp_path / "ae" / "palpate.json"
    about = json.loads(file.read_text())
    cases = [
        ([], "must be a JSON object"),
        ({}, "must have the format palpate-autoencoder/1"),
        (about | {"format": "x"}, "must have the format palpate-autoencoder/1"),
        *(
            ({k: v for k, v in about.items() if k != key}, f"Got no {key}")
            for key in ("patch", "digest", "card")
        ),
        *(
            (about | {"patch": patch}, "must be a whole number from 1")
            for patch in ("x", 4.0, None, 0)
        ),
        (about | {"patch": 2}, "must have 12 channels in and out"),
    ]
    for content, word in cases:
        file.write_text(json.dumps(content))
        fails(word, load_autoencoder, tmp_path / "ae")
    file.write_text(json.dumps(about))
    weights = next((tmp_path / "ae").glob("*.safetensors"))
    weights.write_bytes(weights.read_bytes()[:50])
    fails("must be a diffusers VQModel", load_autoencoder, tmp_path / "ae")
