"""LPIPS against convolutions and sums in NumPy, with random weights in the published formats."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from forge.errors import Bomb, fails
from forge.models import SHAPES, random_states, save_states
from palpate.encoders.perceptual import Lpips, load_lpips, lpips_per_image

STEPS = {0: (4, 2), 3: (1, 2), 6: (1, 1), 8: (1, 1), 10: (1, 1)}


@pytest.fixture(scope="module")
def states():
    return random_states()


@pytest.fixture(scope="module")
def files(states, tmp_path_factory):
    return save_states(states, tmp_path_factory.mktemp("lpips"))


@pytest.fixture(scope="module")
def network(files):
    return load_lpips(*files)


def pairs(n=3, height=40, width=33, channels=3):
    rng = np.random.default_rng(1)
    first = rng.integers(0, 256, (n, height, width, channels)).astype(np.uint8)
    return first, np.clip(first + rng.normal(0, 20, first.shape), 0, 255).astype(np.uint8)


def written_out(state, image):
    """The five stages of one image (3, h, w) in [-1, 1], by windows in float64."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, result = (image - shift[:, None, None]) / scale[:, None, None], []
    for place, (stride, pad) in STEPS.items():
        if place in (3, 6):
            x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(
                axis=(3, 4)
            )
        weight, bias = (
            state[f"features.{place}.{part}"].double().numpy() for part in ("weight", "bias")
        )
        x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
        windows = np.lib.stride_tricks.sliding_window_view(x, weight.shape[2:], axis=(1, 2))[
            :, ::stride, ::stride
        ]
        x = np.maximum(
            np.einsum("chwij,ocij->ohw", windows, weight, optimize=True) + bias[:, None, None], 0
        )
        result.append(x / (np.sqrt((x**2).sum(axis=0)) + 1e-10))
    return result


@pytest.mark.parametrize("size", [(32, 32), (40, 33)])
def test_the_distance_is_the_published_formula(states, network, size):
    first, second = pairs(2, *size)
    result = lpips_per_image(first, second, network)
    assert result.dtype == np.float64
    for k in range(2):
        stages = [
            written_out(states[0], v[k].transpose(2, 0, 1) / 127.5 - 1) for v in (first, second)
        ]
        weights = [states[1][f"lin{i}.model.1.weight"].double().numpy()[0] for i in range(5)]
        expect = sum(
            (w * (a - b) ** 2).sum(axis=0).mean() for a, b, w in zip(*stages, weights, strict=True)
        )
        assert result[k] == pytest.approx(expect, rel=1e-5)


def test_identical_images_are_at_0_and_the_distance_is_symmetric_and_grows(network):
    first, second = pairs()
    assert (lpips_per_image(first, first, network) == 0).all()
    forth, back = lpips_per_image(first, second, network), lpips_per_image(second, first, network)
    np.testing.assert_allclose(forth, back, rtol=1e-6)
    assert (forth > 0).all()
    far = np.random.default_rng(2).integers(0, 256, first.shape).astype(np.uint8)
    assert (lpips_per_image(first, far, network) > forth).all()


def test_values_do_not_depend_on_batches_or_on_how_pixels_are_written(network):
    first, second = pairs(5)
    result = lpips_per_image(first, second, network)
    np.testing.assert_allclose(lpips_per_image(first, second, network, batch=2), result, rtol=1e-5)
    np.testing.assert_allclose(lpips_per_image(first / 255, second, network), result, rtol=1e-5)
    gray = [v[..., :1] for v in (first, second)]
    np.testing.assert_allclose(
        lpips_per_image(*gray, network),
        lpips_per_image(*(v.repeat(3, axis=3) for v in gray), network),
        rtol=1e-5,
    )
    calls = []
    lpips_per_image(
        first[::-1], second[::-1], network, batch=2, progress=lambda *a, **_: calls.append(a[1:3])
    )
    assert calls == [(2, 5), (4, 5), (5, 5)]


def test_the_network_can_be_trained_through(network):
    first, second = (torch.rand(2, 3, 32, 32, requires_grad=True) for _ in range(2))
    network(first * 2 - 1, second * 2 - 1).sum().backward()
    assert first.grad is not None
    assert bool(torch.isfinite(first.grad).all())


def test_the_digest_is_that_of_the_weights_used(files, states, network, tmp_path):
    backbone = {name: value for name, value in states[0].items() if "classifier" not in name}
    save_file(backbone, tmp_path / "backbone.safetensors")
    save_file(states[1], tmp_path / "heads.safetensors")
    same = load_lpips(tmp_path / "backbone.safetensors", tmp_path / "heads.safetensors")
    assert same.digest == network.digest
    name = "lin4.model.1.weight"
    torch.save(states[1] | {name: states[1][name] * 2}, tmp_path / "other.pth")
    assert load_lpips(files[0], tmp_path / "other.pth").digest != network.digest


def test_files_are_rejected_by_name_and_never_unpickled(files, states, tmp_path):
    torch.save({"features.0.weight": Bomb()}, tmp_path / "bomb.pth")
    (tmp_path / "cut.pth").write_bytes(files[1].read_bytes()[:200])
    (tmp_path / "text.safetensors").write_text("no weights")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save(states[1] | {"lin2.model.1.weight": torch.ones(1, 256, 1, 1)}, tmp_path / "vgg.pth")
    both = "alexnet-owt-7be5be79.pth.*alex.pth"
    for backbone, heads, words in (
        ("nothing.pth", "none.pth", f"Got no .*nothing.pth, no .*none.pth. .*{both}"),
        (files[0], "bomb.pth", f"bomb.pth must hold weights and nothing else.*{both}"),
        (files[0], "cut.pth", f"cut.pth must hold weights and nothing else.*{both}"),
        (files[0], "text.safetensors", f"safetensors must hold weights and nothing else.*{both}"),
        (files[0], "list.pth", r"weights and nothing else\. Got list"),
        (files[1], files[0], r"weights of AlexNet and of LPIPS\. Got 'features\.0\.weight'"),
        (files[0], "vgg.pth", r"the weights of AlexNet and of LPIPS.*\[1, 256, 1, 1\]"),
    ):
        fails(words, load_lpips, tmp_path / backbone, tmp_path / heads)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda x: x[0], "must have shape"),
        (lambda x: x[:0], "must have shape"),
        (lambda x: x.astype(np.int32), "uint8, or floats"),
        (lambda x: x * 1.0, r"floats in \[0, 1\].*image 0"),
        (
            lambda x: np.where(np.arange(3)[:, None, None, None] == 2, np.nan, x / 255),
            r"\[nan, nan\] in image 2",
        ),
        (lambda x: x[:2], "must pair one to one in one size"),
    ],
)
def test_bad_images_are_rejected(network, change, match):
    first, second = pairs()
    fails(match, lpips_per_image, first, change(second), network)
    fails(r"at least 32 x 32 for LPIPS\. Got 32 x 31", lpips_per_image, *pairs(2, 32, 31), network)


def test_the_layout_is_torchvisions():
    shapes = [tuple(stage.weight.shape) for stage in Lpips().stages]
    assert shapes == list(SHAPES.values())
