"""A vision-language model in this process, by transformers: a folder, or an id on the hub.

For models that transformers has natively and whose processor needs no torchvision: Idefics3, LLaVA,
PaliGemma, Gemma 3. Everything else is better behind a server. Code that comes with a model is never
run.
"""

from __future__ import annotations

import io
import threading
import time
from pathlib import Path
from typing import Any

from PIL import Image

from palpate.captions.replies import RejectedError, Reply, Request
from palpate.core import MissingExtraError, PalpateError, digest_json, digest_lines, short

SERVE = "Use another model, or serve this one (vLLM, SGLang) and name the server"


class Local:
    """A model loaded here, which takes one image at a time.

    Args:
        source: folder or hub id.
        device: torch device; ``auto`` takes the GPU if there is one.

    Raises:
        MissingExtraError: without transformers.
        PalpateError: if it cannot be loaded, or is no model that answers about images.
    """

    threads = 1

    def __init__(self, source: str, device: str = "auto") -> None:
        try:
            import torch
            from transformers import AutoModelForImageTextToText, AutoProcessor
        except ImportError:
            raise MissingExtraError("transformers", "torch", "A local model") from None
        self._torch, self._lock = torch, threading.Lock()
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = device
        try:
            self._processor: Any = AutoProcessor.from_pretrained(source)
            model: Any = AutoModelForImageTextToText.from_pretrained(source, dtype="auto")
        except Exception as error:  # transformers and the hub raise many kinds
            got = " ".join(f"{source}: {error}".split())[:300]
            must = "must be a vision-language model that transformers loads without torchvision"
            raise PalpateError(must, got, SERVE, argument="local") from None
        self._model: Any = model.to(device).eval()
        self.model = f"{source}@{short(_identity(source, model))}"

    def close(self) -> None:
        """Nothing to free."""

    def describe(self, request: Request) -> Reply:
        """Generate an answer; see :class:`palpate.captions.replies.Describer`."""
        try:
            return self._generated(request)
        except Exception as error:  # transformers and torch raise many kinds, memory among them
            got = " ".join(f"{type(error).__name__} {error}".split())[:200]
            raise RejectedError(got) from None

    def _generated(self, request: Request) -> Reply:
        images = [Image.open(io.BytesIO(image)).convert("RGB") for image in request.images]
        start = time.perf_counter()
        with self._lock, self._torch.inference_mode():
            self._torch.manual_seed(request.seed)
            inputs = self._inputs(request.text, images).to(self.device, self._model.dtype)
            length = inputs["input_ids"].shape[1]
            sampling = {"do_sample": False, "temperature": None, "top_p": None, "top_k": None}
            if request.temperature > 0:
                sampling = {"do_sample": True, "temperature": request.temperature}
            output = self._model.generate(**inputs, max_new_tokens=request.max_tokens, **sampling)
            fresh = output[0, length:]
            raw = self._processor.decode(fresh, skip_special_tokens=True)
        return Reply(
            raw=str(raw),
            model=self.model,
            finish="length" if len(fresh) >= request.max_tokens else "stop",
            tokens=(int(length), len(fresh)),
            seconds=round(time.perf_counter() - start, 3),
        )

    def _inputs(self, text: str, images: list[Image.Image]) -> Any:
        """Tensors for the model; models without a chat template (PaliGemma) read text as it is."""
        if getattr(self._processor, "chat_template", None):
            parts = [{"type": "image"} for _ in images]
            messages = [{"role": "user", "content": [*parts, {"type": "text", "text": text}]}]
            text = self._processor.apply_chat_template(messages, add_generation_prompt=True)
        else:
            mark = getattr(self._processor, "image_token", None) or "<image>"
            text = f"{str(mark) * len(images)}{text}"
        return self._processor(images=[images], text=[text], return_tensors="pt")


def _identity(source: str, model: Any) -> str:
    """Digest of a model: the bytes of a folder's weights, else the commit on the hub."""
    folder = Path(source)
    if not folder.is_dir():
        return digest_json([source, str(getattr(model.config, "_commit_hash", None))])
    files = sorted(p for p in folder.iterdir() if p.suffix in (".json", ".safetensors"))
    return digest_lines(f"{p.name} {_stamp(p)}" for p in files)


def _stamp(path: Path) -> str:
    """Digest of a file's size and its first and last megabyte: whole weights take minutes."""
    import hashlib

    size, block = path.stat().st_size, 1 << 20
    with open(path, "rb") as file:
        state = hashlib.sha256(f"{size}".encode() + file.read(block))
        file.seek(max(0, size - block))
        state.update(file.read(block))
    return state.hexdigest()
