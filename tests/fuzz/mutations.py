"""What can be wrong with an input: a file's bytes, its values, its name or place, an option."""

import copy
import dataclasses
import io
import json
import os
import shutil
import struct
import typing
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from PIL import Image

from palpate.cli import VERBS

Rng = np.random.Generator
LONG = "x" * 140_000
#: Bytes of a file that is almost all a hole.
SPARSE = 3 << 30
WORDS = [
    *("", " ", "0", "-1", "1.5", "nan", "inf", "1e400", "9" * 30, "9" * 5000, "null", "True"),
    *("\0", "a\0b", "\udcff", "a\nb", "\r", "\t", "\ud800", "\ufeff", "\u202e", "é", "e\u0301"),
    *("日本", "\x1b[2J", "..", ".", "../../x.png", "/etc/passwd", "~", "a//b", "C:\\x", "x" * 300),
    *(LONG, "-x", "--help", '"', "'", '"a', "a,b", "a;b", "{", "[", "[bold]", "{0}", "%s"),
    *("<script>", "${x}", "=1+1", "*"),
]
VALUES: list[Any] = [
    *(None, True, 0, -1, 1.5, 2**63, 10**30, 1e308, float("nan"), float("inf"), [], {}, [None]),
    *({"": None}, [[[]]], {"a": {"b": 1}}, "x", ["x"], 3),
]
#: Options that multiply work: large numbers would be obeyed.
WORK = {"workers", "threads", "permutations", "epochs", "steps", "seeds", "folds", "batch", "worst"}
NUMBERS = ["-1", "0", "1", "2", "0.5", "nan", "inf", "1e308", "-0", "1e-320"]
LARGE = [str(2**31), str(2**63), "9" * 30]


def pick(rng: Rng, options: typing.Sequence[Any]) -> Any:
    return options[int(rng.integers(len(options)))]


# --- bytes


def cut(rng: Rng, data: bytes) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def flip(rng: Rng, data: bytes) -> bytes:
    out = bytearray(data)
    for k in rng.integers(0, max(len(out), 1), int(rng.integers(1, 9))) if out else ():
        out[k] = int(rng.integers(256))
    return bytes(out)


def splice(rng: Rng, data: bytes) -> bytes:
    """A stretch moves, doubles or is lost."""
    a, b, c = sorted(int(k) for k in rng.integers(0, len(data) + 1, 3))
    return pick(rng, [data[:b] + data[a:b] + data[c:], data[:a] + data[b:], data[c:] + data[:c]])


def insert(rng: Rng, data: bytes) -> bytes:
    k = int(rng.integers(len(data) + 1))
    word = pick(rng, WORDS).encode("utf-8", "surrogatepass")
    return data[:k] + pick(rng, [word, b"\xff\xfe", b"\0" * 9, rng.bytes(20)]) + data[k:]


def other(rng: Rng, data: bytes) -> bytes:
    return pick(
        rng, [b"", b"\n", b"\0", b"{}", b"[]", b"null", b"PK\5\6" + b"\0" * 18, rng.bytes(99)]
    )


BYTES = [cut, flip, splice, insert, other]

# --- text, JSON


def text(rng: Rng, data: bytes) -> bytes:
    """Lines and cells change, or how the whole is written."""
    lines = data.decode("utf-8", "replace").split("\n")
    k = int(rng.integers(len(lines)))
    sign = next((sign for sign in "\t,;: /" if sign in lines[k]), ",")
    cells = lines[k].split(sign)
    kind = int(rng.integers(9))
    if kind < 4:
        cells[int(rng.integers(len(cells)))] = pick(rng, WORDS)
    elif kind == 4:
        cells = pick(rng, [cells[1:], cells + cells[:1], cells[::-1], ['"' + cells[0], *cells[1:]]])
    lines[k] = sign.join(cells)
    if kind == 5:
        lines = pick(rng, [lines[:k] + lines[k + 1 :], [*lines, lines[k]], lines[::-1], lines[k:]])
    out = "\n".join(lines).encode("utf-8", "surrogatepass")
    if kind == 6:
        return pick(rng, [b"\xef\xbb\xbf" + out, out.decode("utf-8", "replace").encode("utf-16")])
    return out.replace(b"\n", pick(rng, [b"\r\n", b"\r", b"\n\n"])) if kind == 7 else out


