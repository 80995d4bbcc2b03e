"""Inception from a local TorchScript file; its digest."""

import pickle
from functools import partial

import numpy as np
import pytest
import torch

from forge.errors import Bomb, fails
from palpate.core import FeatureSet, PalpateError
from palpate.encoders import inception

load_inception = partial(inception.load_inception, trust_torchscript=True)


def embed(images, path, **options):
    encoder = load_inception(path)
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
    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return img.to(torch.float64).mean(dim=[2, 3])


class Flat(torch.nn.Module):
    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return img.to(torch.float32).mean()


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
    result, digest = embed(images, path, batch=3)
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
    np.testing.assert_allclose(embed(images, path, batch=64)[0], result, atol=1e-6)
    assert len(digest) == 64
    FeatureSet([str(i) for i in range(7)], result, encoder=digest)


def test_the_digest_is_that_of_the_weights(tmp_path, images):
    torch.manual_seed(2)
    one = script(Pooled(), tmp_path / "one.pt")
    same = tmp_path / "renamed.pt"
    same.write_bytes(one.read_bytes())
    torch.manual_seed(3)
    other = script(Pooled(), tmp_path / "other.pt")
    assert load_inception(one).digest == load_inception(same).digest != load_inception(other).digest


def test_files_that_are_no_torchscript_are_rejected_and_never_unpickled(tmp_path):
    with pytest.raises(
        PalpateError, match=r"absent\.pt must be a file.*2015-12-05\.pt .*https://nv"
    ):
        load_inception(tmp_path / "absent.pt")
    (tmp_path / "inception-v3.pkl").write_bytes(pickle.dumps(Bomb()))
    torch.save({"weight": torch.ones(2)}, tmp_path / "state.pth")
    torch.save(Bomb(), tmp_path / "bomb.pth")
    (tmp_path / "empty.pt").write_bytes(b"")
    for name in ("inception-v3.pkl", "state.pth", "bomb.pth", "empty.pt"):
        words = f"{name} must be a TorchScript module.*pickles are never loaded"
        fails(words, load_inception, tmp_path / name)


def test_modules_without_features_and_other_images_are_rejected(tmp_path, images):
    flat, pooled, plain = (
        script(module, tmp_path / f"{k}.pt") for k, module in enumerate((Flat(), Pooled(), Plain()))
    )
    rgb = r"uint8 of shape \(n, h, w, 3\)"
    for path, bad, words in (
        (flat, images, r"must map 7 uint8 images to floats \(7, d\). Got Tensor of shape \(\)"),
        (pooled, images[:, :2, :2], "must map 7 uint8 images"),  # smaller than its window
        (plain, images / 255, rgb),
        (plain, images[0], rgb),
        (plain, images[..., :1], rgb),
    ):
        fails(words, embed, bad, path)


def test_progress_and_mapped_files(tmp_path, images):
    np.save(tmp_path / "images.npy", images)
    calls = []
    mapped = np.load(tmp_path / "images.npy", mmap_mode="r")
    path = script(Plain(), tmp_path / "plain.pt")
    result, _ = embed(mapped, path, batch=3, progress=lambda *a, **_: calls.append(a[1:3]))
    np.testing.assert_allclose(result, images.mean(axis=(1, 2)), rtol=1e-6)
    assert calls == [(3, 7), (6, 7), (7, 7)]
