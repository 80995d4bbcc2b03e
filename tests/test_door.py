"""The public face of palpate: its names, their signatures, and what importing it costs."""

import inspect
import pkgutil
from pathlib import Path

import pytest

import palpate as pp

TOP = Path(__file__).resolve().parents[1]
#: Public function -> its parameters in order; keywords behind the star.
SIGNATURES = {
    "audit": (
        "train_or_data test * split pretrain by near_frames identity images modalities "
        "false_positives impact name cache root reading "
        "skip_bad progress encoder allow_seen"
    ),
    "caption": (
        "data output * server model template prompt per concurrency timeout max_tokens seed body "
        "dry_run progress"
    ),
    "generate": (
        "photos * text weight gel at area strength shear force depth profile like model output "
        "split part seed guidance steps batch skip_bad strict dry_run device slice progress"
    ),
    "load": "source * format images skip_bad progress **options",
    "probe": (
        "data split * encoder against modality label group top pool text_threshold seed "
        "allow_seen cache progress"
    ),
    "score": (
        "generated reference * encoder check_ruler split names labels group background train "
        "presets sigma normalize companions controls inception clip dinov2 lpips "
        "trust_torchscript permutations seed allow_seen as_is cache progress"
    ),
    "split": ("data * by train val seed folds near noleak cache reading skip_bad progress"),
    "train_encoder": ("data split * preset clip output epochs seed device compute progress"),
    "train_autoencoder": "data split * preset start judge output seed device compute progress",
    "train_generator": (
        "data split clip * preset autoencoder start output background"
        " judge steps seed device compute progress"
    ),
    "validate": "source * format check progress **options",
    "Encoder.from_pretrained": "source * modality device revision",
    "Encoder.encode": "self inputs * backgrounds batch progress",
    "TactilePipeline.from_pretrained": "source * device revision",
    "TactilePipeline.__call__": (
        "self image prompt * num_inference_steps guidance_scale generator output_type"
        " num_images_per_prompt **options"
    ),
    "World.__init__": "self options * cache",
    "Manifest.load": "path root",
    "Split.from_ids": "* rule manifest **parts",
}


def parameters(function):
    shown = []
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in shown:
            shown.append("*")
        prefix = {parameter.VAR_KEYWORD: "**", parameter.VAR_POSITIONAL: "*"}.get(
            parameter.kind, ""
        )
        shown.append(prefix + parameter.name)
    return " ".join(shown)


def test_public_names():
    assert pp.__all__ == sorted(pp.__all__, key=lambda name: (name.islower(), name))
    assert set(pp.__all__) | {"__version__"} == set(dir(pp))
    for name in pp.__all__:
        value = getattr(pp, name)
        assert value.__doc__, name
        assert getattr(pp, name) is value
    with pytest.raises(AttributeError, match="no attribute 'tower'"):
        pp.tower  # noqa: B018
    rooms = {module.name for module in pkgutil.iter_modules(pp.__path__)}
    assert not rooms & set(pp.__all__)


@pytest.mark.parametrize("name", SIGNATURES)
def test_public_signatures(name):
    function = pp
    for part in name.split("."):
        function = getattr(function, part)
    assert parameters(function) == SIGNATURES[name]