def json_value(rng: Rng, data: bytes) -> bytes:
    """A value at a random place is replaced, doubled, renamed or lost."""
    try:
        top = json.loads(data)
    except ValueError:
        return text(rng, data)
    return json.dumps(altered(rng, top)).encode()


def altered(rng: Rng, top: Any) -> Any:
    box: Any = [copy.deepcopy(top)]
    at, key = box, 0
    while isinstance(at[key], dict | list) and at[key] and rng.random() < 0.75:
        at = at[key]
        key = pick(rng, list(at) if isinstance(at, dict) else range(len(at)))
    kind = int(rng.integers(8))
    if kind < 5:
        at[key] = pick(rng, [*VALUES, *WORDS, [at[key]], {"x": at[key]}])
    elif kind == 5:
        del at[key]
    elif isinstance(at, dict):
        at[pick(rng, WORDS)] = at[key] if kind == 6 else at.pop(key)
    else:
        at.append(at[key]) if kind == 6 else at.extend(1000 * at[key : key + 1])
    return box[0] if box else None


def json_text(rng: Rng, data: bytes) -> bytes:
    deep = b"[" * 100_000
    return pick(rng, [deep, deep + b"]" * 100_000, b"NaN", b"-Infinity", b"1" * 5000, b'"\\ud800"'])


def json_lines(rng: Rng, data: bytes) -> bytes:
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    lines[k] = json_value(rng, lines[k])
    return b"\n".join(lines)


# --- tables, arrays


def parquet(rng: Rng, data: bytes) -> bytes:
    """A column changes its type, values or name; rows are lost or doubled; the metadata stays."""
    table = pl.read_parquet(io.BytesIO(data))
    metadata = pl.read_parquet_metadata(io.BytesIO(data))
    if metadata and rng.random() < 0.2:
        metadata[pick(rng, list(metadata))] = pick(rng, WORDS).encode("utf-8", "replace").decode()
    name = pick(rng, table.columns)
    n = len(table)
    day = pl.datetime(2020, 1, 1)
    words = [word.encode("utf-8", "replace").decode() for word in WORDS]
    values = [None, 1, 1.5, True, b"x", ["x"], {"a": 1}, float("nan"), -(2**62), *words]
    columns = [pl.Series(name, [value] * n) for value in values]
    columns += [table[name].cast(pl.String, strict=False).cast(pl.Categorical)]
    columns += [table[name].shuffle(0), pl.Series(name, [[]] * n, dtype=pl.List(pl.Float64))]
    columns += [pl.datetime_range(day, day, eager=True).sample(n, with_replacement=True)]
    column = pick(rng, columns)
    tables = [table.drop(name), table.head(0), table.head(1), pl.concat([table, table])]
    tables += [table.rename({name: pick(rng, WORDS[1:5])}), table.select([])]
    kind = int(rng.integers(3))
    changed = table.with_columns(column.alias(name)) if kind else pick(rng, tables)
    stream = io.BytesIO()
    changed.write_parquet(stream, metadata=metadata)
    return stream.getvalue()


def array(rng: Rng) -> np.ndarray:
    x = rng.normal(size=(12, 4))
    arrays = [x, x.astype(np.float16), x.astype(complex), x.astype(int), x > 0, x[:0], x[:, :0]]
    arrays += [x[0], np.float32(1), x[None], np.asfortranarray(x), x.astype(str), x * np.nan]
    arrays += [x * np.inf, x * 0, x * 1e300, np.array(["a", "\0"]), np.zeros(3, "M8[s]")]
    arrays += [np.zeros(3, [("a", "f4"), ("b", "O")]), np.array([{}, None]), x[:1], x[:, :1]]
    return np.asarray(pick(rng, arrays))


def saved(x: np.ndarray, save: Callable[..., None] = np.save) -> bytes:
    stream = io.BytesIO()
    save(stream, x)
    return stream.getvalue()


def npy(rng: Rng, data: bytes) -> bytes:
    headers = [b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d, 4), }" % 10**12]
    headers += [b"{'descr': '<f8', 'shape': (-1, 4), }", b"[" * 9000, b"os.system('x')", b"{1}"]
    header = pick(rng, headers).ljust(117) + b"\n"
    forged = b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + data[128:]
    return pick(rng, [saved(array(rng)), saved(array(rng), np.savez), forged])


