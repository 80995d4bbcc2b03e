"""A small tokenizer for a fresh CLIP: byte-level BPE on lower-cased text.

A text becomes ``<|startoftext|> pieces <|endoftext|>``, padded with ``<pad>``. Every byte is in the
alphabet, so no text is unknown. CLIP pools the state at the *first* end-of-text token, and
transformers reads the legacy id 2 as "take the largest id": the ids here are 0 pad, 1 start, 2
unknown (never produced), 3 end, so that the pooling is by equality.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tokenizers import (
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    processors,
    trainers,
)
from transformers import PreTrainedTokenizerFast

from palpate.core import require

PAD, START, UNKNOWN, END = SPECIAL = ("<pad>", "<|startoftext|>", "<unk>", "<|endoftext|>")


def train_tokenizer(
    texts: Iterable[str], *, vocabulary: int = 1024, context: int = 32
) -> PreTrainedTokenizerFast:
    """Learn a tokenizer from texts; the same texts, in any order and number, give the same one.

    Args:
        texts: at least one text with a letter.
        vocabulary: largest number of tokens, special tokens and the 256 bytes included.
        context: tokens a text may have, start and end included; longer texts are cut before the end
            token.

    Raises:
        PalpateError: without a text, or with a vocabulary too small for the bytes.
    """
    distinct = sorted({text.strip() for text in texts} - {""})
    fix = "Fill the manifest's column text or material"
    require(len(distinct) > 0, None, "A tokenizer needs at least one text", "none", fix=fix)
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    smallest = len(alphabet) + len(SPECIAL)
    must = f"must hold the bytes and special tokens, {smallest}"
    require(vocabulary >= smallest, "vocabulary", must, vocabulary, 1024)
    tokenizer: Any = Tokenizer(models.BPE())
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocabulary,
        special_tokens=list(SPECIAL),
        initial_alphabet=sorted(alphabet),
        show_progress=False,
    )
    tokenizer.train_from_iterator(distinct, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{START} $A {END}",
        special_tokens=[(START, SPECIAL.index(START)), (END, SPECIAL.index(END))],
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token=PAD,
        bos_token=START,
        unk_token=UNKNOWN,
        eos_token=END,
        model_max_length=context,
    )


def save_tokenizer(tokenizer: Any, folder: Path) -> None:
    """Write the tokenizer for ``AutoTokenizer`` of transformers 4 and 5.

    How it was loaded, and how its last call cut and padded, is dropped: equal tokenizers are equal
    files.
    """
    if (backend := getattr(tokenizer, "backend_tokenizer", None)) is not None:
        backend.no_truncation()  # every call sets these anew
        backend.no_padding()
    tokenizer.save_pretrained(folder)
    path = Path(folder) / "tokenizer_config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    if config.get("tokenizer_class") == "TokenizersBackend":  # transformers 5's name, unknown to 4
        config["tokenizer_class"] = "PreTrainedTokenizerFast"
    config = {k: v for k, v in config.items() if k not in ("is_local", "local_files_only")}
    path.write_text(json.dumps(config, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
