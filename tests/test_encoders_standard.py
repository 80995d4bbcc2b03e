"""Standard encoders from local weights: TorchScript modules and CLIP folders; digests."""

import json
import pickle

import numpy as np
import pytest
import torch
from PIL import Image
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from palpate.core import FeatureSet, PalpateError, digest_file
from palpate.encoders.contrastive import new_clip
from palpate.encoders.embed import embed_images
from palpate.encoders.encoder_set import EncoderSet, Preprocess
from palpate.encoders.presets import preset
from palpate.encoders.standard import load_standard


def embed_standard(images, source, *, kind="inception", **options):
    encoder = load_standard(source, kind=kind)
    return encoder.embed(images, **options), encoder.digest


class Pooled(torch.nn.Module):
    """As the published file: logits, or with a keyword the pooled features of uint8 images."""

    def __init__(self, width: int = 5):
        super().__init__()
        self.conv = torch.nn.Conv2d(3, width, 3)
        self.out = torch.nn.Linear(width, 11)

    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        x = self.conv(img.to(torch.float32) / 127.5 - 1).relu().mean(dim=[2, 3])
        return x if return_features else self.out(x)


class Plain(torch.nn.Module):
    def forward(self, img: torch.Tensor) -> torch.Tensor:
        return img.to(torch.float64).mean(dim=[2, 3], keepdim=True)


class Flat(torch.nn.Module):
    def forward(self, img: torch.Tensor) -> torch.Tensor:
        return img.to(torch.float32).mean()


class Broken(torch.nn.Module):
    def forward(self, img: torch.Tensor) -> torch.Tensor:
        return img.to(torch.float32).mean(dim=[2, 3]).log()


def script(module, path):
    torch.manual_seed(0)
    torch.jit.script(module.eval()).save(str(path))
    return path


@pytest.fixture
def images():
    return np.random.default_rng(0).integers(0, 256, (7, 20, 24, 3)).astype(np.uint8)


def test_inception_features_are_those_of_the_module_called_for_features(tmp_path, images):
    torch.manual_seed(1)
    module = Pooled().eval()
    path = script(module, tmp_path / "inception.pt")
    result, digest = embed_standard(images, path, batch=3)
    # An independent convolution: windows and sums in float64.
    weight, bias = (
        p.detach().numpy().astype(np.float64) for p in (module.conv.weight, module.conv.bias)
    )
    windows = np.lib.stride_tricks.sliding_window_view(images / 127.5 - 1, (3, 3), axis=(1, 2))
    expect = np.maximum(
        np.einsum("nhwcij,ocij->nohw", windows, weight) + bias[:, None, None], 0
    ).mean(axis=(2, 3))
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, expect, atol=1e-6)
    np.testing.assert_allclose(embed_standard(images, path, batch=64)[0], result, atol=1e-6)
    assert len(digest) == 64
    FeatureSet([str(i) for i in range(7)], result, encoder=digest)


def test_a_module_without_the_keyword_and_with_maps_of_one_pixel_is_taken(tmp_path, images):
    result, _ = embed_standard(images, script(Plain(), tmp_path / "plain.pt"))
    np.testing.assert_allclose(result, images.mean(axis=(1, 2)), rtol=1e-6)
    traced = tmp_path / "traced.pt"
    torch.jit.trace(Plain(), torch.zeros(2, 3, 8, 8, dtype=torch.uint8)).save(str(traced))
    np.testing.assert_allclose(embed_standard(images, traced)[0], result, rtol=1e-6)


def test_the_digest_is_that_of_the_weights(tmp_path, images):
    torch.manual_seed(2)
    one = script(Pooled(), tmp_path / "one.pt")
    same = tmp_path / "renamed.pt"
    same.write_bytes(one.read_bytes())
    torch.manual_seed(3)
    other = script(Pooled(), tmp_path / "other.pt")
    assert load_standard(one).digest == load_standard(same).digest != load_standard(other).digest


def test_a_known_digest_is_compared_before_the_file_is_opened(tmp_path, monkeypatch):
    path = script(Plain(), tmp_path / "plain.pt")
    full = digest_file(path)
    assert (
        load_standard(path, sha256=full).digest
        == load_standard(path, sha256=full[:8].upper()).digest
    )
    monkeypatch.setattr(torch.jit, "load", lambda *_, **__: pytest.fail("opened"))
    for wrong in ("0" * 64, full[:7], ""):
        with pytest.raises(PalpateError, match="must have the SHA-256"):
            load_standard(path, sha256=wrong)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


def test_files_that_are_no_torchscript_are_rejected_and_never_unpickled(tmp_path):
    with pytest.raises(
        PalpateError, match=r"absent\.pt must be a file.*inception-2015-12-05\.pt .*https://nvlabs"
    ):
        load_standard(tmp_path / "absent.pt")
    with open(tmp_path / "inception-v3.pkl", "wb") as file:
        pickle.dump(Bomb(), file)
    torch.save({"weight": torch.ones(2)}, tmp_path / "state.pth")
    torch.save(Bomb(), tmp_path / "bomb.pth")
    (tmp_path / "empty.pt").write_bytes(b"")
    for name in ("inception-v3.pkl", "state.pth", "bomb.pth", "empty.pt"):
        with pytest.raises(
            PalpateError, match=f"{name} must be a TorchScript module.*pickles are never loaded"
        ):
            load_standard(tmp_path / name)


