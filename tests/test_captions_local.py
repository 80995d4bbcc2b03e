"""A local vision-language model: a tiny one, made here from a configuration (62,000 parameters)."""

import json
import sys
from dataclasses import replace

import pytest

from palpate.captions import caption
from palpate.cli import main
from palpate.core import PalpateError

pytestmark = pytest.mark.slow
transformers = pytest.importorskip("transformers", reason="the extra torch is not installed")

BOX = (0.25, 0.25, 0.75, 0.75)
CHAT = (
    "{% for m in messages %}{{ m['role'] }}: {% for c in m['content'] %}"
    "{% if c['type'] == 'image' %}<image>{% else %}{{ c['text'] }}{% endif %}{% endfor %}\n"
    "{% endfor %}{% if add_generation_prompt %}assistant: {% endif %}"
)

SMALL = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
}
VISION = SMALL | {"image_size": 56, "patch_size": 14}
TEXT = SMALL | {"num_key_value_heads": 2, "max_position_embeddings": 4096}
SQUARE = {"height": 56, "width": 56}


def tokens(*marks, **named):
    """A tokenizer of bytes and special tokens."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

    bytes_of = Tokenizer(models.BPE())
    bytes_of.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bytes_of.decoder = decoders.ByteLevel()
    special = ["<pad>", "<eos>", "<bos>", *marks]
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(special_tokens=special, initial_alphabet=alphabet)
    bytes_of.train_from_iterator(["rough, hard"], trainer)
    ends = {"pad_token": "<pad>", "eos_token": "<eos>", "bos_token": "<bos>"}
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=bytes_of, additional_special_tokens=list(marks), **ends, **named
    )


def idefics3():
    """62,000 parameters."""
    from transformers.models.idefics3.image_processing_pil_idefics3 import Idefics3ImageProcessorPil

    rows = [f"<row_{r}_col_{c}>" for r in range(1, 7) for c in range(1, 7)]
    marks = ["<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>"]
    words = tokens(*marks, *rows)
    config = transformers.Idefics3Config(
        vision_config=VISION,
        text_config=TEXT | {"model_type": "llama", "vocab_size": len(words), "pad_token_id": 0},
        scale_factor=2,
        image_token_id=words.convert_tokens_to_ids("<image>"),
        pad_token_id=0,
    )
    longest = {"longest_edge": 56}
    images = Idefics3ImageProcessorPil(
        size=longest, max_image_size=longest, do_image_splitting=False
    )
    processor = transformers.Idefics3Processor(images, words, image_seq_len=4, chat_template=CHAT)
    return transformers.Idefics3ForConditionalGeneration(config), processor


def llava():
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    words = tokens("<image>")
    config = transformers.LlavaConfig(
        vision_config=VISION | {"model_type": "clip_vision_model", "projection_dim": 32},
        text_config=TEXT | {"model_type": "llama", "vocab_size": len(words)},
        image_token_index=words.convert_tokens_to_ids("<image>"),
    )
    processor = transformers.LlavaProcessor(
        CLIPImageProcessorPil(size={"shortest_edge": 56}, crop_size=SQUARE),
        words,
        patch_size=14,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template=CHAT,
    )
    return transformers.LlavaForConditionalGeneration(config), processor


def paligemma():
    """It has no chat template."""
    from transformers.models.siglip.image_processing_pil_siglip import SiglipImageProcessorPil

    words = tokens("<image>")
    images = SiglipImageProcessorPil(size=SQUARE)
    images.image_seq_length = 16
    processor = transformers.PaliGemmaProcessor(images, words)
    config = transformers.PaliGemmaConfig(
        vision_config=VISION | {"model_type": "siglip_vision_model", "vision_use_head": False},
        text_config=TEXT | {"model_type": "gemma", "head_dim": 16, "vocab_size": len(words)},
        image_token_index=processor.image_token_id,
        projection_dim=32,
    )
    return transformers.PaliGemmaForConditionalGeneration(config), processor


def gemma3():
    from transformers.models.gemma3.image_processing_pil_gemma3 import Gemma3ImageProcessorPil

    names = {"image_token": "<image_soft_token>", "boi_token": "<image>", "eoi_token": "<end>"}
    words = tokens(*names.values(), extra_special_tokens=names)
    ids = {f"{name}_index": words.convert_tokens_to_ids(mark) for name, mark in names.items()}
    config = transformers.Gemma3Config(
        vision_config=VISION | {"model_type": "siglip_vision_model", "vision_use_head": False},
        text_config=TEXT | {"model_type": "gemma3_text", "head_dim": 16, "vocab_size": len(words)},
        mm_tokens_per_image=4,
        **ids,
    )
    images = Gemma3ImageProcessorPil(size=SQUARE)
    processor = transformers.Gemma3Processor(images, words, chat_template=CHAT, image_seq_length=4)
    return transformers.Gemma3ForConditionalGeneration(config), processor


def saved(make, folder):
    """A folder with a model of random weights and its processor."""
    import torch

    torch.manual_seed(0)
    for part in make():
        part.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return saved(idefics3, tmp_path_factory.mktemp("vlm"))


@pytest.mark.parametrize("make", [idefics3, llava, paligemma, gemma3])
@pytest.mark.parametrize("crop", [None, BOX])
def test_families_whose_processor_needs_no_torchvision(
    make, crop, small_manifest, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    first = replace(small_manifest, table=small_manifest.table.head(4))
    options = {"local": str(saved(make, tmp_path / "vlm")), "max_tokens": 2, "crop": crop}
    result = caption(first, tmp_path / "c", **options)
    assert (result.record["replies"], result.problems) == (1, [])
    assert result.record["tokens"]["out"] > 2


def test_what_a_random_model_says_is_flagged_and_kept(model, small_manifest, tmp_path):
    result = caption(small_manifest, tmp_path / "c", local=str(model), max_tokens=4)
    counts = result.record["counts"]
    assert counts["photos"] == 12
    assert counts["texts"] == 0
    assert set(counts["flags"]) <= {"truncated", "invalid"}
    replies = (tmp_path / "c" / "replies.jsonl").read_text().splitlines()
    unused = [json.loads(reply)["unused"] for reply in replies]
    assert [why is None for why in unused] == [False, False, True] * 12, "three tries each"
    assert result.record["model"].startswith(f"{model}@")
    again = caption(small_manifest, tmp_path / "c", local=str(model), max_tokens=4)
    assert (tmp_path / "c" / "replies.jsonl").read_text().splitlines() == replies
    assert again.record["digest"] == result.record["digest"]


def test_a_local_reply_becomes_a_caption(model, small_manifest, tmp_path, monkeypatch):
    """The loop from photo to table, with the decoder's words replaced."""
    answer = '{"adjectives": ["rough", "dry", "hard"], "surface_visible": true}'
    monkeypatch.setattr(transformers.Idefics3Processor, "decode", lambda *a, **k: answer)
    result = caption(small_manifest, tmp_path / "c", local=str(model), max_tokens=3, crop=BOX)
    assert set(result.table["text"]) == {"rough, dry, hard"}
    assert result.record["tokens"]["out"] == 12 * 3