def npz(rng: Rng, data: bytes) -> bytes:
    arrays = dict(np.load(io.BytesIO(data)))
    name = pick(rng, list(arrays))
    arrays[name] = array(rng)
    if rng.random() < 0.2:
        del arrays[name]
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return pick(rng, [stream.getvalue()] * 4 + [saved(array(rng))])


def safetensors(rng: Rng, data: bytes) -> bytes:
    """The header changes; sometimes its length is wrong as well."""
    length = int.from_bytes(data[:8], "little")
    header = json.dumps(altered(rng, json.loads(data[8 : 8 + length]))).encode()
    size = len(header) if rng.random() < 0.8 else int(pick(rng, [0, 1, 2**40, 2**64 - 1]))
    return size.to_bytes(8, "little") + header + data[8 + length :]


# --- images

#: What Pillow knows under any name, or hands to another program, and what no image is.
FOREIGN = [
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n%%EndComments\nshowpage\n%%EOF\n",
    b"%PDF-1.4\n1 0 obj <<>> endobj\ntrailer <<>>\n%%EOF\n",
    b"<svg xmlns='http://www.w3.org/2000/svg' width='24' height='24'><script/></svg>",
    b"\xd7\xcd\xc6\x9a" + b"\0" * 40,  # a metafile
    b"SIMPLE  =                    T".ljust(2880),  # FITS
    b"GRIB" + b"\0" * 40,
    b"8BPS\0\1" + b"\0" * 40,
    b"icns\0\0\0\x08",
    b"\x7fELF" + b"\0" * 60,
    b"#!/bin/sh\nexit\n",
    b"\0\0\0\x18ftypmp42" + b"\0" * 40,
    b"\x93NUMPY\1\0",
]


def image(rng: Rng, data: bytes) -> bytes:
    """Other modes, depths, sizes, formats, animations, headers that promise too much."""
    x = rng.integers(0, 256, (24, 24, 3)).astype(np.uint8)
    modes = ["L", "1", "P", "RGBA", "LA", "CMYK", "YCbCr", "HSV", "F", "I"]
    images = [Image.fromarray(x).convert(mode) for mode in modes]
    images += [Image.fromarray(x[:1, :1]), Image.fromarray(x[:1]), Image.new("RGB", (3000, 1))]
    depths = (65536, 4096, 256, 2)
    images += [Image.fromarray(rng.integers(0, n, (24, 24)).astype(np.uint16)) for n in depths]
    kinds = ["PNG", "JPEG", "GIF", "BMP", "TIFF", "WEBP", "ICO", "PPM", "AVIF", "EPS", "TGA", "PDF"]
    bombs = [bomb(*side) for side in ((9000, 9000), (13000, 13000), (60000, 60000), (1, 2**31 - 1))]
    stream = io.BytesIO()
    picture = pick(rng, images)
    if rng.random() < 0.3:
        return pick(rng, bombs) if rng.random() < 0.5 else pick(rng, FOREIGN)
    try:
        exif = Image.Exif()
        exif[0x0112] = int(rng.integers(0, 12))
        picture.save(stream, pick(rng, kinds), exif=exif)
    except (OSError, ValueError, KeyError):  # a format without this mode
        picture.convert("RGB").save(stream, "PNG")
    return stream.getvalue()