def test_modules_that_give_no_features_are_rejected(tmp_path, images):
    with pytest.raises(
        PalpateError, match=r"must map 7 uint8 images to floats \(7, d\). Got Tensor of shape \(\)"
    ):
        embed_standard(images, script(Flat(), tmp_path / "flat.pt"))
    black = images.copy()
    black[4] = 0
    with pytest.raises(PalpateError, match="NaN or infinity for 1 of 7 images, first 4"):
        embed_standard(black, script(Broken(), tmp_path / "broken.pt"))
    with pytest.raises(PalpateError, match="must map 7 uint8 images"):
        embed_standard(
            images[:, :2, :2], script(Pooled(), tmp_path / "pooled.pt")
        )  # smaller than its window


@pytest.fixture
def clip(tmp_path):
    clip = new_clip(preset("tiny"), ["a red cloth", "a gray stone"], 0)
    clip.save(tmp_path / "clip")
    return tmp_path / "clip", clip


def test_clip_is_the_same_encoder_as_ours_with_the_same_digest(clip, images):
    folder, ours = clip
    for source in (folder, str(folder)):
        result, digest = embed_standard(images, source, kind="clip", batch=2)
        np.testing.assert_allclose(
            result, embed_images(images, EncoderSet(ours), "vision"), atol=1e-6
        )
        assert digest == ours.digest("vision")
    np.testing.assert_allclose(np.linalg.norm(result, axis=1), 1, atol=1e-6)


def test_clip_sees_the_center_square_by_the_bicubic_filter(clip):
    folder, ours = clip
    size = ours.preprocess.size
    wide = np.random.default_rng(1).integers(0, 256, (2, 50, 90, 3)).astype(np.uint8)
    square = np.stack(
        [
            np.asarray(
                Image.fromarray(x)
                .crop((20, 0, 70, 50))
                .resize((size, size), Image.Resampling.BICUBIC)
            )
            for x in wide
        ]
    )
    np.testing.assert_allclose(
        embed_standard(wide, folder, kind="clip")[0],
        embed_standard(square, folder, kind="clip")[0],
        atol=1e-6,
    )


def test_a_folder_of_the_vision_encoder_alone_and_the_shipped_name(tmp_path, images):
    torch.manual_seed(4)
    config = CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=16,
        patch_size=8,
        projection_dim=6,
    )
    model = CLIPVisionModelWithProjection(config).eval()
    model.save_pretrained(tmp_path / "vision")
    (tmp_path / "vision" / "preprocessor_config.json").write_text(
        json.dumps(Preprocess(16, 16).to_config())
    )
    result, _ = embed_standard(images, tmp_path / "vision", kind="clip")
    pre = Preprocess(16, 16)
    pixels = torch.tensor(pre.fit(images)).permute(0, 3, 1, 2) / 255
    pixels = (pixels - torch.tensor(pre.mean).view(3, 1, 1)) / torch.tensor(pre.std).view(3, 1, 1)
    with torch.no_grad():
        states = model.visual_projection(
            model.vision_model(pixel_values=pixels).pooler_output
        ).numpy()
    np.testing.assert_allclose(
        result, states / np.linalg.norm(states, axis=1, keepdims=True), atol=1e-6
    )
    mini, digest = embed_standard(images, "palpate/mini", kind="clip")
    assert mini.shape[0] == 7
    assert digest == EncoderSet.load("palpate/mini").digest("vision")


def test_clip_folders_that_lack_files_are_rejected_by_name(tmp_path, clip, images):
    with pytest.raises(
        PalpateError, match=r"no folder .*nowhere\. .*hf download openai/clip-vit-large"
    ):
        load_standard(tmp_path / "nowhere", kind="clip")
    folder, _ = clip
    (folder / "preprocessor_config.json").rename(folder / "away.json")
    with pytest.raises(PalpateError, match=r"Got no preprocessor_config.json"):
        load_standard(folder, kind="clip")
    (folder / "away.json").rename(folder / "preprocessor_config.json")
    weights = folder / "model.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PalpateError, match="must be a CLIP with a vision encoder"):
        load_standard(folder, kind="clip")
    weights.write_bytes(whole)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"model_type": "bert"}))
    with pytest.raises(PalpateError, match=r"must describe a CLIP. Got model_type 'bert'"):
        load_standard(folder, kind="clip")
    (folder / "config.json").write_text(json.dumps(config | {"projection_dim": 3}))
    with pytest.raises(PalpateError, match="must be a CLIP with a vision encoder"):
        load_standard(folder, kind="clip")


def test_bad_arguments_are_rejected(tmp_path, images):
    path = script(Plain(), tmp_path / "plain.pt")
    with pytest.raises(PalpateError, match="must be one of inception, clip"):
        embed_standard(images, path, kind="vgg")
    with pytest.raises(PalpateError, match="`sha256` must go with a TorchScript file"):
        load_standard("palpate/mini", kind="clip", sha256="0" * 64)
    for bad in (images / 255, images[0], images[..., :1]):
        with pytest.raises(PalpateError, match=r"uint8 of shape \(n, h, w, 3\)"):
            embed_standard(bad, path)
    with pytest.raises(PalpateError, match="`batch` must be at least 1"):
        embed_standard(images, path, batch=0)


def test_progress_and_mapped_files(tmp_path, images):
    np.save(tmp_path / "images.npy", images)
    calls = []
    mapped = np.load(tmp_path / "images.npy", mmap_mode="r")
    path = script(Plain(), tmp_path / "plain.pt")
    result, _ = embed_standard(mapped, path, batch=3, progress=lambda *a, **_: calls.append(a[1:3]))
    np.testing.assert_allclose(result, images.mean(axis=(1, 2)), rtol=1e-6)
    assert calls == [(3, 7), (6, 7), (7, 7)]
