"""A local vision-language model: a tiny one, made here from a configuration (62,000 parameters)."""

import json

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
MARKS = ["<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>", "<pad>"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A folder with an Idefics3 model of random weights and its processor."""
    import torch
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import Idefics3Config, Idefics3ForConditionalGeneration, Idefics3Processor
    from transformers.models.idefics3.image_processing_pil_idefics3 import Idefics3ImageProcessorPil

    torch.manual_seed(0)
    bytes_of = Tokenizer(models.BPE())
    bytes_of.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bytes_of.decoder = decoders.ByteLevel()
    rows = [f"<row_{r}_col_{c}>" for r in range(1, 7) for c in range(1, 7)]
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(special_tokens=[*MARKS, *rows], initial_alphabet=alphabet)
    bytes_of.train_from_iterator(["rough, hard"], trainer)
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=bytes_of,
        pad_token="<pad>",
        eos_token="<end_of_utterance>",
        additional_special_tokens=MARKS,
    )
    vision = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 56,
        "patch_size": 14,
    }
    text = {
        "model_type": "llama",
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "num_key_value_heads": 2,
        "vocab_size": len(tokenizer),
        "max_position_embeddings": 4096,
        "pad_token_id": tokenizer.pad_token_id,
    }
    config = Idefics3Config(
        vision_config=vision,
        text_config=text,
        scale_factor=2,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        pad_token_id=tokenizer.pad_token_id,
    )
    images = Idefics3ImageProcessorPil(
        size={"longest_edge": 56}, max_image_size={"longest_edge": 56}, do_image_splitting=False
    )
    processor = Idefics3Processor(images, tokenizer, image_seq_len=4, chat_template=CHAT)
    folder = tmp_path_factory.mktemp("vlm")
    Idefics3ForConditionalGeneration(config).save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


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