def bomb(width: int, height: int) -> bytes:
    """A PNG of one color whose header has this size; its data ends early where that is large."""
    rows = min(height, 10**8 // (width // 8 + 2))
    pixels = zlib.compress(b"\0" * ((width + 7) // 8 + 1) * rows, 1)
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", pixels), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


KINDS: dict[str, list[Callable[[Rng, bytes], bytes]]] = {
    ".json": [json_value, json_value, json_value, json_text, *BYTES],
    ".jsonl": [json_lines, json_lines, text, *BYTES],
    **{suffix: [text, text, text, *BYTES] for suffix in (".csv", ".tsv", ".txt")},
    ".parquet": [parquet, parquet, parquet, *BYTES],
    ".npy": [npy, npy, *BYTES],
    ".npz": [npz, npz, *BYTES],
    ".safetensors": [safetensors, *BYTES],
    **{suffix: [image, *BYTES] for suffix in (".png", ".jpg")},
}

# --- files


def change_content(rng: Rng, files: list[Path]) -> None:
    by_kind: dict[str, list[Path]] = {}
    for file in files:
        by_kind.setdefault(file.suffix, []).append(file)
    file = pick(rng, by_kind[pick(rng, sorted(by_kind))])
    data = file.read_bytes()
    try:
        data = pick(rng, KINDS.get(file.suffix, BYTES))(rng, data)
    except Exception:  # it is broken already
        data = pick(rng, BYTES)(rng, data)
    file.unlink()  # the copy may be a hard link
    file.write_bytes(data)


def change_place(rng: Rng, files: list[Path]) -> None:
    """A file is lost, swapped, renamed, huge, or something else than a file; or all next to it."""
    file, another = pick(rng, files), pick(rng, files)
    kind = int(rng.integers(11))
    if kind == 9:  # a whole side of the samples
        for each in filter(Path.is_file, file.parent.iterdir()):
            each.unlink()
    elif kind == 10:
        data = file.read_bytes()
        file.unlink()  # the copy may be a hard link
        file.write_bytes(data)
        os.truncate(file, SPARSE)
    elif kind == 0:
        file.rename(file.with_name("swap"))
        shutil.copy(another if another.exists() else file.with_name("swap"), file)
    elif kind in (1, 2):
        name = pick(rng, [w for w in WORDS if w.strip(". ") and "\0" not in w and len(w) < 200])
        raw = name.replace("/", "_").encode("utf-8", "surrogatepass")
        name = os.fsdecode(raw) + file.suffix
        file.rename(file.with_name(name))
    elif kind == 3:
        shutil.copy(file, file.with_name(f"{file.stem} copy{file.suffix}"))
    elif kind == 4:
        file.rename(file.with_suffix(another.suffix))
    else:
        file.unlink()
        if kind == 5:
            file.mkdir()
        elif kind == 6:
            file.symlink_to(pick(rng, [file, file.parent, "missing", "/", another.resolve()]))
        elif kind == 7:
            os.mkfifo(file)


# --- options


def options_of(verb: str) -> Iterator[tuple[str, str]]:
    """Option names of a verb with their types in words."""
    module = import_module(f"palpate.cli.{VERBS[verb].module}")

    def of(cls: type) -> Iterator[tuple[str, str]]:
        for name, hint in typing.get_type_hints(cls, include_extras=True).items():
            inner = (
                typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint
            )
            if dataclasses.is_dataclass(inner):
                yield from of(inner)  # type: ignore[arg-type]
            elif not any("Positional" in str(extra) for extra in typing.get_args(hint)):
                yield name, str(inner)

    return of(module.Options)


def option(rng: Rng, verb: str, places: list[str]) -> list[str]:
    """An option of the verb with a value of its type, or of any."""
    name, hint = pick(rng, list(options_of(verb)))
    name = {"columns": "map", "side": "as", "as_json": "json", "show_list": "list"}.get(name, name)
    if name == "preset":  # the others take hours
        return []
    flag = f"--{name.replace('_', '-')}"
    if hint == "<class 'bool'>":
        return [pick(rng, [flag, flag, flag.replace("--", "--no-")])]
    small = name in WORK or verb == "world"
    numbers = NUMBERS[:5] if small else NUMBERS + LARGE
    values = ["", "x", *places]
    if "Literal" in hint:
        values = hint.replace("'", "").split("Literal[")[1].split("]")[0].split(", ") * 2
    elif "int" in hint or "float" in hint:
        values = numbers
    elif "str" in hint and not small:
        values = [*WORDS, *places, "a=b", "material=kind", "vision=vision", "frame=1"]
        values.append("id=id || 'x'")
    count = int(rng.integers(1, 3)) if "tuple" in hint else 1
    return [flag, *(pick(rng, values) for _ in range(count))]


def change_arguments(rng: Rng, args: list[str], places: list[str], outputs: list[str]) -> None:
    """An argument is replaced, lost or doubled, or an option joins."""
    two = " ".join(args[:2])
    verb = two if two in VERBS else args[0]
    first = len(verb.split())
    k = int(rng.integers(first, len(args))) if len(args) > first else first
    kind = int(rng.integers(6))
    if kind < 3 or k == len(args):
        args += option(rng, verb, places)
    elif args[k - 1] in ("-o", "--table", "--page", "--latex"):
        args[k] = pick(rng, outputs)
    elif kind == 3 and args[k - 1].removeprefix("--") not in WORK:
        args[k] = pick(rng, [*WORDS, *places])
    elif kind == 4:
        del args[k]
    else:
        args.insert(k, args[k])
