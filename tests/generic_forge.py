"""Forges of the formats of anyone's data: interval lists beside recordings, and a Hugging Face folder with names of its own."""

from pathlib import Path

from PIL import Image

from data_forge import Forged, picture, write_image


def forge_intervals(folder: Path) -> Forged:
    """Two extracted recordings and a list whose columns have names of their own; the last touch ends two frames before its recording."""
    root = folder / "mine"
    for v, video in enumerate(("rec 1", "rec,2")):
        for k in range(22):
            for side in ("video_frame", "gelsight_frame"):
                write_image(root / video / side / f"{k:010d}.jpg", 32 * v + k)
    lines = [
        "Recording,First,Last,Label,Object",
        "rec 1,6,8,Wood,chair",
        "rec 1,12,13,,",
        '"rec,2",7,8,Rock,wall',
        '"rec,2",18,19,Rock,wall',
    ]
    (root / "touches.csv").write_text("\r\n".join(lines))
    return Forged(root / "touches.csv", 9)


def save_hf(folder: Path, rows: list[dict], **kinds) -> Path:
    """Saves rows as a Hugging Face folder; ``kinds`` are features that are not to be guessed."""
    import datasets

    features = datasets.Features({n: kinds.get(n, datasets.Value("string")) for n in rows[0]})
    datasets.disable_progress_bars()
    by_part = {
        part: [r for r in rows if r["part"] == part] for part in sorted({r["part"] for r in rows})
    }
    datasets.DatasetDict(
        {
            part: datasets.Dataset.from_list(some, features=features)
            for part, some in by_part.items()
        }
    ).save_to_disk(str(folder))
    return folder


def hf_rows(folder: Path) -> list[dict]:
    """Eight rows of two parts, with images, a class label and a path."""
    rows = []
    for k in range(8):
        row = {
            "part": "train" if k < 5 else "validation",
            "path": f"data1/0-17.{k // 4}/{k:04d}.jpg",
            "kind": k % 2,
        }
        for side, suffix in (("rgb", ".png"), ("gel", ".jpg")):
            path = folder / f"{side}{k}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture(2 * k + (side == "gel"))).save(path)
            row[side] = {"bytes": path.read_bytes(), "path": f"{k:04d}{suffix}"}
            path.unlink()
        rows.append(row)
    return rows


def forge_hf(folder: Path) -> Forged:
    """A folder of ``save_to_disk`` with two images a row, class labels and parts."""
    import datasets

    kinds = {
        "rgb": datasets.Image(),
        "gel": datasets.Image(),
        "kind": datasets.ClassLabel(names=["Wood", "Rock"]),
    }
    rows = hf_rows(folder)
    maps = {
        "vision": "rgb",
        "tactile": "gel",
        "video": "regexp_replace(path, '/[^/]*$', '')",
        "frame": "split_part(gel, '.', 1)",
        "material": "kind",
    }

    def again(change):
        def spoil(source: Path) -> None:
            for file in sorted(source.rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
            source.rmdir()
            save_hf(source, [*rows[:-1], {**rows[-1], "gel": change(rows[-1]["gel"])}], **kinds)

        return spoil

    def cut(image):
        return {**image, "bytes": image["bytes"][: len(image["bytes"]) // 2]}

    source = save_hf(folder / "mine", rows, **kinds)
    return Forged(source, 8, {"columns": maps}, remove=again(lambda _: None), cut=again(cut))