@pytest.mark.parametrize(("failing", "status"), [(2, 1), (99, 2)])
def test_what_breaks_in_generate_costs_a_photo_or_ends_the_run_in_one_line(
    model, small_manifest, tmp_path, monkeypatch, capsys, failing, status
):
    calls, generate = iter(range(999)), transformers.Idefics3ForConditionalGeneration.generate

    def breaks(self, **options):
        if next(calls) < failing:
            raise RuntimeError("CUDA out of memory.\nTried to allocate 20 MiB")
        return generate(self, **options)

    monkeypatch.setattr(transformers.Idefics3ForConditionalGeneration, "generate", breaks)
    answer = '{"adjectives": ["rough", "dry", "hard"], "surface_visible": true}'
    monkeypatch.setattr(transformers.Idefics3Processor, "decode", lambda *a, **k: answer)
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    args = ["caption", tmp_path / "tag", "-o", tmp_path / "c", "--local", model]
    assert main([*map(str, args), "--max-tokens", "3", "-q"]) == status
    output = capsys.readouterr()
    if status == 1:
        assert "Without a caption: 2" in output.out
        assert main([*map(str, args), "--max-tokens", "3", "-q"]) == 0, "the same command goes on"
    else:
        assert "Traceback" not in output.err
        assert "RuntimeError CUDA out of memory. Tried" in output.err.splitlines()[-1]


@pytest.mark.parametrize("kind", ["nothing", "another model", "text"])
def test_a_folder_without_such_a_model(small_manifest, tmp_path, kind):
    folder = tmp_path / kind
    folder.mkdir()
    if kind == "another model":
        (folder / "config.json").write_text('{"model_type": "bert"}')
    if kind == "text":
        (folder / "config.json").write_text("hello")
    with pytest.raises(PalpateError, match="without torchvision") as caught:
        caption(small_manifest, tmp_path / "c", local=str(folder))
    assert caught.value.argument == "local"
    assert "serve this one" in caught.value.fix
