"""Files in the published formats of LPIPS with random weights, as the tests write them."""

from pathlib import Path

import torch

SHAPES = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


def random_states() -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Weights of backbone and heads by the names that torchvision and LPIPS v0.1 give them."""
    draw = torch.Generator().manual_seed(0)
    backbone = {"classifier.1.weight": torch.zeros(2, 2)}
    heads = {}
    for k, (place, shape) in enumerate(SHAPES.items()):
        fan = shape[1] * shape[2] * shape[3]
        backbone[f"features.{place}.weight"] = torch.randn(shape, generator=draw) * (2 / fan) ** 0.5
        backbone[f"features.{place}.bias"] = 0.1 * torch.randn(shape[0], generator=draw)
        heads[f"lin{k}.model.1.weight"] = torch.rand((1, shape[0], 1, 1), generator=draw)
    return backbone, heads


def save_states(
    states: tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]], folder: Path
) -> tuple[Path, Path]:
    """Backbone and heads as files."""
    places = folder / "alexnet-owt-7be5be79.pth", folder / "alex.pth"
    torch.save(states[0], places[0])
    torch.save(
        states[1], places[1], _use_new_zipfile_serialization=False
    )  # the published file is of the old format
    return places
